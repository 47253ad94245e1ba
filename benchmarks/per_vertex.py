"""What a Mitsuba user would write without jets: the template's vertices as the unknowns of every
frame.

    python benchmarks/per_vertex.py scene.xml -o OUT [-D name=value ...] [--iterations 150] [--step
    0.003] [--smoothing 19] [--overwrite]

The scene, the video and the renderer are those of ``python -m polysft_mi.run -D preset=paper``; the
objective, too: photometric and silhouette losses and inextensibility of the mesh. But images are
compared in linear colours, with sharp masks, and means are over the sheet. That does better here:
with the preset's own losses (``-D rgb_norm=phi-sft -D silhouette_norm=phi-sft -D mask_blur=5 -D
k_silhouette=0.5``) e3d of ``flag`` is 0.0052, not 0.0037. Nothing couples the frames but the start:
each begins where the one before it ended, the first from the template. The unknowns are the
positions' differential form under ``mi.ad.LargeSteps`` (Nicolet et al. 2021), minimised by
``mi.ad.Adam`` with ``uniform=True``, as its authors advise. Of the ``--iterations`` of a frame the
best is kept.

Writes ``surface.npz`` (``docs/conventions.md``) and ``metrics.json`` into OUT, no pictures: where
whole commands are timed, that is in this script's favour. ``mi.ad.LargeSteps`` needs the package
``cholespy``.
"""

import argparse
import importlib.util
import math
import os
import sys
import time

import numpy as np

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.commands import add_define_argument, definitions
from polysft_mi.errors import InputError, cli

#: losses over the sheet, in place of the preset's means over the image
OVER_SHEET = {"rgb_norm": "l1", "silhouette_norm": "l2", "mask_blur": 0.0, "k_silhouette": 1.0}
ITERATIONS = 150  # a frame
STEP = 3e-3  # of the template's radius; chosen on the sequence flag (benchmarks/README.md)
SMOOTHING = 19.0  # Mitsuba's own default


class Vertices:
    """Takes the place of a problem's ``patch``: the surface is made of vertex positions, whose
    differential form is the unknown.

    The unknown of a frame is a Float of 3N: (I + λL) (p - origin) / s, with s the template's radius
    [m] and its centre for origin.
    """

    def __init__(self, template, smoothing):
        import drjit as dr
        import mitsuba as mi

        self._mi, self._dr = mi, dr
        origin = template.vertices.mean(0)
        self.scale, self.origin = mi.Float(template.scale), mi.Point3f(*map(float, origin))
        dr.make_opaque(self.scale, self.origin)
        rest = self._flat((template.vertices - origin) / template.scale)
        self._form = mi.ad.LargeSteps(
            rest, mi.UInt32(template.faces.astype(np.uint32).ravel()), smoothing
        )
        self._rest = self._form.to_differential(rest)
        dr.eval(self._rest)

    def _flat(self, points):
        return self._mi.Float(np.ascontiguousarray(points, dtype=np.float32).ravel())

    def rest(self):
        """The unknown of the template as it is in its file."""
        return self._mi.Float(self._rest)

    def vertices(self, unknown):
        """Positions of the vertices, Point3f of N [m], attached to the unknown."""
        positions = self._dr.unravel(self._mi.Point3f, self._form.from_differential(unknown))
        return self.origin + self.scale * positions


def load(scene, overrides, smoothing=SMOOTHING):
    """The :class:`polysft_mi.objective.objective.Objective` of a scene, with vertices for
    unknowns.
    """
    if importlib.util.find_spec("cholespy") is None:
        raise InputError("mi.ad.LargeSteps needs the package cholespy: pip install cholespy")
    from polysft_mi.objective import Objective, Problem
    from polysft_mi.scene import experiment as scenes

    frame_by_frame = {"canonical_frame": "pca", "patches": "0", "window": "1", "k_tc": "0"}
    ours = {"preset": "paper", **OVER_SHEET, **frame_by_frame}
    experiment = scenes.load(scene, {**ours, **overrides})
    sequence = experiment.sequence()
    problem = Problem(experiment, sequence)
    problem.check_start()
    problem.patch = Vertices(problem.template, smoothing)
    return Objective(problem)


def frozen(objective, frame):
    """The objective of a frame, as solvers take it."""
    from polysft_mi.objective import FrameContext

    return objective.frozen([FrameContext(frame)], objective.usual[-1], [])


