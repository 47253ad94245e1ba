"""Draws docs/onefit_file.jpg: a shirt whose front is open, as its file has it, with buttons and
without, in motion.

python docs/onefit_file.py [OUT.jpg]          (a minute)
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh

from polyfit.backend import set_variant

set_variant()
import onefit  # noqa: E402
from polyfit.pictures import stage  # noqa: E402

BUTTONS, FRAMES, SIZE = 7, (8, 20, 29), (420, 330)
CLOTH, BUTTON, BODY = (0.06, 0.16, 0.35), (0.75, 0.73, 0.68), (0.5, 0.48, 0.46)


def cut_open(template, buttons):
    """``(vertices (N, 3) [m], faces (F, 3), count, sides (2, S))`` of a mesh: a template,
    its front cut open, with 6 mm between, and so many buttons on it. The first ``count`` faces are
    cloth; ``sides``: its vertices left and right of the cut.
    """
    garment = onefit.Garment.template(template)
    V, F = garment.vertices.double().numpy(), garment.faces.numpy()
    centre = V[F].mean(axis=1)
    front, right = centre[:, 1] < -0.02, centre[:, 0] > 0
    cut = np.intersect1d(F[front & right], F[front & ~right])
    other = np.arange(len(V))
    other[cut] = len(V) + np.arange(len(cut))
    faces = [np.where((front & right)[:, None], other[F], F)]
    vertices = [V, V[cut] + [0.003, 0, 0]]
    vertices[0][cut] -= [0.003, 0, 0]
    for z in np.linspace(V[cut, 2].min() + 0.03, V[cut, 2].max() - 0.02, buttons):
        place = V[cut[np.abs(V[cut, 2] - z).argmin()]] + [0.003, -0.003, 0]
        button = trimesh.creation.icosphere(2, 0.008)
        faces.append(button.faces + sum(map(len, vertices)))
        vertices.append(button.vertices * [1, 0.3, 1] + place)
    sides = np.stack([cut, other[cut]])
    return np.concatenate(vertices), np.concatenate(faces), len(F), sides


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", nargs="?", default=str(Path(__file__).parent / "onefit_file.jpg"))
    args = parser.parse_args(argv)
    draper, motion = onefit.load(), onefit.Motion.generate("dance", seconds=1, seed=1_000_005)
    rows = []
    for buttons in (BUTTONS, 0):
        vertices, faces, cloth, _ = cut_open("shirt", buttons)
        garment = onefit.Garment.of_mesh("shirt", vertices, faces)
        drape = draper.simulate(garment, motion)
        seen, chosen = drape.render_vertices(), list(FRAMES)
        parts = [(drape.body[chosen].numpy(), drape.body_faces.numpy(), BODY)]
        for some, colour in ((faces[:cloth], CLOTH), (faces[cloth:], BUTTON)):
            if len(some):
                used, own = np.unique(some, return_inverse=True)
                parts.append((seen[chosen][:, used], own.reshape(-1, 3), colour))
        images = stage.render(parts, size=SIZE, spp=25, azimuth=10, follow=True, near=1)
        rows.append(np.concatenate(list(images), axis=1))
    picture = np.concatenate(rows, axis=1)
    cv2.imwrite(args.output, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
