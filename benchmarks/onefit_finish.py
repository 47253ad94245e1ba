"""What the finish makes of every garment: collisions of vertices and faces, strain, jitter, folds,
swing, and its time.

    python benchmarks/onefit_finish.py
    python benchmarks/onefit_finish.py --garments skirt shirt.obj --finish 3 --material denim

Every garment is draped in each held-out kind of motion, on the standard body and on others drawn at
random in turn: by skinning, by the network, and by the network with a finish. Columns: *inside* [%]
of the vertices; *faces* [%] of points of the faces, no farther apart than 5 mm, in every third
frame; *strain* [%], *wave* [degrees], *swing* [mm] as :mod:`onefit.objective.folds` has them;
*jitter* [mm], the mean second difference in time; *ms*, the median of the frames, and *settle* [s],
of one drape of the first motion.
"""

import argparse
import time

import numpy as np
import torch
from onefit_accuracy import SEED

import onefit
from onefit.body import ClosestSurface
from onefit.motion import generate
from onefit.objective.folds import folds, inner_edges
from onefit.physics import MATERIALS
from onefit.training import STANDARD
from polyfit.errors import cli

SPACING, FRAME_STEP = 0.005, 3  # [m] of the faces' points; one frame in so many is looked at


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


def figures(drape, plain, garment):
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
    inside = []
    for x, body in zip(drape.vertices[::FRAME_STEP], drape.body[::FRAME_STEP]):
        surface.follow(body)
        points = (x[corners] * weights[..., None]).sum(1)
        inside.append(float((surface(points, 0.05).distance < 0).float().mean()))
    measures = drape.measures()
    return [
        measures.collision, 100 * np.mean(inside), found.strain, measures.jitter, found.wave,
        found.swing,
    ]  # fmt: skip


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", nargs="+", default=[*STANDARD, "skirt", "jumpsuit"])
    parser.add_argument("--weights", default="six-garments", help="(default: six-garments)")
    parser.add_argument("--finish", type=int, default=2, help="steps a frame (default: 2)")
    parser.add_argument("--material", default="cotton", choices=list(MATERIALS))
    parser.add_argument("--motions", nargs="+", default=list(generate.HELD_OUT), metavar="KIND")
    parser.add_argument("--seconds", type=float, default=1.0, help="of a motion (default: 1)")
    parser.add_argument("--shapes", type=int, default=2, help="random bodies (default: 2)")
    args = parser.parse_args(argv)
    draper = onefit.load(args.weights)
    rng = np.random.default_rng(SEED)
    bodies = [None] + [draper.model.random_shape(rng) for _ in range(args.shapes)]
    motions = [
        onefit.Motion.generate(kind, seconds=args.seconds, seed=SEED + k)
        for k, kind in enumerate(args.motions)
    ]
    print("| garment | | inside | faces | strain | jitter | wave | swing | ms | settle |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    finish = dict(finish=args.finish, material=args.material)
    for name in args.garments:
        garment, table = draper.garment(name), {}
        draper.ease(garment)
        for k, motion in enumerate(motions):
            drape = lambda **how: draper.drape(garment, motion, bodies[k % len(bodies)], **how)
            plain, ends = drape(skinning_only=True), [time.perf_counter()]
            finished = drape(**finish, advance=lambda: ends.append(time.perf_counter()))
            table.setdefault("time", [ends[1] - ends[0], float(np.median(np.diff(ends[1:])))])
            for row, found in {
                "skinning": plain, args.weights: drape(), f"{args.weights}, finished": finished,
            }.items():  # fmt: skip
                table.setdefault(row, []).append(figures(found, plain, garment))
        settle, frame = table.pop("time")
        for row, found in table.items():
            times = f"{1e3 * frame:.0f} | {settle:.1f}" if row.endswith("finished") else " | "
            inside, faces, strain, jitter, wave, swing = np.mean(found, axis=0)
            print(
                f"| {garment.name} | {row} | {inside:.3f} | {faces:.3f} | {strain:.2f}"
                f" | {jitter:.1f} | {wave:.1f} | {swing:.0f} | {times} |",
                flush=True,
            )


if __name__ == "__main__":
    cli(main)
