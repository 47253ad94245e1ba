"""How well patches of jets hold whole garments, against AtlasNet's charts with as many numbers.

    python benchmarks/polyfit_reconstruction.py DATA/garments_snug/*.obj [--tables paper ways sizes]

First the paper's own measure at the paper's number of patches: the symmetric Chamfer distance
between 10,000 points of the garment and 10,000 of the reconstruction, in the unit sphere about the
box's centre, times 1e3. Its floor is that of two samplings of the garment itself. Then the ways to
cut and to find frames, ours and the paper's: plain ACVD, and the spatial transformer. Then what
does tell methods apart, for several numbers of patches: the distances between the surfaces (RMS and
95th percentile, of points of either one from the other) and the angle between their normals, beside
AtlasNet's. Its charts (Groueix et al. 2018) are here fitted to the one surface, by Adam on the
Chamfer distance, without an encoder: their decoders then have as many numbers as the jets.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from polyfit import errors, mesh, read_mesh

POINTS = 10_000
TABLES = ("paper", "ways", "sizes")
PATCHES = (10, 25, 50, 100, 200, 400)
PAPER = {"tshirt": 0.229, "tank": 0.268, "long_sleeve_top": 0.092, "shorts": 0.372, "pants": 0.237}
WAYS = {  # options of PatchedSurface.from_mesh; the last is the paper's
    "ours": (dict(), False),
    "ours, transformer": (dict(), True),
    "plain ACVD": (dict(acvd=True), False),
    "plain ACVD, transformer": (dict(acvd=True), True),
}
SAME_AXIS = 0.99999  # cosine of two z axes: 0.3 degrees
CHARTS = {
    10: (5, (4, 4)),
    25: (5, (8, 7)),
    50: (5, (13, 10)),
    100: (25, (8, 5)),
    200: (25, (12, 8)),
    400: (25, (16, 15)),
}


def sampled(V, F, count, seed):
    """Points (P, 3) drawn evenly from a mesh's area."""
    rng = np.random.default_rng(seed)
    area = mesh.areas(V, F)
    return np.einsum(
        "pj,pjc->pc",
        rng.dirichlet((1, 1, 1), count),
        V[F[rng.choice(len(F), count, p=area / area.sum())]],
    )


def chamfer(a, b):
    """Sum of both mean squared distances of points a (P, 3) and b (Q, 3)."""
    from scipy.spatial import cKDTree

    return sum((cKDTree(x).query(y)[0] ** 2).mean() for x, y in ((a, b), (b, a)))


def to_surface(points, V, F):
    """Distances (P,) of points from a mesh, and the faces (P,) that they are nearest to."""
    import pyvista

    face, closest = pyvista.PolyData.from_regular_faces(V, F).find_closest_cell(
        points, return_closest_point=True
    )
    return np.linalg.norm(points - closest, axis=1), face


def between(V, F, W, G, points):
    """RMS and 95th percentile [m] of the distances of points of two meshes from the other, and the
    mean angle [degrees] of their normals, turned alike."""
    distances, angles = [], []
    for seed, (A, B, C, D) in enumerate(((V, F, W, G), (W, G, V, F))):
        rng = np.random.default_rng(seed)
        area = mesh.areas(A, B)
        face = rng.choice(len(B), points, p=area / area.sum())
        distance, nearest = to_surface(
            np.einsum("pj,pjc->pc", rng.dirichlet((1, 1, 1), points), A[B[face]]), C, D
        )
        normals = [mesh.face_vectors(A, B)[face], mesh.face_vectors(C, D)[nearest]]
        normals = [
            n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300) for n in normals
        ]
        distances.append(distance)
        angles.append(
            np.degrees(np.arccos(np.clip(np.abs((normals[0] * normals[1]).sum(1)), 0, 1)))
        )
    distance = np.concatenate(distances)
    return (
        float(np.sqrt((distance**2).mean())),
        float(np.percentile(distance, 95)),
        float(np.concatenate(angles).mean()),
    )


def jets(V, F, count, order):
    """(vertices, faces) of the reconstruction by ``count`` patches, its number of parameters, and a
    function that samples it.
    """
    from polyfit import PatchedSurface

    surface = PatchedSurface.from_mesh(V, F, count, order)
    W = surface.vertices().double().numpy()
    return (
        W,
        surface.patches.faces,
        surface.parameters,
        lambda points, seed: surface.sample(points, seed)[0].double().numpy(),
    )


