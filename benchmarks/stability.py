"""Does the surface stay where it is when the optimisation goes on? (Supplement, "Stability test".)

    python benchmarks/stability.py [scenes/demo.xml] [-D name=value ...] [--counts 50 300 1000 5000]
    [-o out/benchmarks] [-m llvm_ad_rgb]

The video is reconstructed as usual up to the frame before the last. The last window is then solved
once, from where that leaves it, with patience off, and what the solver would return after each of
the counts is kept: the best unknowns so far. Beside it stands the solver's latest step, which shows
how much it wanders. Figures are those of the window's newest frame; a shorter video (``-D
last=20``) tests another.

Writes ``stability_SCENE.json`` and ``stability_SCENE.png``, for ``demo.xml`` those of ``demo``.
"""

import argparse
import dataclasses
import math
import os
import tempfile
import time

import numpy as np
from sequences import ROOT

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.commands import add_define_argument, definitions
from polysft_mi.errors import InputError, cli

COUNTS = (50, 300, 1000, 5000)
USUAL = 300  # iterations that the paper evaluates at
CURVE = 25  # iterations between points of the curves


class Watched:
    """An objective whose solver is watched: what it has found, and where it is, after some numbers
    of evaluations.

    Solvers see an objective only through its methods, so this works for any that takes gradients.
    ``found`` and ``latest`` map a count to the unknowns of the newest frame: the best of so many
    evaluations, and those of the last one. ``losses`` maps it to (best, last), ``seconds`` to the
    processor's time until then, of all threads.
    """

    def __init__(self, frozen, counts):
        self._frozen, self._counts = frozen, set(counts)
        self._best, self._best_loss, self._evaluated = None, math.inf, 0
        self.found, self.latest, self.losses, self.seconds = {}, {}, {}, {}
        self._began = time.process_time()

    def __getattr__(self, name):
        return getattr(self._frozen, name)

    def evaluate(self, window, **options):
        total, terms = self._frozen.evaluate(window, **options)
        self._evaluated += 1
        if total < self._best_loss:
            self._best, self._best_loss = window[-1].copy(), total
        if self._evaluated in self._counts:
            self.found[self._evaluated], self.latest[self._evaluated] = (
                self._best,
                window[-1].copy(),
            )
            self.losses[self._evaluated] = (self._best_loss, total)
            self.seconds[self._evaluated] = time.process_time() - self._began
        return total, terms


def run(scene, overrides, counts, folder, say=print):
    """Solve the last window for as many iterations as the largest count.

    Returns (problem, frame, surfaces, wandering, watched): the newest frame, counted in the
    selection; the surfaces found and the solver's latest, count to vertices (N, 3) [m, camera
    frame]; the :class:`Watched`. ``folder``, which exists, takes the checkpoints of the run up to
    there.
    """
    from polysft_mi.objective import FrameContext, Problem
    from polysft_mi.scene import experiment as scenes
    from polysft_mi.solvers.adam import Adam
    from polysft_mi.tracker import FrameTracker, track

    experiment = scenes.load(scene, {"preset": "paper", **overrides})
    s = experiment.settings
    sequence = experiment.sequence()
    problem = Problem(experiment, sequence)
    problem.check_start()
    frame = len(sequence.indices) - 1
    tracker, states = FrameTracker(problem), [problem.patch.rest().to_numpy()]
    if frame > 0:
        say(f"frames 0 to {frame - 1} of the selection as usual ...")
        states = track(tracker, frame, folder).states
        states.append(states[-1])  # each new frame is started from the last
    window = [problem.atlas.state(state) for state in states[-s.window :]]
    members = list(range(frame + 1 - len(window), frame + 1))
    last = max(counts)
    say(f"frames {members[0]} to {frame}: {last} iterations ...")
    objective = tracker.objective
    contexts = [FrameContext(k) for k in members]
    frozen = objective.frozen(contexts, objective.usual[-1], window)
    watched = Watched(frozen, {*counts, *range(CURVE, last + 1, CURVE)})
    Adam(dataclasses.replace(s, patience=last, period=last)).minimise(watched, window)
    missing = sorted(set(counts) - set(watched.found))
    if missing:
        raise InputError(f"--counts {' '.join(map(str, missing))}: solver {s.solver} ended before")
    surfaces, wandering = (
        {n: problem.surface(u).astype(np.float64) for n, u in kept.items()}
        for kept in (watched.found, watched.latest)
    )
    return problem, frame, surfaces, wandering, watched


