"""Draws docs/tracked.jpg: surfaces that are no height graph, as runs found them.

    polysft run scenes/shirt.xml -D data=FOLDER -o out/shirt    # likewise tube and ball
    python docs/tracked.py out/shirt out/tube out/ball

From left to right: the frame, the lines of the found mesh that the camera sees, the surface from
the left, and from behind, where no pixel saw it.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from polyfit.backend import set_variant
from polyfit.colours import srgb
from polyfit.mesh import edges_of
from polysft_mi import Run

SIDE, ZOOM = 360, 2  # pixels of a picture; how much larger lines are drawn
LINE = (255, 214, 64)  # RGB
TURNS = 75, 165  # [degrees] about the upright axis
MARGIN, NEAR = 1.1, 0.004  # share of the surface's extent; [m] behind what is seen


def frame_of(run, k):
    """(H, W, 3) uint8: the frame that the run saw."""
    from polysft_mi.scene import experiment

    sequence = experiment.load(run.path("scene.xml"), {}).sequence()
    return np.round(255 * srgb(sequence.frame(k))).astype(np.uint8)


def with_lines(image, run, vertices):
    """The image, enlarged, with the edges of the mesh that the camera sees."""
    from polyfit.pictures import Triangles

    camera = run.camera
    (depth,) = Triangles(vertices, run.faces.astype(np.int64)).seen(camera)
    depth = cv2.erode(np.nan_to_num(depth, nan=9.0), np.ones((3, 3)))
    image = cv2.resize(image, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_LANCZOS4)
    xy = camera.project(vertices)
    column, row = np.clip(xy.astype(int).T, 0, [[camera.width - 1], [camera.height - 1]])
    visible = vertices[:, 2] < depth[row, column] + NEAR
    for a, b in edges_of(run.faces.astype(np.int64))[0]:
        if visible[a] and visible[b]:
            ends = [tuple(int(16 * (ZOOM * x - 0.5)) for x in xy[k]) for k in (a, b)]
            cv2.line(image, *ends, LINE, 1, cv2.LINE_AA, 4)
    return image


def row_of(folder, k):
    """The pictures of a run's frame, (SIDE, 4 SIDE, 3) uint8."""
    from polyfit.pictures import SideView, Triangles

    run = Run.open(folder)
    vertices = run.vertices[list(run.frames).index(k)].astype(np.float64)
    image, xy = frame_of(run, k), run.camera.project(vertices)
    half = MARGIN * np.ptp(xy, axis=0).max() / 2
    left, top = np.maximum((xy.min(0) + xy.max(0)) / 2 - half, 0).astype(int)
    side = int(2 * half)
    pictures = []
    for zoom, picture in ((1, image), (ZOOM, with_lines(image, run, vertices))):
        part = picture[zoom * top : zoom * (top + side), zoom * left : zoom * (left + side)]
        pictures.append(cv2.resize(part, (SIDE, SIDE), interpolation=cv2.INTER_AREA))
    for turn in TURNS:
        view = SideView.around(vertices, azimuth=turn, elevation=12.0)
        pictures.append(Triangles(vertices, run.faces).shaded(view, size=(SIDE, SIDE)))
    return np.hstack(pictures)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", metavar="RUN", help="folder of a run")
    parser.add_argument("--frame", type=int, default=24)
    parser.add_argument("-o", "--output", default=str(Path(__file__).parent / "tracked.jpg"))
    args = parser.parse_args(argv)
    set_variant()
    rows = [row_of(folder, args.frame) for folder in args.runs]
    cv2.imwrite(args.output, np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(args.output)


if __name__ == "__main__":
    main()
