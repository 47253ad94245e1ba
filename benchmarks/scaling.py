"""How time a frame and memory of the second-order tracker grow with the template and with the
image.

    python benchmarks/scaling.py [--grids 33 50 71 100] [--sizes 640x480 1280x720 1920x1080]
    [--frames 8] [--docs docs] [-m llvm_ad_rgb]

A textured sheet that covers a third of the image bends and turns, or one whose pleats are drawn
apart (:mod:`scaling_surfaces`); ``raster`` renders it, with its masks, 16 samples a pixel. The
template is the surface in the first frame. Each case is tracked by default settings in a process of
its own, which has rendered nothing before. A case's seconds are medians over its frames but the
first, for which kernels are compiled: of all the process's threads together, so that what else the
machine does counts little (those of the clock are printed too). Its memory is the process's peak;
``started`` is what a process holds before it loads a scene.

Writes ``scaling.md`` and ``scaling.png`` into ``docs`` (``--docs FOLDER`` for another).
"""

import argparse
import dataclasses
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time

import numpy as np
from cases import add_case_arguments, parse_size
from scaling_surfaces import Surface, camera
from sequences import ROOT

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.errors import InputError, cli

GRIDS, SIZES, FRAMES = (33, 50, 71, 100), ("640x480", "1280x720", "1920x1080"), 8
PLEATED = Surface(100, 10, 4), Surface(100, 25, 4), Surface(250, 40, 10)
SAMPLES = 16  # a pixel


# ---- in a worker's process -----------------------------------------------------------------------


def make(folder, surface, size, frames):
    """A sequence's folder: frames and masks, template.obj, texture and camera.json, and the true
    surfaces in gt.npz.
    """
    import cv2
    import mitsuba as mi

    from polyfit.colours import srgb
    from polysft_mi import prepare
    from polysft_mi.objective.problem import Problem
    from polysft_mi.scene import experiment as scene

    faces, uv = surface.faces_and_uv()
    truth = np.stack([surface.at(size, k / max(frames - 1, 1)) for k in range(frames)])
    shutil.copy(os.path.join(ROOT, "scenes", "demo", "texture.jpg"), folder)
    lines = ["v {:.8f} {:.8f} {:.8f}".format(*p) for p in truth[0]] + [
        "vt {:.8f} {:.8f}".format(*t) for t in uv
    ]
    lines += ["f " + " ".join(f"{k}/{k}" for k in face) for face in faces + 1]
    with open(os.path.join(folder, "template.obj"), "w") as file:
        file.write("\n".join(lines) + "\n")
    c = camera(size)
    with open(os.path.join(folder, "camera.json"), "w") as file:
        json.dump({k: getattr(c, k) for k in ("fx", "fy", "cx", "cy", "width", "height")}, file)
    np.savez(os.path.join(folder, "gt.npz"), vertices=truth.astype(np.float32), faces=faces)

    def write(name, k, values):
        os.makedirs(os.path.join(folder, name), exist_ok=True)
        cv2.imwrite(
            os.path.join(folder, name, f"{k:03d}.png"),
            values[..., ::-1] if values.ndim == 3 else values,
        )

    blank = np.full((size[1], size[0], 3), 255, np.uint8)
    (
        write("frames", 0, blank),
        write("masks", 0, blank[..., 0]),
    )  # so that there is a scene to render with
    prepare.main([folder])
    experiment = scene.load(os.path.join(folder, "scene.xml"), {"spp": str(SAMPLES)})
    problem = Problem(experiment, experiment.sequence())
    for k, vertices in enumerate(truth):
        rgb, alpha = problem.placed.image(
            mi.Point3f(np.ascontiguousarray(vertices.T, dtype=np.float32))
        )
        alpha = np.array(alpha)[..., 0]
        linear = np.array(rgb) + 0.05 * (1 - alpha[..., None])
        write("frames", k, np.round(255 * srgb(linear)).astype(np.uint8))
        write("masks", k, np.round(255 * alpha).astype(np.uint8))


