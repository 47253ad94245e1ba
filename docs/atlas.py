"""Draw ``docs/atlas.jpg``: the patches of templates, from the front and from behind, and how much
of a vertex one patch holds.

    python docs/atlas.py [template.obj ...]        (seconds)

By default the T-shirt of the second demo. The picture in the documentation has a tube and a ball
besides.
"""

import argparse
import os
from pathlib import Path

import cv2
import numpy as np

from polyfit import mesh
from polyfit.backend import set_variant
from polyfit.colours import patch_colours
from polysft_mi.camera import Intrinsics
from polysft_mi.surface.meshio import read_textured_template
from polysft_mi.surface.template import Template

HERE = Path(__file__).resolve().parent
SIDE, TIMES = 420, 2  # pixels of a picture, samples a pixel and axis
PIXELS = SIDE * TIMES
CAMERA = Intrinsics(5.2 * PIXELS, 5.2 * PIXELS, PIXELS / 2, PIXELS / 2, PIXELS, PIXELS)


def picture(vertices, faces, colours, turn):
    """(SIDE, SIDE, 3) uint8: the mesh with colours (N, 3) uint8 of its vertices, turned by ``turn``
    [degrees] about its upright axis."""
    from polyfit.pictures import Triangles

    angle = np.radians(turn)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[1, 0, 0], [0, 0.97, -0.24], [0, 0.24, 0.97]]) @ [
        [c, 0, s],
        [0, 1, 0],
        [-s, 0, c],
    ]
    V = vertices - (vertices.max(0) + vertices.min(0)) / 2
    V = V @ rotation.T / np.linalg.norm(V, axis=1).max()
    V += (0, 0, 12)
    toward = mesh.vertex_normals(V, faces) @ (0.35, -0.45, -0.82)
    light = 0.55 + 0.45 * np.abs(toward)
    values = (colours * light[:, None]).T
    depth, *planes = Triangles(V, faces).seen(CAMERA, values)
    image = np.where(np.isfinite(depth)[..., None], np.stack(planes, -1), 255)
    image = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def row(path, order=5):
    """The pictures of one template, side by side, and its number of patches."""
    vertices, faces, texcoords = read_textured_template(str(path))
    template = Template.fit(vertices, faces, texcoords, order, where=str(path))
    own = patch_colours(template.patch[:, :1], np.ones((len(vertices), 1)))
    blended = patch_colours(template.patch, template.weight)
    front = template.rotation[:, 2, 2].argmin()  # whose normal looks at the camera
    share = np.where(template.patch == front, template.weight, 0).sum(1)
    weight = np.stack([255 - share * (255 - x) for x in (60, 110, 165)], 1)
    shown = [(own, -35), (own, 145), (blended, -35), (weight, -35)]
    pictures = [picture(vertices, faces, c, turn) for c, turn in shown]
    image = np.concatenate(pictures, axis=1)
    used = np.flatnonzero((image < 255).any(axis=(1, 2)))
    return image[max(0, used[0] - 12) : used[-1] + 12], len(template)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shirt = HERE.parent / "scenes" / "demo_shirt" / "template.obj"
    parser.add_argument("templates", nargs="*", default=[str(shirt)])
    parser.add_argument("-o", "--output", default=os.path.join(HERE, "atlas.jpg"))
    args = parser.parse_args()
    set_variant()
    rows = []
    for path in args.templates:
        pictures, count = row(path)
        print(f"{path}: {count} patches")
        rows.append(pictures)
    image = np.concatenate(rows)[..., ::-1]
    cv2.imwrite(args.output, image, [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(args.output)


if __name__ == "__main__":
    main()
