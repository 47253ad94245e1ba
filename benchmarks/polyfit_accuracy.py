"""How closely jets fit patches of garments that were not trained on: by order, with and without the
spatial transformer, against networks that regress jets; and what AtlasNet's autoencoder makes of
garments that it has not seen.

    python benchmarks/polyfit_accuracy.py DATA [--runs out/polyfit] [--train] [--only sources]
    [-o out/benchmarks]

DATA holds ``garments_snug``, ``garments_makehuman`` and ``cloth``. The networks are read from RUNS,
where ``--train`` makes those that are missing, each by the command that ``TRAININGS`` gives;
without them the tables have what ships with the package. The held-out garments (``HELD_OUT``) are
whole ones that no training saw.

What is measured: the kinds of patches of ``polyfit_held_out``, each sampled at 256 points.

Figures are means over patches, of the jets fitted to all 256 points: RMS of height in the chart's
unit s (the paper's measure), of distance to the surface in s (which no frame can make small by
looking at a fold from its edge), and the mean angle between the jet's normals and the mesh's. The
paper's figures are of CLOTH3D, which is not free to use here; they stand beside ours for their
ratios.

Writes ``polyfit_accuracy.json``.
"""

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np
import torch
from polyfit_held_out import CLOUD_POINTS, HELD_OUT, POINTS, cloud, kinds
from polyfit_networks import ORDER, TRAININGS, BestAxis, Tilted, making, train_missing, trained
from scipy.spatial import cKDTree

from polyfit.baselines import DGCNN, AtlasNet, PointNet
from polyfit.errors import cli
from polyfit.files import aside
from polyfit.network import PolyFit
from polyfit.training import discrepancy

PAPER_ATLASNET = {  # Chamfer x 1e3 on T-shirt, tank, long-sleeve top, shorts, trousers
    5: (0.531, 0.939, 0.481, 1.508, 0.963),
    25: (0.490, 0.942, 0.420, 1.471, 0.992),
    125: (0.531, 1.005, 0.490, 1.547, 0.858),
}
ORDERS = range(1, 9)
FIGURES = ("height", "distance", "angle")


@torch.no_grad()
def figures(model, patches):
    """Means over the patches of what ``model`` (points -> PatchFit) leaves."""
    parts = []
    for first in range(0, len(patches), 512):
        points, normals = patches.points[first : first + 512], patches.normals[first : first + 512]
        fit = model(points)
        parts.append(discrepancy(fit.jet.alpha, fit.frame.to_chart(points), normals @ fit.frame.R))
    return {name: torch.cat([getattr(p, name) for p in parts]).mean().item() for name in FIGURES}


@torch.no_grad()
def milliseconds(model, seconds=3.0):
    """Median time a patch [ms] in batches of 512 patches of 256 points."""
    points = torch.randn(512, POINTS, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1.0, 0.7, 0.2]
    )
    model(points)
    times, end = [], time.monotonic() + seconds
    while time.monotonic() < end or len(times) < 5:
        start = time.perf_counter()
        model(points)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times)) / len(points)


def on_all(model, patches):
    """The :func:`figures` of each kind of patches, by its name."""
    return {kind: figures(model, p) for kind, p in patches.items()}


def both(figures):
    """Height and normals, for a table."""
    return f"{figures['height']:.4f} / {figures['angle']:.2f}"


def table(title, head, rows):
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def measure(data, runs):
    """All tables as a dictionary, printed on the way."""
    patches = kinds(data)
    main = trained(runs, "main", PolyFit.load) or PolyFit.pretrained(ORDER)
    every = {kind: str(len(p)) for kind, p in patches.items()}
    report = {"patches": {kind: len(p) for kind, p in patches.items()}}

    frames = {
        "PCA": PolyFit(ORDER),
        "five fixed tilts": PolyFit(ORDER, Tilted()),
        "with the STN": main,
        "search over 65 axes": BestAxis(),
    }
    if by_preset := trained(runs, "paper", PolyFit.load):
        frames["one quaternion, by the preset"] = by_preset
    report["frames"] = {name: on_all(m, patches) for name, m in frames.items()}
    rows = []
    for kind in patches:
        least = report["frames"]["PCA"][kind]["height"]
        for name, found in report["frames"].items():
            f = found[kind]
            below = f"{100 * (1 - f['height'] / least):.1f} %"
            rows.append(
                (
                    f"{kind} ({every[kind]})",
                    name,
                    f"{f['height']:.4f}",
                    f"{f['distance']:.4f}",
                    f"{f['angle']:.2f}",
                    below,
                )
            )
    rows += [
        ("paper: CLOTH3D", "PCA", "0.0259", "", "5.47", ""),
        ("paper: CLOTH3D", "with the STN", "0.0201", "", "5.27", "22.4 %"),
    ]
    table(
        "Frames, order 4",
        ("patches", "frame", "height RMSE", "distance RMS", "normals °", "height below PCA's"),
        rows,
    )

    report["orders"], rows = {}, []
    for order in ORDERS:
        models = {"PCA": PolyFit(order), "STN": PolyFit(order, main.stn).eval()}
        found = {
            kind: {name: figures(m, patches[kind]) for name, m in models.items()}
            for kind in ("as made", "folded")
        }
        report["orders"][order] = found
        rows.append((str(order), *(both(f) for kind in found.values() for f in kind.values())))
    table(
        "Orders: height RMSE / normals °",
        ("order", "as made, PCA", "as made, STN", "folded, PCA", "folded, STN"),
        rows,
    )

    models = {"PolyFit without STN": PolyFit(ORDER), "PolyFit": main}
    for name, kind in (("pointnet", PointNet), ("dgcnn", DGCNN)):
        if model := trained(runs, name, kind.load):
            models[kind.__name__] = model
    report["networks"] = {
        name: on_all(m, patches) | {"ms": milliseconds(m)} for name, m in models.items()
    }
    report["threads"] = torch.get_num_threads()
    rows = [
        (name, *(both(f[kind]) for kind in patches), f"{f['ms']:.4f}")
        for name, f in report["networks"].items()
    ]
    paper = {
        "PolyFit": ("0.0201 / 5.27", "0.0481"),
        "PointNet": ("0.0309 / 6.94", "0.0754"),
        "DGCNN": ("0.0290 / 6.41", "0.0625"),
    }
    rows += [
        (f"paper (CLOTH3D, GPU): {name}", figure, *[""] * (len(patches) - 1), ms)
        for name, (figure, ms) in paper.items()
    ]
    table(
        f"Networks: height RMSE / normals °; time on {report['threads']} thread(s)",
        ("network", *patches, "ms a patch"),
        rows,
    )

    return report | sources(data, runs, patches) | atlasnet(data, runs)


