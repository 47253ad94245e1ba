"""Draws docs/onefit.jpg: garments draped by a network of the package, in held-out motions,
path-traced.

python docs/drapes.py [OUT.jpg] [--weights six-garments]
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from polysft_mi.backend import set_variant

set_variant()
import onefit  # noqa: E402
from polysft_mi.render import stage  # noqa: E402

ROWS = [  # garment, motion, shape, colour
    ("dress", "dance", None, (0.35, 0.03, 0.06)),
    ("skirt", "jumping_jack", None, (0.24, 0.12, 0.02)),
    ("long_sleeve_top", "box", (0.1, 0.6, 0.6, 0.6, 0.6, 0.5), (0.06, 0.16, 0.35)),
    ("trousers", "sneak", (0.0, 0.65, 0.5, 0.45, 0.5, 0.5), (0.05, 0.09, 0.07)),
]
FRAMES, SIZE = 6, (380, 300)
BODY = (0.5, 0.48, 0.46)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", nargs="?", default=str(Path(__file__).parent / "onefit.jpg"))
    parser.add_argument("--weights", default="six-garments")
    args = parser.parse_args(argv)
    draper, rows = onefit.load(args.weights), []
    for garment, motion, shape, colour in ROWS:
        drape = draper.drape(
            garment, onefit.Motion.generate(motion, seconds=3, seed=1_000_005), shape
        )
        chosen = np.linspace(8, len(drape.vertices) - 1, FRAMES).astype(int)
        parts = [
            (drape.body[chosen].numpy(), drape.body_faces.numpy(), BODY),
            (drape.vertices[chosen].numpy(), drape.faces.numpy(), colour),
        ]
        rows.append(
            np.concatenate(list(stage.render(parts, size=SIZE, spp=100, follow=True)), axis=1)
        )
    cv2.imwrite(args.output, np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
