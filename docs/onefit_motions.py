"""Draw ``docs/onefit_motions.png``: every kind of generated motion, eight moments of each from left
to right.

python docs/onefit_motions.py        (a minute)
"""

import argparse
import os

import numpy as np
import pyvista
from PIL import Image, ImageDraw

from onefit.body import AnnyBody, skinning
from onefit.motion import Motion, generate
from polyfit.files import aside

HERE = os.path.dirname(os.path.abspath(__file__))

MOMENTS, SECONDS, SEED, COLUMNS = 8, 5.0, 3, 2
WIDTH, HEIGHT = 118, 150
FLOOR = -0.822  # of the standard body [m]


def row(plotter, body, faces, kind):
    """The image (HEIGHT, MOMENTS WIDTH, 3) of a kind's motion."""
    motion = Motion.generate(kind, seconds=SECONDS, seed=SEED)
    at = np.linspace(0.1, 0.95, MOMENTS) * (len(motion) - 1)
    motion = motion[at.astype(int)]
    posed = skinning.skin(
        body.vertices,
        body.blend_weights,
        skinning.transforms(body, motion.poses, motion.translation),
    )
    images = []
    for vertices, place in zip(
        posed.double().numpy(), motion.translation.double().numpy(), strict=True
    ):
        plotter.clear_actors()
        plotter.add_mesh(
            pyvista.PolyData(vertices - place * [1, 1, 0], faces),
            color="#b9bcc4",
            smooth_shading=True,
            ambient=0.25,
        )
        plotter.add_mesh(
            pyvista.Plane(center=(0, 0, FLOOR), i_size=2.4, j_size=2.4),
            color="#dfe3ea",
            lighting=False,
        )
        plotter.camera_position = [(2.2, -3.9, 0.9), (0, 0, 0.02), (0, 0, 1)]
        plotter.camera.view_angle = 27
        plotter.reset_camera_clipping_range()
        images.append(plotter.screenshot(return_img=True))
    image = Image.fromarray(np.concatenate(images, 1))
    ImageDraw.Draw(image).text(
        (4, 2), kind + (" (held out)" if kind in generate.HELD_OUT else ""), fill="black"
    )
    return np.asarray(image)


def main():
    body = AnnyBody().body()
    faces = np.concatenate([np.full((len(body.faces), 1), 3), body.faces.numpy()], 1)
    plotter = pyvista.Plotter(off_screen=True, window_size=(WIDTH, HEIGHT))
    plotter.set_background("white")
    plotter.enable_anti_aliasing("ssaa")
    rows = [row(plotter, body, faces, kind) for kind in (*generate.TRAINING, *generate.HELD_OUT)]
    while len(rows) % COLUMNS:
        rows.append(np.full_like(rows[0], 255))
    each = len(rows) // COLUMNS
    picture = np.concatenate(
        [np.concatenate(rows[k * each : (k + 1) * each], 0) for k in range(COLUMNS)], 1
    )
    with aside(os.path.join(HERE, "onefit_motions.png")) as temporary:
        Image.fromarray(picture).quantize(128).save(temporary)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
