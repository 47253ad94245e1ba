"""Sequences of garments that a body moves: drapes of OneFit, rendered by Mitsuba's path tracer.

    python benchmarks/drape_sequence.py OUT                     # trousers, long sleeves, a T-shirt
    python benchmarks/drape_sequence.py OUT --drapes shorts:squat --seed 11
    python -m polysft_mi.run scenes/tube.xml -D data=OUT/trousers_walk -o RESULT
    python -m polysft_mi.evaluate RESULT OUT/trousers_walk

A sleeve or a leg moves on its own, by centimetres a frame: what a sheet never does. Each folder has
the form of those of ``simulate.py``. The garment is denim, for the tracker's cloth hardly
stretches, simulated for 45 frames on the standard body, which stays where it is and is not drawn.
The texture's left half lies on the garment's front, its right half on its back. The seed decides
motion, light and texture.
"""

import argparse
import os

import numpy as np
from simulate_pictures import FOCAL, SIZE, render
from simulate_shapes import Shape

import onefit
from onefit.draping.draper import FPS
from onefit.motion import generate
from polyfit.backend import set_variant
from polyfit.mesh import TexCoords, face_vectors
from polysft_mi.errors import InputError, cli

FRAMES, VERTICES = 45, 1200  # of a sequence; a finer garment is remeshed to so many
FILLED = 0.8  # share of the image that the garment fills, over all frames
DRAPES = ["trousers:walk", "long_sleeve_top:arms_up", "tshirt:twist"]


def texcoords(vertices, faces):
    """A :class:`TexCoords`, front and back side by side, of vertices (N, 3) [m, camera frame]."""
    low, size = vertices[:, :2].min(0), np.ptp(vertices[:, :2], axis=0)
    u, v = ((vertices[:, :2] - low) / size).T
    back = face_vectors(vertices, faces)[:, 2] > 0
    coordinates = [np.stack([0.5 * u + half, 1 - v], 1) for half in (0, 0.5)]
    return TexCoords(np.concatenate(coordinates), faces + len(vertices) * back[:, None])


def drape(draper, name, kind, seed):
    """Vertices (FRAMES, N, 3) [m, camera frame] and faces (F, 3) of a garment in a motion."""
    garment = draper.garment(name)
    garment = garment.remeshed(VERTICES) if len(garment) > VERTICES else garment
    motion = onefit.Motion.generate(kind, seconds=FRAMES / FPS, seed=seed)
    found = draper.simulate(garment, motion, material="denim")
    x = (found.vertices - found.root[:, None])[:FRAMES].double().numpy()
    x = np.stack([x[..., 0], -x[..., 2], x[..., 1]], axis=-1)  # the body faces the camera
    low, high = x.min((0, 1)), x.max((0, 1))
    x -= (low + high) / 2
    x[..., 2] += FOCAL * max((high - low)[:2] / SIZE) / FILLED
    return x, found.faces.numpy()


def main(argv=None):
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("out", metavar="OUT")
    p.add_argument("--drapes", nargs="+", default=DRAPES, metavar="GARMENT:MOTION")
    p.add_argument("--seed", type=int, default=3)
    args = p.parse_args(argv)
    for drape_of in args.drapes:
        if drape_of.partition(":")[2] not in generate.KINDS:
            raise InputError(
                f"{drape_of}: GARMENT:MOTION is needed, of {', '.join(generate.KINDS)}"
            )
    set_variant()
    draper = onefit.load()
    for drape_of in args.drapes:
        name, _, kind = drape_of.partition(":")
        x, faces = drape(draper, name, kind, args.seed)
        width, height = np.ptp(x[0, :, :2], axis=0)
        shape = Shape(x[0], faces, texcoords(x[0], faces), np.zeros(len(faces)), 2 * width / height)
        folder = os.path.join(args.out, f"{os.path.splitext(os.path.basename(name))[0]}_{kind}")
        os.makedirs(folder, exist_ok=True)
        seen = render(folder, x, shape, np.random.default_rng(args.seed))
        x = x.astype(np.float32)
        np.savez(os.path.join(folder, "gt.npz"), vertices=x, faces=faces, seen=seen)
        print(folder, flush=True)


if __name__ == "__main__":
    cli(main)
