"""Whether the paper's solver holds Kinect-Paper's sheet, by how its losses are read: on a stretch
of the video that begins where the default solver is.

    python -m polysft_mi.run scenes/kinect_paper.xml -D data=DATA/kinect_paper -D order=4
        -D patches=1 -D canonical_frame=stn -D k_relief=0 -o RUN
    python benchmarks/stretch.py RUN [--first 113] [--last 120] [--masks FOLDER] [-o docs]

RUN's surfaces are of the paper's kind, one jet of order 4. Its unknowns up to the frame before
``--first`` are taken, and the windows from there on to ``--last`` are solved with ``preset`` =
paper. What is measured is how far each surface ends from RUN's, RMS over the vertices; RUN is 4 mm
from the truth in depth. Frames count from 0; the sheet is fast from 114 on. The readings: the
preset, for which the sequence has no masks; the preset with lengths in millimetres, as the
sequence's files have them, not in the template's scale; linear colours and sharp masks, in means
over the sheet; other weights: of lengths ten times as much, of what ties frames together a
thousandth, as if it were a mean over the vertices; with these weights, rigid steps ten times as
long; with RUN's own silhouettes for masks, the best that masks can be, the preset, these means over
the sheet, and a robust norm of the images' local contrast, near to what nsft, by the paper's
authors, does: it weighs residuals by their size, and compares images' derivatives. With
``--masks``, the preset with those of ``polysft prepare``. Each goes into ``stretch.json`` as soon
as it is there, beside those of other stretches.
"""

import argparse
import json
import os
import tempfile

import cv2
import numpy as np
from per_vertex import OVER_SHEET

from polyfit.backend import add_mode_argument, set_variant
from polysft_mi.errors import InputError, cli
from polysft_mi.scene.settings import PRESETS

WEIGHTS = {"k_mi": 1.0, "k_tc": 5e-5}
CONTRAST = {**OVER_SHEET, "rgb_norm": "cauchy", "brightness": "local", "rgb_region": "sheet"}


def begun(run, tracker, first, folder):
    """A checkpoint of a tracker in ``folder``, as if it had tracked the frames before the
    ``first`` and ended where ``run`` did.
    """
    from polysft_mi.tracker import Track

    states = Track.load(os.path.join(run.folder, "checkpoint.npz")).states[:first]
    alpha = tracker.problem.template.alpha
    if states[0]["delta_alpha"].shape != alpha.shape:
        raise InputError(f"{run.folder}: its jets are others; make it as --help says")
    done = first - tracker.settings.window + 1
    terms = dict.fromkeys((term.name for term in tracker.objective.terms), 0.0)
    track = Track(states, done, [0] * done, [0.0] * done, [terms] * done, [None] * done)
    track.solver = tracker.solver.name
    track.save(os.path.join(folder, "checkpoint.npz"), tracker.objective.stages)


def tracked(run, settings, first, last):
    """How far the frames ``first`` to ``last`` end from RUN's surfaces [m], RMS."""
    from polysft_mi.objective import Problem
    from polysft_mi.render import threads
    from polysft_mi.results import metrics
    from polysft_mi.scene import load
    from polysft_mi.surface import Unknowns
    from polysft_mi.tracker import FrameTracker, track

    overrides = {"preset": "paper", **settings, "last": last}
    scene = load(os.path.join(run.folder, "scene.xml"), overrides)
    problem = Problem(scene, scene.sequence())
    with tempfile.TemporaryDirectory() as folder, threads(1.0):
        tracker = FrameTracker(problem)
        begun(run, tracker, first, folder)
        states = track(tracker, last + 1, folder, resume=True).states
    surfaces = [problem.surface(Unknowns.from_numpy(state)) for state in states[first:]]
    return [metrics.rmse(a, b) for a, b in zip(surfaces, run.vertices[first:])]


def silhouettes(run, folder):
    """Masks of RUN's surfaces, PNG files in ``folder``."""
    import mitsuba as mi

    from polysft_mi.objective import Problem
    from polysft_mi.scene import load

    scene = load(os.path.join(run.folder, "scene.xml"))
    placed = Problem(scene, scene.sequence()).placed
    for k, vertices in enumerate(run.vertices):
        points = mi.Point3f(np.ascontiguousarray(vertices.T, np.float32))
        alpha = np.array(placed.image(points, spp=16)[1])[..., 0]
        cv2.imwrite(os.path.join(folder, f"{k:05d}.png"), np.round(255 * alpha).astype(np.uint8))


def scale(run):
    """The template's scale [m], which lengths are measured in."""
    from polysft_mi.scene import load

    return load(os.path.join(run.folder, "scene.xml")).template.scale


def read(path):
    """Stretch to reading to distances [m], of each frame; none where there is no such file."""
    if not os.path.exists(path):
        return {}
    with open(path, encoding="utf-8") as file:
        return json.load(file)


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", metavar="RUN", help="folder of a finished run")
    parser.add_argument("--first", type=int, default=113, help="frame (default: 113)")
    parser.add_argument("--last", type=int, default=120, help="frame (default: 120)")
    parser.add_argument("--masks", metavar="FOLDER", help="of polysft prepare")
    parser.add_argument("--only", nargs="+", metavar="READING", help="some of them")
    parser.add_argument("-o", "--out", metavar="FOLDER", default="out/benchmarks")
    add_mode_argument(parser)
    options = parser.parse_args(arguments)
    set_variant(options.mode)
    from polysft_mi import Run
    from polysft_mi.results import outputs

    run = Run.open(options.run)
    if not 3 <= options.first <= options.last < len(run.vertices):
        raise InputError(
            f"--first {options.first} --last {options.last}: frames of the {len(run.vertices)} of"
            f" {options.run}, from 3 on, are needed"
        )
    path = os.path.join(options.out, "stretch.json")
    stretch = f"{options.first} to {options.last}"
    stiff = PRESETS["paper"]["k_mi"] * (1e3 * scale(run)) ** 2
    with tempfile.TemporaryDirectory() as masks:
        readings = {
            "preset": {},
            "preset, lengths in mm": {"k_mi": stiff},
            "preset, right masks": {"masks": masks},
            "means over the sheet": OVER_SHEET,
            "other weights": WEIGHTS,
            "other weights, longer rigid steps": {**WEIGHTS, "lr_rigid": 1e-3},
            "means over the sheet, right masks": {"masks": masks, **OVER_SHEET},
            "weights and contrast, right masks": {"masks": masks, **CONTRAST},
        }
        if options.masks:
            readings["preset, masks of prepare"] = {"masks": options.masks}
        if unknown := set(options.only or ()) - set(readings):
            raise InputError(f"--only {'; '.join(unknown)}: known are {'; '.join(readings)}")
        silhouettes(run, masks)
        os.makedirs(options.out, exist_ok=True)
        for name in options.only or readings:
            found = tracked(run, readings[name], options.first, options.last)
            print(name, "mm:", *(f"{1e3 * x:.1f}" for x in found), flush=True)
            known = read(path)
            known.setdefault(stretch, {})[name] = found
            outputs.write_json(path, known)


if __name__ == "__main__":
    cli(main)
