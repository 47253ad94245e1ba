"""Draws docs/onefit_baked.jpg: drapes by the network, above, and baked, below, in held-out motions.

python docs/onefit_baked.py OUT/skirt/baked.npz OUT/tshirt/baked.npz ...      (a minute)
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from polyfit.backend import set_variant

set_variant()
import onefit  # noqa: E402
from onefit.baking import Baked  # noqa: E402
from polyfit.pictures import stage  # noqa: E402

MOTIONS, AT, SIZE = ("dance", "jumping_jack"), (0.45, 0.9), (400, 330)
BODY, COLOURS = (0.5, 0.48, 0.46), ((0.06, 0.16, 0.35), (0.35, 0.03, 0.06), (0.24, 0.12, 0.02))


def main(paths):
    draper, rows = onefit.load(), ([], [])
    for k, path in enumerate(paths):
        baked = Baked.load(path)
        motion = onefit.Motion.generate(MOTIONS[k % len(MOTIONS)], seconds=3, seed=1_000_005)
        drape = draper.drape(baked.name, motion)
        found = baked.vertices(motion.poses.numpy(), motion.translation.numpy())
        chosen = (np.array(AT) * (len(motion) - 1)).astype(int)
        body = drape.body[chosen].numpy(), drape.body_faces.numpy(), BODY
        for row, vertices in zip(rows, (drape.vertices.numpy(), found)):
            cloth = np.ascontiguousarray(vertices[chosen]), baked.faces, COLOURS[k % len(COLOURS)]
            row.extend(stage.render([body, cloth], size=SIZE, spp=25, follow=True, near=1))
    picture = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    out = Path(__file__).parent / "onefit_baked.jpg"
    cv2.imwrite(str(out), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("baked", nargs="+", help="baked.npz of a garment")
    main(parser.parse_args().baked)
