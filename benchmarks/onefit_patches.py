"""How much of a drape patches can hold: simulated drapes, projected onto the garments' patches.

    python benchmarks/onefit_patches.py
    python benchmarks/onefit_patches.py --garments skirt --motions dance box --patches 60

Each row is one drape on the standard body. *left* [mm] is the root mean square of what the
projection (:mod:`onefit.training.projection`) leaves; *wave*, *swing* and *strain* as
:mod:`onefit.objective.folds` has them, of the drape and of its projection.
"""

import argparse

import torch

import onefit
from onefit.body import skinning
from onefit.garment.charts import PatchedGarment
from onefit.objective.folds import folds, inner_edges
from onefit.objective.objective import posed
from onefit.training.projection import Projection, unposed
from polyfit.errors import cli

SEED = 1_000_003  # of motions, that no training uses


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", nargs="+", default=["dress", "skirt"])
    parser.add_argument("--motions", nargs="+", default=["dance"])
    parser.add_argument("--patches", type=int, help="(default: as many as a network has)")
    parser.add_argument("--seconds", type=float, default=2.0, help="of a motion (default: 2)")
    args = parser.parse_args(argv)
    draper = onefit.load()
    print("| garment | motion | patches | left | wave | kept | swing | kept | strain | kept |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in args.garments:
        garment = draper.garment(name)
        patched = PatchedGarment(garment, draper.standard, patches=args.patches)
        projection, found = Projection(patched), []
        for kind in args.motions:
            motion = onefit.Motion.generate(kind, seconds=args.seconds, seed=SEED)
            plain = draper.drape(garment, motion, skinning_only=True)
            drape = draper.simulate(garment, motion)
            motion = motion.resampled(drape.fps)
            maps = skinning.transforms(draper.standard, motion.poses, motion.translation)
            at_rest = unposed(drape.vertices, garment.blend_weights, maps)
            changes = projection(at_rest - drape.rest[:, None])
            moved = drape.rest[:, None] + patched.blend @ changes.flatten(0, 1)
            kept = posed(moved, garment.blend_weights, maps).transpose(0, 1)
            lengths = garment.rest_lengths(inner_edges(drape.faces)[0], drape.rest).double()
            found = [folds(x, plain.vertices, drape.faces, lengths) for x in (drape.vertices, kept)]
            left = 1e3 * float((kept - drape.vertices).square().sum(-1).mean().sqrt())
            pairs = [
                f"{getattr(f, column):.1f}" for column in ("wave", "swing", "strain") for f in found
            ]
            print(f"| {name} | {kind} | {len(patched)} | {left:.1f} | " + " | ".join(pairs) + " |")


if __name__ == "__main__":
    torch.manual_seed(0)
    cli(main)
