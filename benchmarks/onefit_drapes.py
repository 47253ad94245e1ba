"""Drapes and simulations of every garment: collisions of vertices and faces, strain, jitter, folds,
swing, and its time.

    python benchmarks/onefit_drapes.py
    python benchmarks/onefit_drapes.py --garments skirt shirt.obj --steps 3 --material denim
    python benchmarks/onefit_drapes.py --steps 0        # without simulations: quick

Every garment is draped in each held-out kind of motion, on the standard body and on others drawn at
random in turn: by skinning, by the networks alone (without ease), by the networks with ease and
post-processing, and by a simulation that starts from the first of them. Columns:
*inside* [%] of the vertices; *faces* [%] of points of the faces, no farther apart than 5 mm, in
every third frame; *room* [%], those of them that lie where cloth has room, which it has not where
the body overlaps itself, or skin faces skin at less than 12 mm; *strain* [%], *wave* [degrees],
*swing* [mm] as :mod:`onefit.objective.folds` has them; *jitter* [mm], the mean second difference in
time; *energy* [J] of the material: stretching, bending, and weight as seen from the hips;
*crossings*, pairs of faces that pass through each other; *ms*, the median of the frames, and
*settle* [s], of one drape of the first motion.
"""

import argparse
import time

import numpy as np
import torch
from onefit_accuracy import SEED

import onefit
from onefit.body import ClosestSurface
from onefit.motion import generate
from onefit.network import DEFAULT
from onefit.objective import crossings
from onefit.objective.folds import folds, inner_edges
from onefit.physics import MATERIALS, Material
from onefit.physics.sheet import Sheet, bending, potential, stretching
from onefit.training import STANDARD
from polyfit.errors import cli

SPACING, FRAME_STEP = 0.005, 3  # [m] of the faces' points; one frame in so many is looked at
HEAD = (
    "| garment | | inside % | faces % | room % | strain % | jitter mm | wave ° | swing mm |"
    " energy J | crossings | ms | settle s |"
)
DIGITS = (3, 3, 3, 2, 1, 1, 0, 2, 1)
ROOM = 0.012  # [m] between skin and skin, below which a place counts as too narrow for cloth


def face_points(rest, faces):
    """Corners (P, 3) and weights (P, 3) of points of the faces (F, 3) that lie SPACING from each
    other, or nearer.
    """
    sides = rest[faces] - rest[faces].roll(1, 1)
    parts = torch.ceil(sides.norm(dim=-1).amax(1) / SPACING).long()
    corners, weights = [], []
    for n in parts.unique().tolist():
        i, j = torch.meshgrid(torch.arange(n + 1), torch.arange(n + 1), indexing="ij")
        grid = torch.stack([i, j, n - i - j], -1).reshape(-1, 3).float() / n
        grid = grid[grid[:, 2] >= 0]
        of = faces[parts == n]
        corners.append(of.repeat_interleave(len(grid), 0))
        weights.append(grid.repeat(len(of), 1))
    return torch.cat(corners), torch.cat(weights)


def energy(drape, garment, material):
    """Of a drape [J], a mean over frames; heights are counted from the root."""
    sides = None if garment.cut is None else garment.sides(drape.rest).double().numpy()
    sheet = Sheet(drape.rest.double().numpy(), drape.faces.numpy(), material, sides)
    x = (drape.vertices - drape.root[:, None]).transpose(0, 1).double()
    return float((stretching(x, sheet) + bending(x, sheet) + potential(x, sheet)).mean())


def figures(drape, plain, garment, material):
    """The row's numbers of one drape; ``plain``: the same by skinning."""
    edges = inner_edges(drape.faces)[0]
    found = folds(
        drape.vertices,
        plain.vertices,
        drape.faces,
        garment.rest_lengths(edges, drape.rest).double(),
    )
    surface = ClosestSurface(drape.body[0], drape.body_faces)
    corners, weights = face_points(drape.rest, drape.faces)
    inside, roomy = [], []
    for x, body in zip(drape.vertices[::FRAME_STEP], drape.body[::FRAME_STEP]):
        surface.follow(body)
        points = (x[corners] * weights[..., None]).sum(1)
        nearest = surface(points, 0.05)
        wrong = nearest.distance < 0
        between = (nearest.point + ROOM * 2 / 3 * nearest.normal)[wrong]
        inside.append(int(wrong.sum()) / len(points))
        roomy.append(int((surface(between, ROOM).distance > ROOM / 3).sum()) / len(points))
    measures = drape.measures()
    return [
        measures.collision, 100 * np.mean(inside), 100 * np.mean(roomy), found.strain,
        measures.jitter, found.wave, found.swing, energy(drape, garment, material),
        np.mean([crossings(x, drape.faces.numpy()) for x in drape.vertices[::FRAME_STEP].numpy()]),
    ]  # fmt: skip


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", nargs="+", default=[*STANDARD, "skirt", "jumpsuit"])
    parser.add_argument("--weights", nargs="+", default=[DEFAULT], help="of networks")
    parser.add_argument("--steps", type=int, default=2, help="of cloth, a frame; 0: no simulation")
    parser.add_argument("--no-ease", dest="eased", action="store_false", help="of the drapes")
    parser.add_argument("--material", default="cotton", choices=list(MATERIALS))
    parser.add_argument("--motions", nargs="+", default=list(generate.HELD_OUT), metavar="KIND")
    parser.add_argument("--seconds", type=float, default=1.0, help="of a motion (default: 1)")
    parser.add_argument("--shapes", type=int, default=2, help="random bodies (default: 2)")
    args = parser.parse_args(argv)
    drapers = {name: onefit.load(name) for name in args.weights}
    first, draper = next(iter(drapers.items()))
    material, rng = Material.named(args.material), np.random.default_rng(SEED)
    bodies = [None] + [draper.model.random_shape(rng) for _ in range(args.shapes)]
    motions = [
        onefit.Motion.generate(kind, seconds=args.seconds, seed=SEED + k)
        for k, kind in enumerate(args.motions)
    ]
    print(HEAD, "|---" * HEAD.count(" |") + "|", sep="\n")
    how = dict(steps=args.steps, material=material)
    for name in args.garments:
        garment, table, times = draper.garment(name), {}, None
        for k, motion in enumerate(motions):
            body = bodies[k % len(bodies)]
            plain, ends = draper.drape(garment, motion, body, skinning_only=True), []
            drapes = {"skinning": plain}
            for of, other in drapers.items():
                drapes[of] = other.drape(garment, motion, body, post=False, eased=False)
                drapes[f"{of}, post"] = other.drape(garment, motion, body, eased=args.eased)
            if args.steps:
                ends.append(time.perf_counter())
                tick = lambda: ends.append(time.perf_counter())
                made = draper.simulate(garment, motion, body, **how, advance=tick)
                drapes[f"{first}, simulated"] = made
                times = times or (1e3 * float(np.median(np.diff(ends[1:]))), ends[1] - ends[0])
            for row, found in drapes.items():
                table.setdefault(row, []).append(figures(found, plain, garment, material))
        for row, found in table.items():
            last = f"{times[0]:.0f} | {times[1]:.1f}" if row.endswith("simulated") else " | "
            cells = [f"{x:.{n}f}" for x, n in zip(np.mean(found, axis=0), DIGITS)]
            print(
                "| " + " | ".join([garment.name, row, *cells, last]) + " |",
                flush=True,
            )


if __name__ == "__main__":
    cli(main)