def measure(folder):
    """Seconds (of the clock, of all threads) and evaluations of each frame, memory [MB] before the
    scene and at most, and distances from the truth [mm].
    """
    from polysft_mi.objective.problem import Problem
    from polysft_mi.scene import experiment as scene
    from polysft_mi.surface.patch import Unknowns
    from polysft_mi.tracker import FrameTracker, track

    with open("/proc/self/statm") as file:
        started = int(file.read().split()[1]) * resource.getpagesize() / 1e6
    experiment = scene.load(os.path.join(folder, "scene.xml"), {})
    problem = Problem(experiment, experiment.sequence())
    ticks = {}

    def tick(before, *_):
        ticks[before] = time.process_time()  # after the last evaluation of a frame

    done = track(FrameTracker(problem), len(problem.sequence), folder, progress=tick)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    with np.load(os.path.join(folder, "gt.npz")) as truth:
        found = np.stack([problem.surface(Unknowns.from_numpy(s)) for s in done.states])
        error = 1e3 * np.sqrt(((found - truth["vertices"]) ** 2).sum(2).mean(1))
    cpu = np.diff(list(ticks.values())).tolist()
    figures = {
        "seconds": done.seconds[1:],
        "cpu": cpu,
        "evaluations": done.iterations[1:],
        "rmse_mm": error.tolist(),
    }
    patches = len(problem.template)
    return {**figures, "patches": patches, "started_mb": started, "peak_mb": peak}


def worker(job):
    set_variant(job["mode"])
    from polysft_mi.results import outputs
    from polysft_mi.scene import plugins

    plugins.register()
    if job["task"] == "make":
        surface = Surface(*job["surface"])
        make(job["folder"], surface, parse_size(job["size"]), job["frames"])
    else:
        print(json.dumps({**measure(job["folder"]), "versions": outputs.versions()}))


# ---- in the benchmark's own process --------------------------------------------------------------


def run_case(surface, size, frames, mode):
    """The figures of a case (dict)."""
    with tempfile.TemporaryDirectory() as folder:
        for task in ("make", "measure"):
            job = {
                "task": task,
                "folder": folder,
                "surface": dataclasses.astuple(surface),
                "size": size,
                "frames": frames,
                "mode": mode,
            }
            command = [sys.executable, os.path.abspath(__file__), "--worker", json.dumps(job)]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                why = done.stderr.strip()[-500:]
                raise InputError(
                    f"{surface.name} at {size}: {task} ended with status {done.returncode}: {why}"
                )
    return summarise(surface, size, json.loads(done.stdout.splitlines()[-1]))


def summarise(surface, size, found):
    return {
        "vertices": surface.columns * surface.rows,
        "pleats": surface.pleats,
        "patches": found["patches"],
        "size": size,
        **{name: float(np.median(found[name])) for name in ("seconds", "cpu")},
        "evaluations": float(np.mean(found["evaluations"])),
        "peak_mb": found["peak_mb"],
        "started_mb": found["started_mb"],
        "rmse_mm": float(np.mean(found["rmse_mm"][1:])),
        "versions": found["versions"],
    }


def report(cases, docs, frames):
    """Write scaling.md and scaling.png for cases that are done; the text."""
    v, sheets = cases[0]["versions"], [c for c in cases if not c["pleats"]]
    figures = lambda c: (
        f"{c['size'].replace('x', '×')} | {c['cpu']:.2f} |"
        f" {c['evaluations']:.0f} | {c['peak_mb']:.0f} | {c['rmse_mm']:.2f} |"
    )
    rows = [f"| {c['vertices']:,} | {figures(c)}" for c in sheets]
    pleated = [f"| {c['vertices']:,} | {c['patches']} | {figures(c)}" for c in cases if c["pleats"]]
    started = np.median([c["started_mb"] for c in cases])
    text = f"""# How the tracker scales

This page shows how time and memory of the second-order tracker grow with the number of vertices
and with the image. `python benchmarks/scaling.py` makes it. A sheet that covers a third of the
image bends and turns in front of the camera. It is rendered with its masks, and tracked with
default settings.

- Seconds a frame are the tracker's: the median of {frames - 1} frames, the sum over all threads,
  without start-up and pictures. On idle cores a frame takes less, since the next frame is read and
  kernels run in parallel.
- Evaluations are those of the objective with its derivatives.
- Memory is the process's peak. {started:.0f} MB of it are Python, Mitsuba and LLVM.
- RMS is the distance from the true surface.
- Measured on {v["variant"]}, {v["machine"]}.

| vertices | image | seconds a frame | evaluations a frame | memory [MB] | RMS [mm] |
|---:|---|---:|---:|---:|---:|
{chr(10).join(rows)}

![Seconds a frame and memory over the vertices, and over the pixels](scaling.png)

With the image grow decoding, rays and residuals. Only the finest of the three stages works on every
pixel that sees the sheet.

With the template grows the elimination of each vertex's (Δu, Δv). A sheet's block tridiagonal
matrix is as wide as the sheet, so its factorisation grows with the square of the number of
vertices. Up to 3,000 vertices the relief moves too. It costs time, and on such a smooth sheet its
noise shows in the distances.

## Many patches

A curtain whose pleats hang over at first, and are drawn apart: in these frames it becomes 45 %
wider. It is no height graph, so each half of a pleat is a patch. Each patch has its own jet and
motion; vertices see the jets of the patches that hold them or a neighbour alone.

| vertices | patches | image | seconds a frame | evaluations a frame | memory [MB] | RMS [mm] |
|---:|---:|---|---:|---:|---:|---:|
{chr(10).join(pleated)}
"""
    with (
        aside(os.path.join(docs, "scaling.md")) as temporary,
        open(temporary, "w", encoding="utf-8") as file,
    ):
        file.write(text)
    plot(os.path.join(docs, "scaling.png"), sheets)
    return text


