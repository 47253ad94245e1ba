"""Draws docs/front.jpg, the picture of the front page, from a run on the whole demo.

    polysft demo -D last=-1 -o out/front     # half a minute
    python docs/front.py out/front

Left: frames of the video. Middle: the found surface as a grid on the frame. Right: the surface from
the side, with its print, path-traced.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from polyfit.colours import srgb
from polysft_mi import Run, set_variant

set_variant()
import mitsuba as mi  # noqa: E402

from polyfit.pictures import Triangles  # noqa: E402

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "scenes" / "demo"
FRAMES = 11, 28
BOX = 6, 276, 8, 218  # left, right, top, bottom of what is shown [pixels of the frame]
ZOOM = 2
GRID = 10  # cells along the longer side of the sheet
LINE = (255, 214, 64)  # RGB


def frame_of(k):
    return cv2.imread(str(DEMO / "frames" / f"{k:03d}.jpg"))[..., ::-1]


def cut(image, zoom=ZOOM):
    left, right, top, bottom = (zoom * x for x in BOX)
    return image[top:bottom, left:right]


def enlarged(image):
    return cv2.resize(image, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_LANCZOS4)


def with_grid(image, run, vertices):
    """The frame, enlarged, with the lines of the surface that the camera sees."""
    camera = run.camera
    (depth,) = Triangles(vertices, run.faces.astype(np.int64)).seen(camera)
    image = enlarged(image).copy()
    columns = len(np.unique(run.uv[:, 0].round(5)))
    grid = vertices.reshape(-1, columns, 3)
    step = (columns - 1) // GRID
    lines = [*grid[::step], *grid[:, ::step].transpose(1, 0, 2)]
    for line in lines:
        fine = np.stack(
            [np.interp(np.linspace(0, 1, 400), np.linspace(0, 1, len(line)), x) for x in line.T], 1
        )
        xy = camera.project(fine)
        column, row = np.clip(xy.astype(int).T, 0, [[camera.width - 1], [camera.height - 1]])
        near = cv2.erode(np.nan_to_num(depth, nan=9.0), np.ones((3, 3)))[row, column]
        visible = fine[:, 2] < near + 0.006
        for a, b, show in zip(xy[:-1], xy[1:], visible, strict=False):
            if show:
                points = [tuple(int(16 * (ZOOM * x - 0.5)) for x in p) for p in (a, b)]
                cv2.line(image, *points, LINE, 1, cv2.LINE_AA, 4)
    return image


def from_the_side(run, vertices, azimuth=40.0, elevation=30.0, spp=128):
    """A path-traced picture of the surface with its print, in the size of the others."""
    points = np.asarray(vertices, np.float32)
    mesh = mi.Mesh(
        "sheet", len(points), len(run.faces), has_vertex_normals=True, has_vertex_texcoords=True,
        props=_print(),
    )  # fmt: skip
    params = mi.traverse(mesh)
    params["faces"] = mi.UInt32(run.faces.astype(np.uint32).ravel())
    params["vertex_positions"] = mi.Float(points.ravel())
    uv = np.stack([run.uv[:, 0], 1 - run.uv[:, 1]], 1)  # Mitsuba's v points down
    params["vertex_texcoords"] = mi.Float(uv.astype(np.float32).ravel())
    params.update()
    middle = (points.min(0) + points.max(0)) / 2
    a, e = np.radians([azimuth, elevation])
    away = np.array([np.sin(a) * np.cos(e), -np.sin(e), -np.cos(a) * np.cos(e)])
    floor, look = points[:, 1].max() + 0.004, mi.ScalarTransform4f().look_at
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 5}, "sheet": mesh,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.55, 0.57, 0.62]}},
        "key": {
            "type": "rectangle",
            "to_world": look(
                origin=list(middle + [-0.5, -0.9, -0.7]), target=list(middle), up=[0, 0, 1]
            ).scale(0.16),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [40, 38, 35]}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, float(floor), 0])
            .rotate([1, 0, 0], 90).scale(40),
            "bsdf": {"type": "twosided", "bsdf": {
                "type": "diffuse", "reflectance": {"type": "rgb", "value": [0.04, 0.045, 0.056]}}},
        },
        "sensor": {
            "type": "perspective", "fov": 26, "fov_axis": "larger", "near_clip": 0.01,
            "to_world": look(
                origin=list(middle + 0.88 * away), target=list(middle), up=[0, -1, 0]
            ),
            "film": {
                "type": "hdrfilm", "pixel_format": "rgb", "rfilter": {"type": "gaussian"},
                "width": ZOOM * (BOX[1] - BOX[0]), "height": ZOOM * (BOX[3] - BOX[2]),
            },
        },
    })  # fmt: skip
    return np.round(255 * srgb(np.array(mi.render(scene, spp=spp)))).astype(np.uint8)


def _print():
    texture = {"type": "bitmap", "filename": str(DEMO / "texture.jpg"), "wrap_mode": "clamp"}
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}
    )
    return props


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="a run on all frames of the demo")
    parser.add_argument("output", nargs="?", default=str(Path(__file__).parent / "front.jpg"))
    args = parser.parse_args(argv)
    run, rows = Run.open(args.run), []
    for k in FRAMES:
        vertices = run.vertices[list(run.frames).index(k)]
        frame = frame_of(k)
        panels = [
            cut(enlarged(frame)),
            cut(with_grid(frame, run, vertices)),
            from_the_side(run, vertices),
        ]
        gap = np.full((panels[0].shape[0], 6, 3), 255, np.uint8)
        rows.append(np.hstack([panels[0], gap, panels[1], gap, panels[2]]))
    gap = np.full((6, rows[0].shape[1], 3), 255, np.uint8)
    picture = np.vstack([rows[0], *(x for row in rows[1:] for x in (gap, row))])
    cv2.imwrite(args.output, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
