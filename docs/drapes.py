"""Draws docs/onefit.jpg: garments simulated from the drapes of a network of the package, in
held-out motions, from near; with --outfits docs/onefit_outfits.jpg, several at once.

python docs/drapes.py [OUT.jpg] [--outfits] [--weights NAME]          (a minute on two cores)
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from polyfit.backend import set_variant

set_variant()
import onefit  # noqa: E402
from onefit.network import DEFAULT  # noqa: E402
from polyfit.pictures import stage  # noqa: E402

ROWS = [  # garments, motion, shape, colours
    (["dress"], "dance", None, [(0.35, 0.03, 0.06)]),
    (["circle_skirt"], "jumping_jack", None, [(0.24, 0.12, 0.02)]),
    (["boxy_tshirt"], "box", (0.1, 0.6, 0.6, 0.6, 0.6, 0.5), [(0.06, 0.16, 0.35)]),
    (["shirt"], "pick_up", (0.0, 0.65, 0.5, 0.45, 0.5, 0.5), [(0.25, 0.27, 0.30)]),
]
OUTFITS = [
    (["trousers", "tshirt"], "dance", None, [(0.03, 0.06, 0.16), (0.42, 0.12, 0.06)]),
    (
        ["wide_trousers", "tshirt", "shirt"],
        "box",
        None,
        [(0.24, 0.12, 0.02), (0.45, 0.43, 0.38), (0.06, 0.16, 0.12)],
    ),
    (
        ["trousers", "waisted_dress"],
        "jumping_jack",
        (0.0, 0.65, 0.5, 0.45, 0.5, 0.5),
        [(0.03, 0.03, 0.04), (0.35, 0.03, 0.06)],
    ),
]
FRAMES, SIZE = 4, (400, 400)
BODY = (0.5, 0.48, 0.46)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", nargs="?")
    parser.add_argument("--outfits", action="store_true")
    parser.add_argument("--weights", default=DEFAULT)
    args = parser.parse_args(argv)
    draper, rows = onefit.load(args.weights), []
    for garments, motion, shape, colours in OUTFITS if args.outfits else ROWS:
        seconds = 1 if args.outfits else 2
        moving = onefit.Motion.generate(motion, seconds=seconds, seed=1_000_005)
        drapes = draper.simulate(garments, moving, shape)
        chosen = np.linspace(10, len(drapes[0].vertices) - 1, FRAMES).astype(int)
        body = drapes[0].body[chosen].numpy(), drapes[0].body_faces.numpy(), BODY
        at = [(d.vertices[chosen].numpy(), d.faces.numpy()) for d in drapes]
        parts = [body, *((*part, colour) for part, colour in zip(at, colours))]
        view = dict(size=(520, 400)) if args.outfits else dict(size=SIZE, near=1)
        images = stage.render(parts, spp=25, follow=True, **view)
        rows.append(np.concatenate(list(images), axis=1))
    name = "onefit_outfits.jpg" if args.outfits else "onefit.jpg"
    output = args.output or str(Path(__file__).parent / name)
    cv2.imwrite(output, np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
