"""A garment as patches that you deform by hand: `python examples/bend_a_patch.py`.

A mesh becomes patches; the shape of each is a dozen numbers, its jet. Here one jet changes: the
coefficient of u² of the chosen patch. The surface follows, and stays whole, because neighbouring
patches overlap and are blended.

Look at out/patches/before.ply and after.ply: a bump, as wide as a patch, with smooth borders.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

import onefit
import polyfit
from polyfit.errors import cli, number

GARMENT = "tshirt"


def main(out="out/patches", patch=0, bend=0.6, parts=2):
    """Returns vertices (N, 3) [m] before and after."""
    rest = onefit.Garment.template(GARMENT)
    surface = polyfit.PatchedSurface.from_mesh(rest.vertices.numpy(), rest.faces.numpy())
    patch = number("--patch", patch, 0, len(surface) - 1, whole=True)
    bend = number("--bend", bend)
    u2 = polyfit.exponents(int(surface.order.max())).tolist().index([2, 0])
    alpha = surface.alpha.clone()
    alpha[patch, u2] += bend  # curvature, in the unit of the patch's own frame
    deformed = dataclasses.replace(surface, alpha=alpha)

    Path(out).mkdir(parents=True, exist_ok=True)
    found = []
    for name, shape in (("before", surface), ("after", deformed)):
        vertices, faces = (np.asarray(x) for x in shape.resampled(parts))
        polyfit.write_ply(Path(out) / f"{name}.ply", vertices, faces)
        found.append(vertices)
    return found


def command():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--patch", type=int, default=0)
    parser.add_argument("--bend", type=float, default=0.6)
    args = parser.parse_args()
    before, after = main(patch=args.patch, bend=args.bend)
    moved = np.linalg.norm(after - before, axis=1)
    print(
        f"{(moved > 1e-4).mean():.0%} of the vertices moved, by {1e3 * moved.max():.0f} mm at most"
    )


if __name__ == "__main__":
    cli(command)