def atlasnet(V, F, charts, widths, iterations, points=1000):
    """(vertices, faces) of AtlasNet's charts fitted to the surface, and how many numbers hold
    them.
    """
    import torch

    from polyfit.baselines import AtlasNet, chamfer, normalised

    torch.manual_seed(0)
    model = AtlasNet(charts, latent=1, widths=widths)
    code = torch.zeros(1, 1)
    target, centre, scale = normalised(
        torch.as_tensor(sampled(V, F, 20_000, 0), dtype=torch.float32)
    )
    numbers = [*model.weights, *model.biases]
    optimiser = torch.optim.Adam(numbers, lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    generator = torch.Generator().manual_seed(0)
    for _ in range(iterations):
        uv = torch.rand(charts, points // charts, 2, generator=generator)
        some = target[torch.randint(len(target), (points,), generator=generator)]
        loss = chamfer(model.decode(code, uv).flatten(1, 2), some[None]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    side = max(8, int((20_000 / charts) ** 0.5))
    with torch.no_grad():
        W = (model.grid(code, side).flatten(0, 2) * scale[0] + centre[0]).double().numpy()
    k = np.arange(side * side).reshape(side, side)
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    cell = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    G = (cell + np.arange(charts)[:, None, None] * side * side).reshape(-1, 3)
    return (
        W,
        G,
        sum(p.numel() for p in numbers) - charts * widths[0],
    )  # the code is zero, and its weights hold nothing


def paper_table(garments, order, seeds=3):
    rows = []
    for name, (V, F) in garments.items():
        start = time.perf_counter()
        W, G, _, sample = jets(V, F, None, order)
        seconds = time.perf_counter() - start
        centre = (V.max(0) + V.min(0)) / 2
        scale = np.linalg.norm(V - centre, axis=1).max()
        unit = lambda x: (x - centre) / scale
        clouds = [unit(sampled(V, F, POINTS, 10 + s)) for s in range(2 * seeds)]
        floor = 1e3 * np.mean([chamfer(clouds[s], clouds[seeds + s]) for s in range(seeds)])
        own = 1e3 * np.mean(
            [chamfer(unit(sample(POINTS, 100 + s)), clouds[s]) for s in range(seeds)]
        )
        rms, p95, angle = between(V, F, W, G, POINTS)
        r = dict(
            garment=name,
            patches=int(_patches(V, F)),
            chamfer=own,
            floor=floor,
            over_floor=own / floor - 1,
            paper=PAPER.get(name),
        )
        r.update(rms_mm=1e3 * rms, p95_mm=1e3 * p95, normal_deg=angle, seconds=seconds)
        rows.append(r)
        print(
            f"{name:>18} K {r['patches']:3}  Chamfer {own:.3f}  floor {floor:.3f}"
            f" ({100 * r['over_floor']:+.1f} %)  paper {r['paper'] or '-':>5}  RMS"
            f" {r['rms_mm']:.3f} mm  95 % {r['p95_mm']:.3f} mm  normals {angle:.2f} deg "
            f" {seconds:.1f} s",
            flush=True,
        )
    return rows


def ways_table(garments, order):
    """RMS, 95th percentile and normals by the way that patches are cut and their frames are
    found; ``turned``: of how many patches the transformer turned the z axis.
    """
    from polyfit import PatchedSurface, PolyFit

    stn, rows = PolyFit.pretrained(order).requires_grad_(False), []
    for name, (V, F) in garments.items():
        for way, (options, with_stn) in WAYS.items():
            made = PatchedSurface.from_mesh(
                V, F, None, order, polyfit=stn if with_stn else None, **options
            )
            pca = PatchedSurface.fit(made.patches, order).frame.R[:, :, 2]
            turned = int(((pca * made.frame.R[:, :, 2]).sum(-1) < SAME_AXIS).sum())
            W = made.vertices().double().numpy()
            rms, p95, angle = between(V, F, W, made.patches.faces, POINTS)
            row = dict(garment=name, way=way, patches=len(made), turned=turned)
            rows.append(row | dict(rms_mm=1e3 * rms, p95_mm=1e3 * p95, normal_deg=angle))
            figures = f"RMS {1e3 * rms:.4f}  95 % {1e3 * p95:.3f} mm  normals {angle:.2f} deg"
            print(f"{name:>18}  {way:24} {figures}  turned {turned}", flush=True)
    return rows


def _patches(V, F):
    from polyfit import patch_count

    return min(len(V), patch_count(mesh.areas(V, F).sum()))


def told(rms, p95, angle):
    return f"RMS {rms:6.3f}  95 % {p95:6.3f} mm  normals {angle:5.2f} deg"


def size_table(garments, order, iterations):
    rows = []
    for name, (V, F) in garments.items():
        for count in [k for k in PATCHES if k <= len(V)]:
            row = dict(garment=name, patches=count)
            W, G, row["numbers"], _ = jets(V, F, count, order)
            row["rms_mm"], row["p95_mm"], row["normal_deg"] = np.array(
                between(V, F, W, G, POINTS)
            ) * (1e3, 1e3, 1)
            line = (
                f"{name:>18} K {count:3}  {row['numbers']:5} numbers:"
                f" {told(row['rms_mm'], row['p95_mm'], row['normal_deg'])}"
            )
            if iterations:
                W, G, row["atlasnet_numbers"] = atlasnet(V, F, *CHARTS[count], iterations)
                found = np.array(between(V, F, W, G, POINTS)) * (1e3, 1e3, 1)
                row["atlasnet_rms_mm"], row["atlasnet_p95_mm"], row["atlasnet_normal_deg"] = found
                line += f"   AtlasNet, {row['atlasnet_numbers']:5} numbers: {told(*found)}"
            rows.append({k: float(v) if isinstance(v, np.floating) else v for k, v in row.items()})
            print(line, flush=True)
    return rows


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("meshes", nargs="+", help="OBJ or PLY files [m]")
    parser.add_argument("--order", type=int, default=4)
    parser.add_argument(
        "--iterations",
        type=int,
        default=1500,
        help="of AtlasNet's fit to each surface; 0 leaves it out",
    )
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("-o", "--output", default="out/benchmarks")
    args = parser.parse_args(argv)
    garments = {Path(m).stem: read_mesh(m)[:2] for m in args.meshes}
    Path(args.output).mkdir(parents=True, exist_ok=True)
    path = Path(args.output) / "polyfit_reconstruction.json"
    # tables that are not made now stay as they are
    report = json.loads(path.read_text()) if path.exists() else {}
    report |= dict(order=args.order)
    if "paper" in args.tables:
        report["paper"] = paper_table(garments, args.order)
    if "ways" in args.tables:
        report["ways"] = ways_table(garments, args.order)
    if "sizes" in args.tables:
        report["iterations"] = args.iterations
        report["sizes"] = size_table(garments, args.order, args.iterations)
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written: {path}")


if __name__ == "__main__":
    errors.cli(main)
