"""Draw ``docs/onefit_garments.png``: the eight templates on the standard body, from the front and
from behind.

python docs/onefit_garments.py                                        (half a minute)
python docs/onefit_garments.py --loose -o docs/onefit_loose.png       (those with slack)
python docs/onefit_garments.py --cuts 18 -o docs/onefit_cuts.jpg      (two minutes: random cuts, as
training draws them)
python docs/onefit_garments.py --patterns tests/onefit/garment/patterns/*.json \
    -o docs/onefit_patterns.png                                       (two minutes: sewn of panels)
"""

import argparse
import os
import tempfile

import numpy as np
import pyvista
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from onefit.garment import LOOSE, TEMPLATES, Garment, standard_body
from onefit.garment.sewing.cuts import CUTS, cuts

HERE = os.path.dirname(os.path.abspath(__file__))

WIDTH, HEIGHT, ZOOM = 300, 460, 3
SKIN, CLOTH = "#c9b29b", "#4d7ba8"


def picture(parts, direction):
    """sRGB image (H, W, 3) of ``parts`` (vertices, faces, colour), seen from ``direction`` over
    white, ZOOM times as large.
    """
    plotter = pyvista.Plotter(
        off_screen=True, window_size=(ZOOM * WIDTH, ZOOM * HEIGHT), lighting="none"
    )
    plotter.set_background("white")
    for V, F, colour in parts:
        part = pyvista.PolyData.from_regular_faces(V, F)
        plotter.add_mesh(
            part, color=colour, smooth_shading=True, ambient=0.25, diffuse=0.8, specular=0.05
        )
    right = np.cross([0, 0, 1], direction)
    for light, strength in (
        (direction - 0.9 * right + [0, 0, 0.9], 0.75),
        (direction + 1.5 * right + [0, 0, 0.2], 0.3),
    ):
        plotter.add_light(
            pyvista.Light(
                position=10 * light,
                focal_point=(0, 0, 0),
                intensity=strength,
                light_type="scene light",
            )
        )
    focus = np.array([0, -0.05, -0.01])
    plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = (
        focus + 5 * direction,
        focus,
        (0, 0, 1),
    )
    plotter.camera.parallel_projection, plotter.camera.parallel_scale = True, 0.84
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return image.reshape(HEIGHT, ZOOM, WIDTH, ZOOM, 3).mean(axis=(1, 3)).astype(np.uint8)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--cuts", type=int, metavar="N", help="N random cuts instead of the templates"
    )
    parser.add_argument(
        "--loose", action="store_true", help="the garments with slack instead of the templates"
    )
    parser.add_argument("--patterns", nargs="+", metavar="FILE", help="garments of sewing patterns")
    parser.add_argument("-o", "--output", default=os.path.join(HERE, "onefit_garments.png"))
    args = parser.parse_args()
    if args.cuts:
        with tempfile.TemporaryDirectory() as folder:
            garments = cuts(args.cuts, folder)
    elif args.patterns:
        garments = [Garment.read(path) for path in args.patterns]
    else:
        garments = [Garment.template(name) for name in (LOOSE if args.loose else TEMPLATES)]
    body = standard_body()
    skin = (body.vertices.numpy(), body.faces.numpy(), SKIN)
    columns, title = min(len(garments), len(CUTS if args.cuts else TEMPLATES)), 40
    band = 2 * HEIGHT + title  # a row of garments, seen from the front and from behind
    tall = -(-len(garments) // columns) * band
    out = Figure(figsize=(columns * WIDTH / 150, tall / 150), dpi=150)
    FigureCanvasAgg(out)
    for k, garment in enumerate(garments):
        row, column = divmod(k, columns)
        text = f"{garment.name}: {len(garment):,} vertices"
        at = (column + 0.5) / columns, 1 - (row * band + 0.5 * title) / tall
        out.text(*at, text, ha="center", va="center", fontsize=7 if args.cuts else 9)
        for behind, side in enumerate((np.array([-0.35, -1, 0.12]), np.array([0.35, 1, 0.12]))):
            below = tall - row * band - title - (behind + 1) * HEIGHT
            axes = out.add_axes((column / columns, below / tall, 1 / columns, HEIGHT / tall))
            axes.imshow(
                picture(
                    [skin, (garment.vertices.numpy(), garment.faces.numpy(), CLOTH)],
                    side / np.linalg.norm(side),
                )
            )
            axes.axis("off")
    out.savefig(args.output)
    print(f"written: {args.output}")


if __name__ == "__main__":
    main()
