"""Collisions, changes of size, energy and jitter of drapes, on motions and body shapes that no
network was trained on.

    python benchmarks/onefit_accuracy.py
    python benchmarks/onefit_accuracy.py --garments jumpsuit shirt.obj \\
        --weights six-garments runs/mine/weights.safetensors

The first measures the six garments, by the networks of the package and by skinning.
Every garment is draped in each held-out kind of motion, on bodies drawn at random with a seed that
training does not use, and on the standard one. ``skinning`` is plain skinning of the template, the
baseline; ``+ post`` is with post-processing.
"""

import argparse
import json
from dataclasses import asdict

import numpy as np
import torch

import onefit
from onefit.motion import generate
from onefit.training import STANDARD
from polyfit.errors import cli

SEED = 1_000_000  # of shapes and motions, see onefit.motion.generate.HELD_OUT_SEEDS


def drapes(draper, garment, seconds, shapes, seed=SEED, **options):
    """Drapes of ``garment`` in every held-out motion, on as many bodies as ``shapes`` says and the
    standard one, in turn.
    """
    rng = np.random.default_rng(seed)
    bodies = [None] + [draper.model.random_shape(rng) for _ in range(shapes)]
    for k, kind in enumerate(generate.HELD_OUT):
        motion = onefit.Motion.generate(kind, seconds=seconds, seed=seed + k)
        yield draper.drape(garment, motion, bodies[k % len(bodies)], **options)


def mean(measures):
    rows = [asdict(m) for m in measures]
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def row(draper, garment, seconds, shapes, **options):
    return mean(drape.measures() for drape in drapes(draper, garment, seconds, shapes, **options))


HEAD = (
    "| garment | network | ε_c % | ε_c % + post | ε_e % | ε_a % | energy J | jitter mm"
    " |\n|---|---|---|---|---|---|---|---|"
)


def line(garment, network, plain, post):
    cells = [f"{plain['collision']:.2f}", "" if post is None else f"{post['collision']:.3f}"]
    cells += [
        f"{plain['edge']:.1f}",
        f"{plain['area']:.1f}",
        f"{plain['energy']:.3f}",
        f"{plain['jitter']:.2f}",
    ]
    return f"| {garment} | {network} | " + " | ".join(cells) + " |"


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", nargs="+", default=list(STANDARD), help="templates or meshes")
    parser.add_argument(
        "--weights",
        nargs="+",
        default=list(onefit.pretrained()),
        help="networks of the package, or files",
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="of each motion (default: 3)")
    parser.add_argument(
        "--shapes", type=int, default=4, help="random bodies beside the standard one (default: 4)"
    )
    parser.add_argument(
        "--no-post",
        action="store_true",
        help="without the column of post-processing, which takes most of the time",
    )
    parser.add_argument(
        "--no-ease",
        action="store_true",
        help="what the networks alone make, without the garments' ease",
    )
    parser.add_argument("-o", "--output", help="a JSON file of the figures")
    args = parser.parse_args(argv)
    drapers = {name: onefit.load(name) for name in args.weights}
    print(HEAD)
    found = []
    for name in args.garments:
        first = next(iter(drapers.values()))
        garment = first.garment(name)
        rows = [("skinning", first, dict(skinning_only=True))] + [
            (key, draper, dict(eased=not args.no_ease)) for key, draper in drapers.items()
        ]
        for network, draper, options in rows:
            plain = row(draper, garment, args.seconds, args.shapes, post=False, **options)
            post = (
                None
                if args.no_post or "skinning_only" in options
                else row(draper, garment, args.seconds, args.shapes, post=True, **options)
            )
            print(line(garment.name, network, plain, post), flush=True)
            found.append(dict(garment=garment.name, network=network, plain=plain, post=post))
    if args.output:
        with open(args.output, "w", encoding="utf-8") as file:
            json.dump(found, file, indent=2)
    return 0


if __name__ == "__main__":
    torch.manual_seed(0)
    cli(main)
