"""``python -m polysft_mi.run scene.xml -o OUT``: the template's surface in every frame of a
video.
"""

import contextlib
import gc
import json
import os
import shutil
import sys
import time

from . import commands
from .errors import InputError, cli

_EXAMPLES = [
    ("scenes/demo.xml -o out/demo", "the demo; then open out/demo/report.html"),
    (
        "scenes/flag.xml -D data=/data/flag -o out/flag -D order_max=10 -D last=19",
        "another place of the data, other settings, 20 frames",
    ),
    ("scenes/flag.xml -D data=/data/flag -o out/flag --resume", "go on after an interruption"),
    ("scenes/demo.xml -o out/demo --overwrite -q --json", "for scripts: one JSON object on stdout"),
]

_OURS = (
    "scene.xml",
    "camera.json",
    "run.json",
    "checkpoint.npz",
    "log.jsonl",
    "surface.npz",
    "params.npz",
    "metrics.json",
)
_PICTURES = ("loss.png", "comparison.png", "comparison.mp4", "report.html")
_FOLDERS = ("meshes", "comparison")


def parser():
    from .backend import add_mode_argument

    p = commands.parser(
        "run",
        "Reconstruct the surface of a textured template in every frame of a video.",
        _EXAMPLES,
    )
    p.add_argument(
        "scene", metavar="scene.xml", help="Mitsuba scene with a polysft integrator (docs/scene.md)"
    )
    p.add_argument("-o", "--output", metavar="OUT", required=True, help="folder for the results")
    p.add_argument(
        "-D",
        dest="define",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="override a <default> of the scene; may be repeated",
    )
    add_mode_argument(p)
    again = p.add_mutually_exclusive_group()
    again.add_argument("--overwrite", action="store_true", help="replace the run that OUT holds")
    again.add_argument("--resume", action="store_true", help="go on with the run that OUT holds")
    p.add_argument(
        "--exr",
        metavar="N",
        default="20",
        help="comparison EXRs for at most N frames, or 'all' (default: 20)",
    )
    p.add_argument(
        "--fps", type=float, default=15, help="frames a second of comparison.mp4 (default: 15)"
    )
    p.add_argument("--no-report", action="store_true", help="do not write report.html at the end")
    p.add_argument("-q", "--quiet", action="store_true", help="no progress, only the result")
    p.add_argument("--json", action="store_true", help="the result as one JSON object on stdout")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    overrides = {}
    for text in options.define:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError(f"-D {text}: NAME=VALUE is needed")
        overrides[name] = value
    try:
        exr_frames = sys.maxsize if options.exr == "all" else int(options.exr)
        if exr_frames < 0 or not 0 < options.fps <= 1000:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--exr {options.exr} --fps {options.fps}: a number of frames or 'all', and a positive"
            " rate, are needed"
        ) from None

    out = options.output
    _check_output(out, options)
    from .scene.defaults import resolved_defaults

    resolved_defaults(
        options.scene, overrides
    )  # a wrong name is told before anything heavy is loaded
    from .backend import set_variant

    set_variant(options.mode)
    return _run(options, overrides, out, exr_frames)


def _check_output(out, options):
    """Refuse an OUT that cannot be used, before anything is computed."""
    if os.path.exists(out) and not os.path.isdir(out):
        raise InputError(f"{out}: is a file; OUT must be a folder")
    existing = os.path.abspath(out)
    while not os.path.lexists(existing):
        existing = os.path.dirname(existing)
    if not out or not os.path.isdir(existing) or not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(
            f"-o '{out}': {existing} is not a folder that can be written to; OUT must be a folder"
            " there, or a new one"
        )
    holds_run = os.path.exists(os.path.join(out, "run.json"))
    if options.resume and not holds_run:
        raise InputError(f"{out}: holds no run to resume; leave out --resume to start one")
    if holds_run and not (options.overwrite or options.resume):
        raise InputError(
            f"{out}: holds another run; give --overwrite to replace it or --resume to go on with it"
        )
    if os.path.isdir(out) and os.listdir(out) and not holds_run:
        raise InputError(f"{out}: is not empty and holds no run; give an empty or new folder")


def _clear(out):
    """Remove what an earlier run of ours left; nothing else."""
    for name in (*_OURS, *_PICTURES):
        if os.path.exists(os.path.join(out, name)):
            os.remove(os.path.join(out, name))
    for name in (*_FOLDERS, "comparison.mp4", "export"):
        shutil.rmtree(os.path.join(out, name), ignore_errors=True)


