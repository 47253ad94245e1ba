"""Baked drapes beside the network's: size, time on one core, folds, cloth inside of the body, and
how far they are apart, in held-out motions.

    OMP_NUM_THREADS=1 python benchmarks/onefit_bake.py    # bakes, and writes docs/onefit_baked.json
    python benchmarks/onefit_bake.py --baked FOLDER       # of FOLDER/GARMENT/baked.npz

Motions are of the kinds that no baking and no network has seen, with seeds that neither has.
*wave* [degrees] and *swing* [mm] as :mod:`onefit.objective.folds` has them, of the network (with
post-processing, the teacher) and of the baked drape; *inside* [%] of the vertices; *error* [mm],
root mean square of the distance between the two, beside that of plain skinning from the network.
Times are the processor's [ms] on one core, the median (and the 5th percentile) of a frame, alone
and in a batch of 90; ``OMP_NUM_THREADS=1`` keeps NumPy on it.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from onefit_accuracy import SEED
from threadpoolctl import threadpool_limits

import onefit
from onefit.baking import Baked, bake
from onefit.body import ClosestSurface
from onefit.motion import generate
from onefit.objective.folds import folds
from polyfit.errors import cli

OUT = Path(__file__).parents[1] / "docs" / "onefit_baked.json"
FRAMES = 90


def times(baked, motion):
    """Milliseconds of the processor's time a frame: the median and the 5th percentile, alone and
    in a batch; and of the bare product of weights and shapes, which tells how fast the machine is.
    """
    poses, translation = (x.numpy()[:FRAMES] for x in (motion.poses, motion.translation))
    alone, batch, product = [], [], []
    shapes = np.ascontiguousarray(baked.shapes.reshape(len(baked.shapes), -1))
    with threadpool_limits(1):
        for _ in range(20):
            stream = baked.stream()
            for pose, place in zip(poses, translation):
                start = time.thread_time()
                stream(pose, place)
                alone.append(time.thread_time() - start)
            start = time.thread_time()
            baked.vertices(poses, translation)
            batch.append((time.thread_time() - start) / len(poses))
            start = time.thread_time()
            for _ in poses:
                np.dot(shapes[:, 0], shapes)
            product.append((time.thread_time() - start) / len(poses))
    return dict(
        ms_alone=1e3 * float(np.median(alone)),
        ms_alone_least=1e3 * float(np.percentile(alone, 5)),
        ms_batch=1e3 * float(np.median(batch)),
        ms_batch_least=1e3 * float(np.percentile(batch, 5)),
        ms_product=1e3 * float(np.median(product)),
    )


def inside(vertices, drape):
    """% of the vertices (T, N, 3) inside the body of a drape."""
    surface, found = ClosestSurface(drape.body[0], drape.body_faces), []
    for x, body in zip(vertices, drape.body):
        surface.follow(body)
        found.append(float((surface(x, 0.1).distance < 0).float().mean()))
    return 100 * float(np.mean(found))


def beside(draper, garment, baked, kind, seed, seconds):
    """The figures of one motion."""
    motion = onefit.Motion.generate(kind, seconds=seconds, seed=seed)
    drape = draper.drape(garment, motion)
    plain = draper.drape(garment, motion, skinning_only=True).vertices
    vertices = torch.tensor(baked.vertices(motion.poses.numpy(), motion.translation.numpy()))
    seen = [folds(x, plain, drape.faces, rest=drape.rest) for x in (drape.vertices, vertices)]
    apart = lambda x: 1e3 * float((x - drape.vertices).square().sum(-1).mean().sqrt())
    return dict(
        kind=kind,
        wave_network=seen[0].wave,
        wave=seen[1].wave,
        swing_network=seen[0].swing,
        swing=seen[1].swing,
        inside_network=inside(drape.vertices, drape),
        inside=inside(vertices, drape),
        error_mm=apart(vertices),
        skinning_error_mm=apart(plain),
    )


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", nargs="+", default=["tshirt", "skirt"])
    parser.add_argument("--baked", type=Path, help="folder of GARMENT/baked.npz (default: bakes)")
    parser.add_argument("--seconds", type=float, default=3.0, help="of a motion (default: 3)")
    parser.add_argument("-o", "--output", type=Path, default=OUT, help=f"(default: {OUT.name})")
    args = parser.parse_args(argv)
    draper, rows = onefit.load(), []
    print(
        "| garment | vertices | MB | ms alone | ms in batch | wave ° | of the network's % |"
        " swing mm | inside % | error mm |\n" + "|---" * 10 + "|"
    )
    for name in args.garments:
        garment = draper.garment(name)
        path = args.baked and args.baked / name / "baked.npz"
        baked = Baked.load(path) if path else bake(draper, garment)
        motions = [
            beside(draper, garment, baked, kind, SEED + k, args.seconds)
            for k, kind in enumerate(generate.HELD_OUT)
        ]
        mean = {k: float(np.mean([m[k] for m in motions])) for k in motions[0] if k != "kind"}
        took = times(baked, onefit.Motion.generate("dance", seconds=3, seed=SEED))
        about = dict(
            garment=garment.name,
            vertices=len(baked.mean),
            shapes=len(baked.shapes),
            pendulums=len(baked.hung),
            bytes=baked.size(),
        )
        row = about | took | mean
        rows.append(row | dict(motions=motions))
        print(
            f"| {row['garment']} | {row['vertices']} | {row['bytes'] / 1e6:.1f} |"
            f" {row['ms_alone']:.2f} ({row['ms_alone_least']:.2f}) |"
            f" {row['ms_batch']:.2f} ({row['ms_batch_least']:.2f}) |"
            f" {row['wave_network']:.1f} / {row['wave']:.1f} |"
            f" {100 * row['wave'] / row['wave_network']:.0f} |"
            f" {row['swing_network']:.0f} / {row['swing']:.0f} |"
            f" {row['inside_network']:.2f} / {row['inside']:.2f} |"
            f" {row['skinning_error_mm']:.1f} / {row['error_mm']:.1f} |",
            flush=True,
        )
    args.output.write_text(json.dumps(dict(garments=rows), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    cli(main)
