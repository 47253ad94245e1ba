"""Several garments at once: how well the outer ones stay outside of the inner ones, and what that
costs.

    python benchmarks/onefit_outfits.py -o docs/onefit_outfits.json

Each outfit is draped and simulated, in motions of training and one that is held out, on the
standard body. *beneath* [%]: vertices of outer garments that lie beneath an inner one: the point of
it nearest to them, within 5 cm, is not on its rim, and they are on its inner side; *deep* [mm]: the
99th percentile of how far. *inside* [%]: vertices of all garments in the body. *between*, *within*:
pairs of faces that pass through each other, of two garments and of one, for 1,000 faces; *_apart*:
the same of garments that are draped each for itself. *ms*: a frame; *alone*: the sum of the same
of the garments alone, in the same run.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from onefit_accuracy import SEED

import onefit
from onefit.network import DEFAULT
from onefit.objective import crossings, depths_beneath
from polyfit.errors import cli

OUTFITS = "trousers+tshirt", "tshirt+shirt", "trousers+waisted_dress"
MOTIONS = "walk", "dance", "jumping_jack"  # the last two are held out
FRAME_STEP = 5  # one frame in so many is looked at


def figures(drapes):
    """The figures of an outfit's drapes, but for the times."""
    pairs = [(a, b) for k, b in enumerate(drapes) for a in drapes[:k]]
    seen = lambda drape: drape.vertices[::FRAME_STEP]
    depths = [depths_beneath(seen(b), seen(a), a.faces) for a, b in pairs]
    deep = np.concatenate([x.ravel() for x in depths])
    faces = [d.faces.numpy() for d in drapes]
    first = np.cumsum([0, *(d.vertices.shape[1] for d in drapes)])
    joined = np.concatenate([f + n for f, n in zip(faces, first)])
    within, between = [], []
    for t in range(0, len(drapes[0].vertices), FRAME_STEP):
        at = [d.vertices[t].numpy() for d in drapes]
        within.append(sum(crossings(x, f) for x, f in zip(at, faces)))
        between.append(crossings(np.concatenate(at), joined) - within[-1])
    count = [d.vertices.shape[1] for d in drapes]
    inside = np.average([d.measures().collision for d in drapes], weights=count)
    return dict(
        beneath=round(100 * float((deep > 0).mean()), 3),
        deep=round(1e3 * float(np.quantile(deep, 0.99)), 1),
        inside=round(float(inside), 3),
        between=round(1e3 * float(np.mean(between)) / len(joined), 2),
        within=round(1e3 * float(np.mean(within)) / len(joined), 2),
    )


def cost(act, what, motion):
    """What ``act`` makes of garments, and what a frame takes [ms]: the median of a simulation's,
    which settles first; of drapes, what the frames after the first two add.
    """

    def run(motion):
        ends = [time.perf_counter()]
        made = act(what, motion, advance=lambda: ends.append(time.perf_counter()))
        return made, np.diff([*ends, time.perf_counter()])

    made, frames = run(motion)
    if act.__name__ == "simulate":
        return made, 1e3 * float(np.median(frames[1:]))
    begin = replace(motion, poses=motion.poses[:2], translation=motion.translation[:2])
    once = min(run(begin)[1].sum() for _ in range(2))
    whole = min(frames.sum(), run(motion)[1].sum())
    return made, 1e3 * float(whole - once) / (len(motion) - 2)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", metavar="FILE.json")
    parser.add_argument("--outfits", nargs="+", metavar="A+B", default=OUTFITS)
    parser.add_argument("--motions", nargs="+", default=MOTIONS)
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument(
        "--verbs", nargs="+", default=("drape", "simulate"), choices=("drape", "simulate")
    )
    parser.add_argument("--seconds", type=float, default=1.0)
    args = parser.parse_args(argv)
    draper, rows = onefit.load(args.weights), []
    for kind in args.motions:
        motion = onefit.Motion.generate(kind, seconds=args.seconds, seed=SEED)
        for outfit in args.outfits:
            names = outfit.split("+")
            for name in names:
                draper.ease(draper.garment(name))  # cut and tried on once
            for verb in args.verbs:
                act = getattr(draper, verb)
                alone = [cost(act, name, motion) for name in names]
                drapes, ms = cost(act, names, motion)
                apart = figures([drape for drape, _ in alone])
                row = dict(outfit=outfit, motion=kind, verb=verb, **figures(drapes))
                row |= {f"{name}_apart": apart[name] for name in ("beneath", "between", "within")}
                row |= dict(ms=round(ms, 1), alone=round(sum(one for _, one in alone), 1))
                rows.append(row)
                print(json.dumps(row), flush=True)
                if args.output:
                    Path(args.output).write_text(
                        json.dumps(rows, indent=1) + "\n", encoding="utf-8"
                    )


if __name__ == "__main__":
    cli(main)