def _run(options, overrides, out, exr_frames):
    from . import solvers
    from .objective.problem import Problem
    from .pictures.drawing import Drawing
    from .results import outputs
    from .scene import experiment as scene
    from .scene.sequence import Sequence
    from .tracker import Track, track

    experiment = scene.load(options.scene, overrides)
    s = experiment.settings
    sequence = Sequence.open(
        experiment.frames,
        experiment.masks,
        first=s.first,
        last=s.last,
        stride=s.stride,
        size=experiment.size,
    )
    problem = Problem(experiment, sequence)
    problem.check_start()
    solver = solvers.create(s)
    text = outputs.resolved_scene(experiment)
    if options.resume:
        _check_same(out, text)
    elif options.overwrite:
        _clear(out)
    os.makedirs(out, exist_ok=True)
    command = outputs.command_line()
    if not options.resume:
        outputs.write_beginning(out, text, problem.camera, command, options.fps)

    gc.freeze()  # what is loaded by now stays: the collector need not go through it again and again
    count = len(sequence.indices)
    began, status = time.perf_counter(), 0
    about = {"scene": os.path.abspath(experiment.path), **outputs.versions()}
    with (
        _half_the_threads() if s.solver == "gauss-newton" else contextlib.nullcontext(),
        Progress(count, s, options.quiet) as progress,
        Drawing(problem, overrides, out, exr_frames=exr_frames, about=about) as drawing,
    ):
        progress.say(
            f"template: {len(problem.template.vertices)} vertices, order {problem.template.fitted},"
            f" residual {1e3 * problem.template.residual_rms:.3g} mm RMS; {count} frames of"
            f" {experiment.size[0]}x{experiment.size[1]}, masks:"
            f" {'yes' if experiment.masks else 'no'}"
        )
        try:
            done = track(
                problem,
                solver,
                count,
                out,
                resume=options.resume,
                progress=progress,
                solved=drawing.frame,
            )
        except KeyboardInterrupt:
            path = os.path.join(out, "checkpoint.npz")
            done, status = (Track.load(path) if os.path.exists(path) else Track()), 130
            progress.say(
                f"interrupted: {len(done.states)} of {count} frames are kept; --resume goes on"
            )
        if not done.states:
            return status
        summary, plotted = outputs.write(
            problem, done, out, drawing, fps=options.fps, command=command, say=progress.stage
        )
        page = None if options.no_report else _report(out, progress)
        plotted()
    for frame, reason in summary["lost"].items():
        print(f"frame {frame}: {reason}; it keeps the state of the frame before", file=sys.stderr)
    seconds = time.perf_counter() - began
    if options.json:
        print(
            json.dumps({"out": out, "seconds": seconds, "report": page, **summary}, default=float)
        )
    else:
        _print_end(out, summary, page, seconds)
    return status


@contextlib.contextmanager
def _half_the_threads():
    """The second-order solver's kernels are short: with a thread a processor, threads mostly wait
    for each other, and none is left to draw.
    """
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(max(1, (os.cpu_count() or 1) // 2))
    try:
        yield
    finally:
        dr.set_thread_count(before)


def _report(out, progress):
    """The path of the report, or None after a warning: a finished run must not be lost to its
    page.
    """
    from . import report

    progress.stage("report")
    try:
        return report.write(out)
    except Exception as error:  # whatever it is, the results stand without the page
        print(f"no report: {type(error).__name__}: {error}", file=sys.stderr)
        return None


def _check_same(out, text):
    """Resuming with other settings would give a result that no scene describes."""
    path = os.path.join(out, "scene.xml")
    try:
        with open(path, encoding="utf-8") as file:
            same = file.read() == text
    except OSError:
        raise InputError(
            f"{path}: missing; the run cannot be resumed, give --overwrite to start again"
        ) from None
    if not same:
        raise InputError(
            f"{out}: was run with another scene or other settings (see {path}); resume with those,"
            " or give --overwrite"
        )


def _print_end(out, summary, page, seconds):
    print(
        f"{summary['frames']} of {summary['frames_wanted']} frames in {seconds:.0f} s,"
        f" {summary['seconds_per_frame']:.2f} s a frame ({summary['iterations_per_window']:.0f}"
        " iterations a window); inside the surface PSNR"
        f" {summary.get('psnr_mask', float('nan')):.2f} dB, SSIM"
        f" {summary.get('ssim_mask', float('nan')):.3f}"
    )
    look = f"{page or summary['video']} and {os.path.join(out, 'comparison.png')}"
    print(
        f"surfaces: {os.path.join(out, 'surface.npz')}, {os.path.join(out, 'meshes')}; look at"
        f" {look}"
    )


class Progress:
    """Where the run is: a bar on a terminal, a line now and then elsewhere, nothing where quiet."""

    def __init__(self, frames, settings, quiet):
        self.windows = frames - min(settings.width, frames) + 1
        self.first = min(settings.width, frames) - 1  # newest frame of the first window
        self.period, self.quiet, self.terminal = settings.period, quiet, sys.stderr.isatty()
        self._frame, self._began, self._done, self._shown = None, time.perf_counter(), 0, 0.0

    def __enter__(self):
        if self.terminal and not self.quiet:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[state]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bar.start()
            self._task = self._bar.add_task("tracking", total=self.windows, state="")
        return self

    def __exit__(self, *_):
        if self.terminal and not self.quiet:
            self._bar.stop()

    def __call__(self, frame, iteration, total, terms):
        if self.quiet:
            return
        now = time.perf_counter()
        if self._frame is None:
            self._start_window, self._began = frame - self.first, now
        if frame != self._frame:
            self._frame, self._done = frame, frame - self.first
        elif now - self._shown < (0.2 if self.terminal else 10):
            return
        self._shown = now
        state = f"frame {frame + 1}/{self.windows + self.first} it {iteration} loss {total:.4g}"
        detail = " ".join(f"{name[:3]} {value:.2g}" for name, value in terms.items() if value)
        if self.terminal:
            self._bar.update(
                self._task,
                completed=self._done + iteration / self.period,
                state=f"{state} ({detail})",
            )
        else:
            solved = self._done - self._start_window
            left = (
                f", {(now - self._began) / solved * (self.windows - self._done):.0f} s left"
                if solved
                else ""
            )
            print(f"{state} ({detail}){left}", file=sys.stderr)

    def say(self, text):
        if self.quiet:
            return
        if self.terminal:
            self._bar.console.print(text, highlight=False)
        else:
            print(text, file=sys.stderr)

    def stage(self, name):
        """What is being written after the tracking."""
        if self.terminal and not self.quiet:
            self._bar.update(self._task, completed=self.windows, state=f"writing {name}")


if __name__ == "__main__":
    cli(main)