def truth_of(problem, frame, path):
    """True vertices (N, 3) of a frame, or None where nothing is known."""
    from polysft_mi.results.truth import find_truth, load_npz
    from polysft_mi.scene.defaults import located

    experiment = problem.experiment
    if path is None and experiment.defaults.get("data"):
        path = located(experiment.path, experiment.defaults["data"])
        if not os.path.exists(os.path.join(path, "gt.npz")):
            return None
    if path is None:
        return None
    truth = load_npz(find_truth(path))
    index, count = problem.sequence.indices[frame], len(problem.template.vertices)
    if (
        "vertices" not in truth
        or truth["vertices"].shape[1] != count
        or index >= len(truth["vertices"])
    ):
        raise InputError(
            f"--truth {path}: true positions of {count} vertices in frame {index} are needed"
            " (vertices, shape (T, N, 3))"
        )
    return truth["vertices"][index].astype(np.float64)


def figures_of(surfaces, wandering, watched, usual, truth):
    """Count to figures: distance to the truth, and to the surface after ``usual`` iterations; time
    of the processor.
    """
    from polysft_mi.results import metrics

    out = {}
    for n, V in surfaces.items():
        moved = np.linalg.norm(V - surfaces[usual], axis=1)
        row = {
            "loss": watched.losses[n][0],
            "seconds": watched.seconds[n],
            "change_rms_mm": 1e3 * metrics.rmse(V, surfaces[usual]),
            "change_max_mm": 1e3 * float(moved.max()),
        }
        row["wandering_rms_mm"] = 1e3 * metrics.rmse(wandering[n], V)
        if truth is not None:
            row |= {
                "rmse_mm": 1e3 * metrics.rmse(V, truth),
                "e3d": metrics.e3d(V, truth),
                "e3d_proc": metrics.e3d_procrustes(V, truth),
            }
            row["latest_e3d"] = metrics.e3d(wandering[n], truth)
        out[n] = row
    return out


