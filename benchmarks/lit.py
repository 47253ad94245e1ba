"""What light in the rendering is worth: a plain sheet under a lamp and over a bright floor, tracked
with path replay, which knows both, and with an unlit rendering.

    python benchmarks/lit.py [-o docs]      # tracks it three ways: lit.json and lit.jpg
    python benchmarks/lit.py --make         # makes the video, the folder scenes/demo_lit

The video is path-traced by Mitsuba from the scene file that is tracked, ``scenes/demo_lit.xml``:
the light is the very same, with one reflection (``max_depth`` = 3). Waves grow in the sheet, whose
lengths stay. Its print is plain: little but the light shows them.
"""

import argparse
import dataclasses
import json
import os
import time

import numpy as np
from sequences import ROOT

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.errors import cli

SCENE, DATA = (os.path.join(ROOT, "scenes", name) for name in ("demo_lit.xml", "demo_lit"))
LIT, UNLIT, USUAL = "path replay", "raster, the same solver", "raster, by default"
COLOURS = "#c4572e", "#3b6ea5", "#7a9e4b"
FRAMES, PATHS = 6, 1024  # paths a pixel
SIZE, CELLS = (0.26, 0.2), (20, 15)  # (width, height) [m], cells along them
MIDDLE = np.array([0.0, 0.01, 0.58])  # of the flat sheet [m]
TILT = 0.35  # angle of the waves with the image's vertical [rad]
SLOPE, LENGTH, SHIFT = 0.5, 0.24, 0.4  # of the waves: largest slope, length [m], phase [rad]


def placed_in(experiment):
    """The template in an experiment's scene, a :class:`PlacedMesh`."""
    from polysft_mi.render import PlacedMesh

    e = experiment
    return PlacedMesh(e.scene, e.sensor, e.renderer, e.mesh, e.corner)


def sheet(share):
    """Vertices (N, 3) [m, camera frame], row by row, of the sheet at a ``share`` of its motion,
    0 to 1.
    """
    v, u = (x.ravel() for x in np.mgrid[0 : 1 : (CELLS[1] + 1) * 1j, 0 : 1 : (CELLS[0] + 1) * 1j])
    x, y = (u - 0.5) * SIZE[0], (v - 0.5) * SIZE[1]
    cos, sin = np.cos(TILT), np.sin(TILT)
    along, across = cos * x + sin * y, cos * y - sin * x
    s = np.linspace(-0.2, 0.2, 2001)
    angle = share * SLOPE * (np.sin(2 * np.pi * s / LENGTH + SHIFT) - np.sin(SHIFT))
    step = np.diff(s, prepend=s[0])
    curve = np.cumsum(step * np.cos(angle)), np.cumsum(step * np.sin(angle))
    a, z = (np.interp(along, s, c - np.interp(0, s, c)) for c in curve)
    points = np.stack([cos * a - sin * across, sin * a + cos * across, z], -1)
    return points + MIDDLE


def texture():
    """A plain one, sRGB, uint8: paper with three spots."""
    import cv2

    image = np.full((120, 156, 3), (190, 187, 180), np.uint8)
    for at, axes, turn, colour in (
        ((34, 42), (20, 12), 20, (60, 110, 190)),
        ((118, 36), (13, 17), 0, (200, 70, 50)),
        ((92, 88), (24, 10), -30, (50, 140, 80)),
    ):
        cv2.ellipse(image, at, axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
    return image


def make(folder):
    """Write the video's folder: template, texture, camera, frames, masks, and the truth."""
    import cv2
    import mitsuba as mi

    from polysft_mi.scene import load
    from polysft_mi.surface.meshio import write_obj

    at = lambda *names: os.path.join(folder, *names)
    for name in ("frames", "masks"):
        os.makedirs(at(name), exist_ok=True)
    rows, columns = CELLS[1] + 1, CELLS[0] + 1
    v, u = (x.ravel() for x in np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j])
    k = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    vertices = np.array([sheet(t / (FRAMES - 1)) for t in range(FRAMES)])
    write_obj(at("template.obj"), vertices[0], faces, np.stack([u, 1 - v], -1))
    cv2.imwrite(at("texture.png"), texture()[..., ::-1])
    with open(at("camera.json"), "w", encoding="utf-8") as file:
        json.dump(dict(width=160, height=120, fx=184, fy=184, cx=80, cy=60), file, indent=1)
    experiment = load(SCENE, {"data": folder})
    placed = placed_in(experiment)
    tracer = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    for t, x in enumerate(vertices):
        placed.place(mi.Point3f(x.T.astype(np.float32)))
        light = np.array(mi.render(experiment.scene, integrator=tracer, spp=PATHS, seed=t))
        srgb = mi.Bitmap(np.ascontiguousarray(light[..., :3], np.float32)).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True
        )
        cv2.imwrite(at("frames", f"{t:03d}.png"), np.array(srgb)[..., ::-1])
        cv2.imwrite(at("masks", f"{t:03d}.png"), 255 * (light[..., 3] > 0.5).astype(np.uint8))
    np.savez_compressed(
        at("gt.npz"), vertices=vertices.astype(np.float32), faces=faces.astype(np.int32)
    )