SOURCES = {  # what a network was trained on: its folder in RUNS, and the paper's figures of it
    "Gaussians only": ("gaussian", "0.0248 / 5.49"),
    "4 families": ("families", "0.0239 / 5.42"),
    "4 families, fine-tuned on garment patches": ("tuned", ""),
    "4 families + garment patches": ("garments", "0.0201 / 5.32"),
}


def sources(data, runs, patches=None):
    """The table of training sets as a dictionary, printed; ``patches``: the kinds of DATA."""
    patches = patches or kinds(data)
    found = {
        title: (m, paper)
        for title, (run, paper) in SOURCES.items()
        if (m := trained(runs, run, PolyFit.load))
    }
    report = {title: on_all(m, patches) for title, (m, _) in found.items()}
    rows = [
        (title, *(both(f[kind]) for kind in patches), found[title][1])
        for title, f in report.items()
    ]
    table(
        "What it was trained on, 800 steps each, 200 of fine-tuning: height RMSE / normals °",
        ("trained on", *patches, "paper, CLOTH3D"),
        rows,
    )
    return {"sources": report}


def atlasnet(data, runs):
    """AtlasNet's table as a dictionary, printed."""
    clouds = {path: cloud(Path(data) / path) for path in HELD_OUT[: len(PAPER_ATLASNET[5])]}
    report, rows = {}, []
    for charts, paper in PAPER_ATLASNET.items():
        path = Path(runs) / f"atlasnet{charts}" / "weights.safetensors"
        if path.exists():
            found = report[charts] = {
                name: autoencoded(AtlasNet.load(path), points) for name, points in clouds.items()
            }
            rows.append(
                (
                    f"AtlasNet, {charts} charts",
                    *(f"{x:.3f} ({y:.3f})" for x, y in zip(found.values(), paper)),
                )
            )
    table(
        "AtlasNet's autoencoder, garments it has not seen: Chamfer x 1e3 (the paper's)",
        ("", *(Path(p).stem for p in clouds)),
        rows,
    )
    return {"atlasnet": report}


@torch.no_grad()
def autoencoded(model, points):
    """Symmetric Chamfer distance x 1e3 between a garment and what AtlasNet makes of it: the sum of
    both mean squared distances.
    """
    made = model(points[:1], -(-CLOUD_POINTS // model.charts), torch.Generator().manual_seed(0))[
        0, :CLOUD_POINTS
    ].numpy()
    truth = points[1].numpy()
    return 1e3 * float(
        sum((cKDTree(a).query(b)[0] ** 2).mean() for a, b in ((made, truth), (truth, made)))
    )


TABLES = {  # those that can be made alone, and their networks
    "sources": (sources, [run for run, _ in SOURCES.values()]),
    "atlasnet": (atlasnet, [f"atlasnet{charts}" for charts in PAPER_ATLASNET]),
}


def main(argv=None):
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("data", metavar="DATA")
    p.add_argument(
        "--runs",
        default="out/polyfit",
        help="where the trained networks are (default: out/polyfit)",
    )
    p.add_argument("--train", action="store_true", help="train those that are missing")
    p.add_argument("--only", choices=TABLES, help="its table alone; the others stay")
    p.add_argument("-o", "--output", default="out/benchmarks")
    args = p.parse_args(argv)
    path = Path(args.output, "polyfit_accuracy.json")
    make, networks = TABLES.get(args.only, (measure, TRAININGS))
    report = json.loads(path.read_text(encoding="utf-8")) if args.only and path.exists() else {}
    if args.train:
        train_missing(args.data, args.runs, networks)
    report["trained"] = report.get("trained", {}) | making(args.runs)
    report |= make(args.data, args.runs)
    os.makedirs(args.output, exist_ok=True)
    with (
        aside(path) as temporary,
        open(temporary, "w", encoding="utf-8") as file,
    ):
        json.dump(report, file, indent=1)
        file.write("\n")


if __name__ == "__main__":
    cli(main)
