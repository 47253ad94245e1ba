"""How well a template's pose is found again by the edges of the first frame, from poses that miss
by some pixels: ``python benchmarks/outline.py --data FOLDER``.

Sequences in the form *cloth*, whose template lies where the first frame shows it. Prints, for each,
by how much the outline missed and the vertices were off before, and after.
"""

import argparse
import os

import numpy as np
from scipy.spatial.transform import Rotation
from sequences import DATA

from polysft_mi.camera import Intrinsics
from polysft_mi.poses import fitted
from polysft_mi.scene.images import list_images, read_rgb
from polysft_mi.surface import meshio

SEQUENCES = "flag", "bend", "paper", "curtain", "corner"
_ROTATION, _SHIFT = (
    (0.03, 0.03, 0.015),
    (0.005, 0.005, 0.017),
)  # standard deviations of what is wrong [rad], [of the distance]


def moved(vertices, random):
    """The vertices (N, 3) [m], turned about their centre and shifted at random."""
    centre = vertices.mean(0)
    turn = Rotation.from_rotvec(random.normal(size=3) * _ROTATION)
    return turn.apply(vertices - centre) + centre + random.normal(size=3) * _SHIFT * centre[2]


def measure(folder, times):
    """Of so many starts, (times, 4): pixels and millimetres, RMS over the vertices, before and
    after; and how many were sure.
    """
    camera = Intrinsics.from_json(os.path.join(folder, "camera.json"))
    truth, faces, _ = meshio.read_template(os.path.join(folder, "template.obj"))
    image = read_rgb(list_images(os.path.join(folder, "frames"), "frames")[0])
    random, rows, sure = np.random.default_rng(0), [], 0
    for _ in range(times):
        start = moved(truth, random)
        fit = fitted(start, faces, camera, image)
        sure += fit.sure
        row = []
        for found in (start, fit(start) if fit.sure else start):
            row += [
                np.sqrt(((camera.project(found) - camera.project(truth)) ** 2).sum(1).mean()),
                1e3 * np.sqrt(((found - truth) ** 2).sum(1).mean()),
            ]
        rows.append(row)
    return np.array(rows), sure


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", default=DATA, help="folder with cloth")
    parser.add_argument("--times", type=int, default=20, help="starts for each (default: 20)")
    args = parser.parse_args(argv)
    print(
        "| sequence | starts, sure | before: median, worst [px] | [mm] | after [px] | [mm] |",
        "|---|---|---|---|---|---|",
        sep="\n",
    )
    for name in SEQUENCES:
        rows, sure = measure(os.path.join(args.data, "cloth", name), args.times)
        pairs = (f"{np.median(x):.2f}, {x.max():.2f}" for x in rows.T)
        print(f"| {name} | {args.times}, {sure} |", " | ".join(pairs), "|", flush=True)


if __name__ == "__main__":
    main()