def plot(path, cases):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.6), dpi=90, layout="constrained")
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    pixels = lambda c: np.prod(parse_size(c["size"]))
    sizes = sorted({c["size"] for c in cases}, key=lambda s: np.prod(parse_size(s)))
    counts = sorted({c["vertices"] for c in cases})
    shades = lambda n: [(0.77, 0.34, 0.18, 1 - 0.7 * k / max(n - 1, 1)) for k in reversed(range(n))]
    for row, (name, label) in enumerate((("cpu", "seconds a frame"), ("peak_mb", "memory [MB]"))):
        for column, (groups, key, across) in enumerate(
            ((sizes, "size", lambda c: c["vertices"]), (counts, "vertices", pixels))
        ):
            a = axes[row, column]
            for group, colour in zip(groups, shades(len(groups))):
                chosen = sorted((c for c in cases if c[key] == group), key=across)
                text = group.replace("x", "×") if key == "size" else f"{group:,} vertices"
                a.plot(
                    [across(c) for c in chosen],
                    [c[name] for c in chosen],
                    color=colour,
                    marker="o",
                    markersize=3.5,
                    label=text,
                )
            a.grid(True, color="0.9", linewidth=0.6)
            a.spines[["top", "right"]].set_visible(False)
            a.set_ylim(bottom=0)
            if column == 0:
                a.set_ylabel(label)
            if row == 1:  # under the curves, which begin with what a process holds
                a.legend(frameon=False, fontsize=8, loc="lower right")
    axes[1, 0].set_xlabel("vertices")
    axes[1, 1].set_xlabel("pixels")
    axes[1, 1].set_xticks(
        [np.prod(parse_size(s)) for s in sizes], [s.replace("x", "×") for s in sizes], fontsize=8
    )
    with aside(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_case_arguments(p, SIZES, GRIDS)
    p.add_argument(
        "--frames", type=int, default=FRAMES, help=f"frames of a case (default: {FRAMES})"
    )
    p.add_argument(
        "--docs",
        metavar="FOLDER",
        default=os.path.join(ROOT, "docs"),
        help="for scaling.md and scaling.png (default: docs)",
    )
    add_mode_argument(p)
    p.add_argument("--worker", help=argparse.SUPPRESS)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if options.worker:
        return worker(json.loads(options.worker))
    for size in options.sizes:
        parse_size(size, least=48)
    if min(options.grids) < 4 or options.frames < 2 or not os.path.isdir(options.docs):
        given = f"--grids {options.grids} --frames {options.frames} --docs {options.docs}"
        raise InputError(f"{given}: at least 4 vertices a side, 2 frames and a folder are needed")
    began, cases = time.perf_counter(), []
    surfaces = [(Surface(n, n), size) for size in options.sizes for n in options.grids]
    surfaces += [(pleated, options.sizes[0]) for pleated in PLEATED]
    for surface, size in surfaces:
        cases.append(c := run_case(surface, size, options.frames, options.mode))
        figures = (
            f"{c['seconds']:.2f} s a frame ({c['cpu']:.2f} of all threads), {c['peak_mb']:.0f} MB"
        )
        print(
            f"{time.perf_counter() - began:4.0f} s  {surface.name}, {size}: {figures}",
            file=sys.stderr,
        )
    print(report(cases, options.docs, options.frames))


if __name__ == "__main__":
    cli(main)