def picture(path, problem, frame, surfaces, counts, rows, usual, truth):
    """The surfaces over the image and from the side, count beside count; below, what changes over
    the iterations.
    """
    from matplotlib.figure import Figure

    from polyfit.colours import srgb
    from polyfit.mesh import boundary_edges
    from polyfit.pictures import SideView, Triangles

    template, image = problem.template, srgb(problem.sequence.frame(frame))
    shown = [(f"{n} iterations", surfaces[n]) for n in counts] + (
        [("truth", truth)] if truth is not None else []
    )
    view = SideView.around(np.stack([V for _, V in shown]))
    height, width = image.shape[:2]
    projected = [problem.camera.project(V)[0] for _, V in shown]
    low, high = np.concatenate(projected).min(axis=0), np.concatenate(projected).max(axis=0)
    low, high = np.maximum(low - 12, 0), np.minimum(high + 12, (width, height))
    figure = Figure(figsize=(3 * len(shown), 8), dpi=110, layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(2.2, 1))
    grid = above.subplots(2, len(shown), squeeze=False)
    for k, ((label, V), xy) in enumerate(zip(shown, projected)):
        over, beside = grid[:, k]
        over.imshow(image, extent=(0, width, height, 0))
        for j in range(
            2
        ):  # lines of equal u and of equal v: the template's own grid of ten by ten cells
            uv = template.texcoords.of_vertices(template.faces)[:, j]
            levels = np.linspace(uv.min(), uv.max(), 11)[1:-1]
            over.tricontour(
                xy[:, 0],
                xy[:, 1],
                template.faces,
                uv,
                levels=levels,
                colors="white",
                linewidths=0.6,
            )
        for edge in boundary_edges(template.faces):
            over.plot(xy[edge, 0], xy[edge, 1], color="#ffb000", linewidth=1.2)
        over.set_xlim(low[0], high[0]), over.set_ylim(high[1], low[1])
        over.set_title(label, fontsize=10)
        beside.imshow(
            Triangles(V, template.faces).shaded(view, template.texcoords.corners, (360, 300))
        )
        if k < len(counts):
            row = rows[counts[k]]
            text = f"e3d {row['e3d']:.4f}, " if truth is not None else ""
            beside.set_xlabel(f"{text}{row['change_rms_mm']:.1f} mm from {usual}", fontsize=8)
        for axes in (over, beside):
            axes.set_xticks([]), axes.set_yticks([])
    n = sorted(rows)
    left, right = below.subplots(1, 2)
    if truth is not None:
        left.plot(
            n,
            [rows[k]["latest_e3d"] for k in n],
            color="0.75",
            linewidth=0.8,
            label="the solver's latest step",
        )
        left.plot(n, [rows[k]["e3d"] for k in n], color="#c4572e", label="what it would return")
        left.set_title("e3d", fontsize=9, loc="left")
    else:
        left.plot(n, [rows[k]["loss"] for k in n], color="#c4572e", label="what it would return")
        left.set_title("loss", fontsize=9, loc="left")
    right.plot(
        n, [rows[k]["change_rms_mm"] for k in n], color="#3b6ea5", label="RMS over the vertices"
    )
    right.plot(n, [rows[k]["change_max_mm"] for k in n], color="#9db9d6", label="largest")
    right.set_title(f"distance from the surface at {usual} iterations [mm]", fontsize=9, loc="left")
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_xticks(counts, [str(c) for c in counts])
        axes.minorticks_off()
        axes.set_xlabel("iterations")
        axes.set_ylim(bottom=0)
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    with aside(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "scene",
        nargs="?",
        metavar="scene.xml",
        default=os.path.join(ROOT, "scenes", "demo.xml"),
        help="default: the demo",
    )
    add_define_argument(p)
    p.add_argument(
        "--counts",
        nargs="+",
        type=int,
        metavar="N",
        default=COUNTS,
        help="iterations to look at (default: 50 300 1000 5000)",
    )
    p.add_argument(
        "--truth",
        metavar="PATH",
        help="gt.npz, or a folder that holds it (default: the scene's data folder, where it does)",
    )
    p.add_argument(
        "-o",
        "--out",
        metavar="FOLDER",
        default="out/benchmarks",
        help="for stability_SCENE.json and .png (default: out/benchmarks)",
    )
    add_mode_argument(p)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    counts = sorted(set(options.counts))
    if counts[0] < 1:
        raise InputError(f"--counts {counts[0]}: at least 1 iteration is needed")
    overrides = definitions(options.define)
    usual = min(USUAL, counts[-1])
    set_variant(options.mode)
    from polysft_mi.results import outputs

    os.makedirs(options.out, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        problem, frame, surfaces, wandering, watched = run(
            options.scene, overrides, [*counts, usual], folder
        )
    truth = truth_of(problem, frame, options.truth)
    scene = os.path.basename(options.scene)
    result = os.path.join(options.out, f"stability_{os.path.splitext(scene)[0]}")
    rows = figures_of(surfaces, wandering, watched, usual, truth)
    picture(
        f"{result}.png",
        problem,
        frame,
        surfaces,
        counts,
        rows,
        usual,
        truth,
    )
    report = {
        "scene": scene,
        "overrides": {name: x for name, x in overrides.items() if name != "data"},
        "frame": int(problem.sequence.indices[frame]),
        "versions": outputs.versions(),
        "counts": {str(n): rows[n] for n in counts},
        "curve": {str(n): rows[n] for n in sorted(rows)},
    }
    outputs.write_json(f"{result}.json", report)
    names = list(rows[counts[0]])
    print("iterations" + "".join(f"{name:>18s}" for name in names))
    for n in counts:
        print(f"{n:10d}" + "".join(f"{rows[n][name]:18.5g}" for name in names))
    print(f"frame {report['frame']}; written: {result}.json, {result}.png")


if __name__ == "__main__":
    cli(main)
