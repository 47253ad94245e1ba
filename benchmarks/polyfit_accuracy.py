"""How closely jets fit patches of garments that were not trained on: by order, with and without the spatial transformer, against networks that regress jets.

    python benchmarks/polyfit_accuracy.py DATA [--runs out/polyfit] [--train] [-o out/benchmarks]

DATA holds ``garments_snug`` and ``garments_makehuman``. The networks are read from RUNS, where ``--train`` makes those that are missing, each by the command
that ``TRAININGS`` gives; without them the tables have what ships with the package. The held-out garments (``HELD_OUT``) are whole ones that no training saw.

Kinds of patches, each sampled at 256 points:

    as made    cut at the paper's number K, as they are
    large      cut into 10 patches
    posed      cut into 10, 25 and 100 patches, each then taken through a random smooth map of its own (polyfit.deformations: stretched, bent, waved)
    folded     of large and posed: those that the PCA frame sees to more than 5 % from behind, so that they are no height graphs over its plane, though they are
               over another: of 65 axes over the half sphere one at least sees at most 1 % from behind. This is what a better frame can mend; the choice
               asks the surfaces' normals alone, no fit. The difficult kind.

Figures are means over patches, of the jets fitted to all 256 points: RMS of height in the chart's unit s (the paper's measure), of distance to the surface
in s (which no frame can make small by looking at a fold from its edge), and the mean angle between the jet's normals and the mesh's. The paper's figures are of CLOTH3D, which is
not free to use here; they stand beside ours for their ratios.

Writes ``polyfit_accuracy.json``.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from polyfit import garments, jets
from polyfit.baselines.regressors import DGCNN, PointNet
from polyfit.errors import InputError, cli
from polyfit.files import aside
from polyfit.frames import CanonicalFrame, rotation_matrix
from polyfit.losses import behind, discrepancy
from polyfit.stn import PatchFit, PolyFit, SpatialTransformer
from polyfit.training_set import axes, rotations_to

TRAINED_ON = [f"garments_makehuman/{name}.obj" for name in ("f_tshirt", "f_shorts", "f_leggings", "m_sweater", "m_trousers", "m_tshirt_fine")]
HELD_OUT = [
    *(f"garments_snug/{name}.obj" for name in ("tshirt", "tank", "long_sleeve_top", "shorts", "pants")),
    *(f"garments_makehuman/{name}.obj" for name in ("f_skirt", "m_dungarees", "m_shirt_wrinkled")),
]
TRAININGS = {  # folder in RUNS: options of python -m polyfit.train, whether on garments
    "main": ([], True),
    "families": ([], False),
    "gaussian": (["--families", "gaussian"], False),
    "pointnet": (["--model", "pointnet"], True),
    "dgcnn": (["--model", "dgcnn"], True),
}
POINTS, ORDER, ORDERS = 256, 4, range(1, 9)
LARGE, POSED_CUTS, POSED = 10, (10, 25, 100), 4000
FOLDED, GRAPH = 0.05, 0.01
FIGURES = ("height", "distance", "angle")


def kinds(data, seed=1):
    """The held-out patches by kind: :class:`garments.GarmentPatches`."""
    paths = [Path(data) / name for name in HELD_OUT]
    missing = [str(p) for p in paths if not p.exists()]
    if missing:
        raise InputError(f"{missing[0]}: no such file; DATA holds garments_snug and garments_makehuman")
    out = {"as made": garments.cut_meshes(paths, (None,), POINTS, seed), "large": garments.cut_meshes(paths, (LARGE,), POINTS, seed)}
    # every cut weighs the same, though a fine one has more patches
    each = [garments.cut_meshes(paths, (cut,), POINTS, seed) for cut in POSED_CUTS]
    generator = torch.Generator().manual_seed(seed)
    out["posed"] = garments.GarmentPatches.join([g.deformed(POSED // len(each), generator) for g in each])
    both = garments.GarmentPatches.join([out["large"], out["posed"]])
    folded = is_folded(both)
    out["folded"] = garments.GarmentPatches(both.points[folded], both.normals[folded])
    return out


def is_folded(patches):
    """Which patches are no height graphs over their PCA plane, but are over another, (M,)."""
    normals = patches.normals @ CanonicalFrame.from_points(patches.points).R
    seen = torch.stack([behind(normals @ turn) for turn in rotations_to(axes())], 1)
    return (seen[:, 0] > FOLDED) & (seen.amin(1) <= GRAPH)


class Tilted(torch.nn.Module):
    """A transformer that has learned nothing: the turns that training starts from."""

    def __init__(self, points=64):
        super().__init__()
        fresh = SpatialTransformer(points=points)
        self.points, self.turns = points, torch.nn.functional.normalize(fresh.head[-1].bias.detach().unflatten(0, (-1, 4)), dim=-1)

    def forward(self, x, mask=None):
        return torch.cat([torch.tensor([[0.0, 0, 0, 1]]), self.turns]).expand(len(x), -1, -1)


class BestAxis:
    """What an exhaustive search over 65 axes reaches, by the height of the fit: the most that any transformer can."""

    def __call__(self, points):
        frame = CanonicalFrame.from_points(points)
        x = frame.to_chart(points)
        heights = []
        for turn in rotations_to(axes()):
            y = x @ turn
            heights.append((jets.height(jets.fit(y, ORDER).alpha, y[..., :2]) - y[..., 2]).square().mean(-1))
        R = frame.R @ rotations_to(axes())[torch.stack(heights, 1).argmin(1)]
        frame = CanonicalFrame(frame.s, R, frame.T)
        return PatchFit(frame, jets.fit(frame.to_chart(points), ORDER))


@torch.no_grad()
def figures(model, patches):
    """Means over the patches of what ``model`` (points -> PatchFit) leaves."""
    parts = []
    for first in range(0, len(patches.points), 512):
        points, normals = patches.points[first : first + 512], patches.normals[first : first + 512]
        fit = model(points)
        parts.append(discrepancy(fit.jet.alpha, fit.frame.to_chart(points), normals @ fit.frame.R))
    return {name: torch.cat([getattr(p, name) for p in parts]).mean().item() for name in FIGURES}


@torch.no_grad()
def milliseconds(model, seconds=3.0):
    """Median time a patch [ms] in batches of 512 patches of 256 points."""
    points = torch.randn(512, POINTS, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 0.7, 0.2])
    model(points)
    times, end = [], time.monotonic() + seconds
    while time.monotonic() < end or len(times) < 5:
        start = time.perf_counter()
        model(points)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times)) / len(points)


def trained(runs, name, load):
    path = Path(runs) / name / "weights.safetensors"
    if not path.exists():
        return None
    made = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    seen = {Path(m).name for m in made["meshes"]} & {Path(m).name for m in HELD_OUT}
    if seen:
        raise InputError(f"{path}: trained on {', '.join(sorted(seen))}, which this benchmark holds out")
    return load(path, ORDER)


def train_missing(data, runs, say=print):
    for name, (options, on_garments) in TRAININGS.items():
        if not (Path(runs) / name / "weights.safetensors").exists():
            meshes = [str(Path(data) / m) for m in TRAINED_ON] if on_garments else []
            say(f"training {name}")
            subprocess.run([sys.executable, "-m", "polyfit.train", *meshes, "-o", str(Path(runs) / name), *options], check=True, cwd=ROOT)


def table(title, head, rows):
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def shown(f):
    return f"{f['height']:.4f}", f"{f['distance']:.4f}", f"{f['angle']:.2f}"


def measure(data, runs):
    """All tables as a dictionary, printed on the way."""
    patches = kinds(data)
    main = trained(runs, "main", PolyFit.load) or PolyFit.pretrained(ORDER)
    report = {"patches": {k: len(v.points) for k, v in patches.items()}}

    frames = {"PCA": PolyFit(ORDER), "five fixed tilts, no network": PolyFit(ORDER, Tilted()), "with the STN": main, "search over 65 axes": BestAxis()}
    report["frames"] = {kind: {name: figures(m, p) for name, m in frames.items()} for kind, p in patches.items()}
    rows = []
    for kind, found in report["frames"].items():
        for name, f in found.items():
            rows.append((f"{kind} ({len(patches[kind].points)})", name, *shown(f), f"{100 * (1 - f['height'] / found['PCA']['height']):.1f} %"))
    rows.append(("paper: CLOTH3D", "PCA", "0.0259", "", "5.47", ""))
    rows.append(("paper: CLOTH3D", "with the STN", "0.0201", "", "5.27", "22.4 %"))
    table("Frames, order 4", ("patches", "frame", "height RMSE", "distance RMS", "normals °", "height below PCA's"), rows)

    report["orders"] = {}
    rows = []
    for order in ORDERS:
        with_stn = PolyFit(order, main.stn).eval()
        found = {kind: {"PCA": figures(PolyFit(order), patches[kind]), "STN": figures(with_stn, patches[kind])} for kind in ("as made", "folded")}
        report["orders"][order] = found
        rows.append((str(order), *(f"{found[k][m]['height']:.4f} / {found[k][m]['angle']:.2f}" for k in found for m in found[k])))
    table("Orders: height RMSE / normals °", ("order", "as made, PCA", "as made, STN", "folded, PCA", "folded, STN"), rows)

    models = {"PolyFit without STN": PolyFit(ORDER), "PolyFit": main}
    for name, kind in (("pointnet", PointNet), ("dgcnn", DGCNN)):
        models |= {kind.__name__: m for m in [trained(runs, name, kind.load)] if m}
    report["regressors"] = {name: {kind: figures(m, p) for kind, p in patches.items()} | {"ms": milliseconds(m)} for name, m in models.items()}
    report["threads"] = torch.get_num_threads()
    rows = [(n, *(f"{f[k]['height']:.4f} / {f[k]['angle']:.2f}" for k in patches), f"{f['ms']:.4f}") for n, f in report["regressors"].items()]
    rows += [("paper: PolyFit", "0.0201 / 5.27", "", "", "", "0.0481"), ("paper: PointNet", "0.0309 / 6.94", "", "", "", "0.0754")]
    rows.append(("paper: DGCNN", "0.0290 / 6.41", "", "", "", "0.0625"))
    table(f"Networks: height RMSE / normals °; time on {report['threads']} thread(s)", ("network", *patches, "ms a patch"), rows)

    sources = {"Gaussians only": "gaussian", "4 families": "families", "4 families + garment patches": "main"}
    found = {title: model for title, run in sources.items() if (model := trained(runs, run, PolyFit.load))}
    report["sources"] = {title: {kind: figures(m, p) for kind, p in patches.items()} for title, m in found.items()}
    paper = {"Gaussians only": "0.0248 / 5.49", "4 families": "0.0239 / 5.42", "4 families + garment patches": "0.0201 / 5.32"}
    rows = [(title, *(f"{f[k]['height']:.4f} / {f[k]['angle']:.2f}" for k in patches), paper[title]) for title, f in report["sources"].items()]
    table("What it was trained on: height RMSE / normals °", ("trained on", *patches, "paper, CLOTH3D"), rows)
    return report


def main(argv=None):
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("data", metavar="DATA")
    p.add_argument("--runs", default="out/polyfit", help="where the trained networks are (default: out/polyfit)")
    p.add_argument("--train", action="store_true", help="train those that are missing")
    p.add_argument("-o", "--output", default="out/benchmarks")
    args = p.parse_args(argv)
    if args.train:
        train_missing(args.data, args.runs)
    report = measure(args.data, args.runs)
    os.makedirs(args.output, exist_ok=True)
    with aside(os.path.join(args.output, "polyfit_accuracy.json")) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump(report, file, indent=2)


if __name__ == "__main__":
    cli(main)