def track(out, last, variant):
    """Track the video in each way, into folders of ``out``: name to (:class:`polysft_mi.Run`,
    seconds a frame).
    """
    import polysft_mi
    from polysft_mi.capture import recognise, scene_xml
    from polysft_mi.scene import load

    os.makedirs(out, exist_ok=True)
    plain = os.path.join(out, "unlit.xml")  # the scene that ``polysft prepare`` writes
    with open(plain, "w", encoding="utf-8") as file:
        file.write(scene_xml(recognise(DATA), DATA))
    same = {**dataclasses.asdict(load(SCENE).settings), "spp": 1}
    ways = {LIT: (SCENE, {}), UNLIT: (plain, same), USUAL: (plain, {})}
    found = {}
    for name, (scene, settings) in ways.items():
        folder, began = os.path.join(out, name.replace(", ", "_")), time.perf_counter()
        settings = {**settings, "last": last}
        polysft_mi.reconstruct(
            scene, folder, settings, variant=variant, overwrite=True, exr_frames=0, report=False
        )
        run = polysft_mi.Run.open(folder)
        found[name] = run, (time.perf_counter() - began) / len(run.vertices)
    return found


def figures_of(found, truth):
    """The report: of each way the errors of each frame, as it is and after a similarity, and its
    time.
    """
    from polysft_mi.results import metrics

    each = {
        "rmse_mm": lambda a, b, _: 1e3 * metrics.rmse(a, b),
        "aligned_mm": lambda a, b, _: 1e3 * metrics.rmse(metrics.align_similarity(a, b), b),
        "normals_degrees": metrics.normal_angle,
    }
    return {
        name: {
            **{
                k: [f(a, b, run.faces) for a, b in zip(run.vertices, truth)]
                for k, f in each.items()
            },
            "seconds_a_frame": seconds,
        }
        for name, (run, seconds) in found.items()
    }


def picture(path, found, figures, truth):
    """Frames of the video, what both ways make of them, and how far they are from the truth."""
    import mitsuba as mi
    from matplotlib.figure import Figure

    from polyfit.colours import srgb
    from polysft_mi.scene import load

    last = len(found[LIT][0].vertices) - 1
    shown = sorted({round(last * k / 3) for k in range(4)})
    rows = {"the video": None, f"found: {LIT}": found[LIT][0], f"found: {UNLIT}": found[UNLIT][0]}
    figure = Figure(figsize=(9, 8.2), dpi=100, layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(2, 1))
    grid = above.subplots(len(rows), len(shown), squeeze=False)
    lit = load(SCENE)
    unlit = load(os.path.join(os.path.dirname(found[LIT][0].folder), "unlit.xml"))
    video = lit.sequence()
    for (label, run), line in zip(rows.items(), grid):
        experiment = unlit if run is found[UNLIT][0] else lit
        placed = placed_in(experiment)
        for k, axes in zip(shown, line):
            image = video.frame(k)
            if run is not None:
                points = mi.Point3f(np.ascontiguousarray(run.vertices[k].T, np.float32))
                image = np.array(placed.image(points, spp=256)[0])
            axes.imshow(srgb(image)[14:106, 22:136])
            axes.set_xticks([]), axes.set_yticks([])
            if run is None:
                axes.set_title(f"frame {k}", fontsize=9)
        line[0].set_ylabel(label, fontsize=8)
    profile, *errors = below.subplots(1, 3)
    middle = slice(CELLS[1] // 2 * (CELLS[0] + 1), (CELLS[1] // 2 + 1) * (CELLS[0] + 1))
    profile.plot(*1e3 * truth[last, middle][:, [0, 2]].T, color="0.2", label="truth")
    for (name, (run, _)), colour in zip(found.items(), COLOURS, strict=True):
        profile.plot(*1e3 * run.vertices[last, middle][:, [0, 2]].T, color=colour, label=name)
        for axes, key in zip(errors, ("aligned_mm", "normals_degrees"), strict=True):
            axes.plot(figures[name][key], color=colour)
    profile.set_title(f"middle row from above, frame {last} [mm]", fontsize=8, loc="left")
    profile.invert_yaxis()
    profile.legend(frameon=False, fontsize=7)
    for axes, title in zip(errors, ("RMSE, aligned [mm]", "normals [degrees]"), strict=True):
        axes.set_title(f"{title}, by frame", fontsize=8, loc="left")
        axes.set_ylim(bottom=0)
    for axes in (profile, *errors):
        axes.tick_params(labelsize=8)
        axes.grid(True, color="0.9", linewidth=0.6)
    with aside(path) as temporary:
        figure.savefig(temporary, format="jpg", facecolor="white", pil_kwargs={"quality": 88})


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--make", action="store_true", help="make the video again, and end")
    parser.add_argument("--last", type=int, default=FRAMES - 1, help="last frame (default: 7)")
    parser.add_argument("-o", "--out", metavar="FOLDER", default="out/benchmarks")
    add_mode_argument(parser)
    options = parser.parse_args(arguments)
    set_variant(options.mode)
    if options.make:
        make(DATA)
        return
    from polysft_mi.results import outputs

    truth = np.load(os.path.join(DATA, "gt.npz"))["vertices"].astype(np.float64)
    found = track(os.path.join("out", "benchmarks", "lit"), options.last, options.mode)
    figures = figures_of(found, truth)
    os.makedirs(options.out, exist_ok=True)
    picture(os.path.join(options.out, "lit.jpg"), found, figures, truth)
    outputs.write_json(os.path.join(options.out, "lit.json"), figures)
    for name, row in figures.items():
        print(
            f"{name}: {row['rmse_mm'][-1]:.1f} mm, {row['aligned_mm'][-1]:.1f} mm aligned,"
            f" {row['normals_degrees'][-1]:.1f}°, {row['seconds_a_frame']:.1f} s a frame"
        )


if __name__ == "__main__":
    cli(main)
