"""Draws docs/onefit.jpg: garments simulated from the drapes of a network of the package, in
held-out motions, from near.

python docs/drapes.py [OUT.jpg] [--weights NAME]          (a minute on two cores)
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from polysft_mi.backend import set_variant

set_variant()
import onefit  # noqa: E402
from onefit.network import DEFAULT  # noqa: E402
from polysft_mi.render import stage  # noqa: E402

ROWS = [  # garment, motion, shape, colour
    ("dress", "dance", None, (0.35, 0.03, 0.06)),
    ("circle_skirt", "jumping_jack", None, (0.24, 0.12, 0.02)),
    ("boxy_tshirt", "box", (0.1, 0.6, 0.6, 0.6, 0.6, 0.5), (0.06, 0.16, 0.35)),
    ("shirt", "pick_up", (0.0, 0.65, 0.5, 0.45, 0.5, 0.5), (0.25, 0.27, 0.30)),
]
FRAMES, SIZE = 4, (400, 400)
BODY = (0.5, 0.48, 0.46)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", nargs="?", default=str(Path(__file__).parent / "onefit.jpg"))
    parser.add_argument("--weights", default=DEFAULT)
    args = parser.parse_args(argv)
    draper, rows = onefit.load(args.weights), []
    for garment, motion, shape, colour in ROWS:
        moving = onefit.Motion.generate(motion, seconds=2, seed=1_000_005)
        drape = draper.simulate(garment, moving, shape)
        chosen = np.linspace(10, len(drape.vertices) - 1, FRAMES).astype(int)
        parts = [
            (drape.body[chosen].numpy(), drape.body_faces.numpy(), BODY),
            (drape.vertices[chosen].numpy(), drape.faces.numpy(), colour),
        ]
        images = stage.render(parts, size=SIZE, spp=25, follow=True, near=1)
        rows.append(np.concatenate(list(images), axis=1))
    cv2.imwrite(args.output, np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
