"""Draw ``docs/onefit_garments.png``: the seven templates on the standard body, from the front and from behind.

    python docs/onefit_garments.py            (half a minute)
"""

import argparse
import os
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))

import numpy as np  # noqa: E402
import pyvista  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from onefit.binding import standard_body  # noqa: E402
from onefit.garment import TEMPLATES, Garment  # noqa: E402

WIDTH, HEIGHT, ZOOM = 300, 460, 3
SKIN, CLOTH = "#c9b29b", "#4d7ba8"


def picture(parts, direction):
    """sRGB image (H, W, 3) of ``parts`` (vertices, faces, colour), seen from ``direction`` over white, ZOOM times as large."""
    plotter = pyvista.Plotter(off_screen=True, window_size=(ZOOM * WIDTH, ZOOM * HEIGHT), lighting="none")
    plotter.set_background("white")
    for V, F, colour in parts:
        part = pyvista.PolyData.from_regular_faces(V, F)
        plotter.add_mesh(part, color=colour, smooth_shading=True, ambient=0.25, diffuse=0.8, specular=0.05)
    right = np.cross([0, 0, 1], direction)
    for light, strength in ((direction - 0.9 * right + [0, 0, 0.9], 0.75), (direction + 1.5 * right + [0, 0, 0.2], 0.3)):
        plotter.add_light(pyvista.Light(position=10 * light, focal_point=(0, 0, 0), intensity=strength, light_type="scene light"))
    focus = np.array([0, -0.05, -0.01])
    plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = focus + 5 * direction, focus, (0, 0, 1)
    plotter.camera.parallel_projection, plotter.camera.parallel_scale = True, 0.84
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return image.reshape(HEIGHT, ZOOM, WIDTH, ZOOM, 3).mean(axis=(1, 3)).astype(np.uint8)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default=os.path.join(HERE, "onefit_garments.png"))
    args = parser.parse_args()
    body = standard_body()
    skin = (body.vertices.numpy(), body.faces.numpy(), SKIN)
    columns, rows, title = len(TEMPLATES), 2, 40
    out = Figure(figsize=(columns * WIDTH / 150, (rows * HEIGHT + title) / 150), dpi=150)
    FigureCanvasAgg(out)
    tall = rows * HEIGHT + title
    for k, name in enumerate(TEMPLATES):
        garment = Garment.template(name)
        out.text((k + 0.5) / columns, 1 - 0.5 * title / tall, f"{name}: {len(garment):,} vertices", ha="center", va="center", fontsize=9)
        for row, side in enumerate((np.array([-0.35, -1, 0.12]), np.array([0.35, 1, 0.12]))):
            axes = out.add_axes((k / columns, (1 - row) * HEIGHT / tall, 1 / columns, HEIGHT / tall))
            axes.imshow(picture([skin, (garment.vertices.numpy(), garment.faces.numpy(), CLOTH)], side / np.linalg.norm(side)))
            axes.axis("off")
    out.savefig(args.output)
    print(f"written: {args.output}")


if __name__ == "__main__":
    main()