def solve(objective, frame, start, iterations, step):
    """Minimise one frame (counted in the selection) from the unknown ``start``: (unknown, losses),
    the best, and each iteration's loss.

    Where the image, or a step, makes the loss not finite, what was best before it is returned.
    """
    import mitsuba as mi

    from polysft_mi.errors import BadFrame

    optimizer = mi.ad.Adam(lr=step, uniform=True)
    optimizer["u"] = start
    best, least, losses, seed = mi.Float(start), math.inf, [], objective.settings.seed
    objective = frozen(objective, frame)
    for iteration in range(iterations):
        unknown = optimizer["u"]
        try:
            loss, _ = objective.evaluate(
                [unknown], backward=True, seed=(seed + 7919 * iteration) % 2**31
            )
        except BadFrame:
            break
        losses.append(loss)
        if loss < least:
            best, least = mi.Float(unknown), loss
        if iteration + 1 < iterations:
            optimizer.step()
    return best, losses


def track(objective, iterations, step, say=lambda text: None):
    """All frames of an objective's video: vertices (T, N, 3) float32 [m, camera frame], and a dict
    of losses, iterations and seconds for each.
    """
    import drjit as dr

    problem = objective.problem
    unknown, surfaces, rows = problem.patch.rest(), [], []
    for frame, index in enumerate(problem.sequence.indices):
        began = time.perf_counter()
        unknown, losses = solve(objective, frame, unknown, iterations, step)
        unknown = dr.detach(unknown)
        surfaces.append(problem.camera.to_camera(problem.surface(unknown)).astype(np.float32))
        first, least = (losses[0], min(losses)) if losses else (None, None)
        row = {"frame": int(index), "first_loss": first, "loss": least, "iterations": len(losses)}
        rows.append({**row, "seconds": time.perf_counter() - began})
        told = (
            f"loss {first:.4g} to {least:.4g}"
            if losses
            else "the loss is not finite; it keeps the surface of the frame before"
        )
        say(f"frame {index}: {told}, {rows[-1]['seconds']:.1f} s")
    return np.stack(surfaces), rows


def write(problem, surfaces, rows, out, **options):
    """``surface.npz`` and ``metrics.json`` in the folder ``out``; returns the figures that
    ``metrics.json`` begins with.
    """
    from polysft_mi.results import outputs
    from polysft_mi.results.truth import uv_arrays

    template = problem.template
    indices = np.asarray(problem.sequence.indices, dtype=np.int64)
    with aside(os.path.join(out, "surface.npz")) as temporary:
        faces = template.faces.astype(np.int32)
        np.savez_compressed(
            temporary,
            vertices=surfaces,
            faces=faces,
            **uv_arrays(template.texcoords, template.faces),
            frames=indices,
        )
    summary = {
        "frames": len(rows),
        "seconds_per_frame": float(np.mean([row["seconds"] for row in rows])),
        "iterations_per_window": float(np.mean([row["iterations"] for row in rows])),
        "solver": "per-vertex",
        **options,
    }
    outputs.write_json(
        os.path.join(out, "metrics.json"),
        {**summary, "versions": outputs.versions(), "per_frame": rows},
    )
    return summary


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "scene", metavar="scene.xml", help="Mitsuba scene with a polysft integrator (docs/scene.md)"
    )
    p.add_argument(
        "-o", "--out", metavar="OUT", required=True, help="folder for surface.npz and metrics.json"
    )
    add_define_argument(p)
    p.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        default=ITERATIONS,
        help=f"iterations a frame (default: {ITERATIONS})",
    )
    p.add_argument(
        "--step",
        type=float,
        default=STEP,
        help=f"Adam's step size, as a share of the template's radius (default: {STEP})",
    )
    p.add_argument(
        "--smoothing",
        type=float,
        metavar="LAMBDA",
        default=SMOOTHING,
        help=f"lambda of LargeSteps (default: {SMOOTHING:g})",
    )
    p.add_argument("--overwrite", action="store_true", help="replace the result that OUT holds")
    p.add_argument("-q", "--quiet", action="store_true", help="no progress, only the result")
    add_mode_argument(p)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    overrides = definitions(options.define)
    if options.iterations < 1 or not (
        0 < options.step < math.inf and 0 <= options.smoothing < math.inf
    ):
        given = (
            f"--iterations {options.iterations} --step {options.step} --smoothing"
            f" {options.smoothing}"
        )
        raise InputError(f"{given}: positive numbers are needed")
    if os.path.exists(os.path.join(options.out, "surface.npz")) and not options.overwrite:
        raise InputError(f"{options.out}: holds another result; give --overwrite to replace it")
    set_variant(options.mode)
    objective = load(options.scene, overrides, options.smoothing)
    os.makedirs(options.out, exist_ok=True)
    say = (lambda text: None) if options.quiet else lambda text: print(text, file=sys.stderr)
    surfaces, rows = track(objective, options.iterations, options.step, say)
    summary = write(
        objective.problem,
        surfaces,
        rows,
        options.out,
        step=options.step,
        smoothing=options.smoothing,
    )
    print(
        f"{summary['frames']} frames, {summary['seconds_per_frame']:.2f} s a frame; surfaces:"
        f" {os.path.join(options.out, 'surface.npz')}"
    )


if __name__ == "__main__":
    cli(main)
