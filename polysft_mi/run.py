"""``python -m polysft_mi.run scene.xml -o OUT``: the template's surface in every frame of a
video.
"""

from __future__ import annotations

import gc
import math
import os
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from polyfit.files import json_text

from . import commands
from .errors import InputError, cli
from .results import Progress, folder

_DOUBTS = 5  # lines of them
_DOUBTED = 5.0  # [pixels] from the surface above which tracks are of another video
_EXAMPLES = [
    ("scenes/demo.xml -o out/demo", "the demo; then open out/demo/report.html"),
    (
        "scenes/flag.xml -D data=/data/flag -o out/flag -D order=6 -D last=19",
        "with your own data folder, order 6, and the first 20 frames",
    ),
    ("scenes/flag.xml -D data=/data/flag -o out/flag --resume", "continue after an interruption"),
    ("scenes/demo.xml -o out/demo --overwrite -q --json", "for scripts: one JSON object on stdout"),
]


def parser():
    p = commands.parser(
        "run",
        "Reconstruct the surface of a textured template in every frame of a video.",
        _EXAMPLES,
    )
    p.add_argument(
        "scene", metavar="scene.xml", help="Mitsuba scene with a polysft integrator (docs/scene.md)"
    )
    p.add_argument("-o", "--output", metavar="OUT", required=True, help="folder for the results")
    add_options(p)
    return p


def add_options(p):
    """Add the options of a run to the parser ``p``, all but the scene and ``--output``."""
    from polyfit.backend import add_mode_argument

    commands.add_define_argument(p)
    add_mode_argument(p)
    again = p.add_mutually_exclusive_group()
    again.add_argument("--overwrite", action="store_true", help="replace the run that OUT holds")
    again.add_argument("--resume", action="store_true", help="continue the run that OUT holds")
    p.add_argument(
        "--exr",
        metavar="N",
        default="20",
        help="comparison EXRs for at most N frames, or 'all' (default: 20)",
    )
    p.add_argument(
        "--fps",
        type=float,
        help="frames a second of comparison.mp4 and exports (default: the scene's"
        " fps, over its stride)",
    )
    p.add_argument("--no-report", action="store_true", help="do not write report.html at the end")
    p.add_argument("-q", "--quiet", action="store_true", help="no progress, only the result")
    p.add_argument("--json", action="store_true", help="the result as one JSON object on stdout")


def main(arguments=None):
    options = parser().parse_args(arguments)
    return execute("run", options.scene, options)


def execute(name, scene, options):
    """Reconstruct ``scene`` as the parsed ``options`` of :func:`add_options` say, for the command
    ``name``, and print the result. Returns the exit status.
    """
    overrides = commands.definitions(options.define)
    if options.exr != "all" and not options.exr.isdecimal():
        raise InputError(f"--exr {options.exr}: a number of frames or 'all' is needed")
    exr_frames = sys.maxsize if options.exr == "all" else int(options.exr)
    outcome = reconstruct(
        scene,
        options.output,
        overrides,
        variant=options.mode,
        resume=options.resume,
        overwrite=options.overwrite,
        exr_frames=exr_frames,
        fps=options.fps,
        report=not options.no_report,
        quiet=options.quiet,
        command=shlex.join(["python", "-m", f"polysft_mi.{name}", *sys.argv[1:]]),
    )
    if options.json and outcome.summary:
        print(json_text(outcome.as_json()))
    else:
        print(outcome.as_text(), end="")
    return 130 if outcome.interrupted else 0


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    ``out``: its folder; ``summary``: the figures that metrics.json begins with, and the path
    ``video``; empty where no frame was done. ``report``: the path of the page, or None;
    ``seconds``: what the run took; ``interrupted``: whether Ctrl-C ended it.
    """

    out: str
    summary: dict = field(default_factory=dict)
    report: str | None = None
    seconds: float = 0.0
    interrupted: bool = False

    def as_json(self) -> dict:
        """The summary as one object, with ``out``, ``seconds`` and ``report``."""
        return {"out": self.out, "seconds": self.seconds, "report": self.report, **self.summary}

    def as_text(self) -> str:
        """What the command prints: one fact a line, last what to do next."""
        if not self.summary:
            return ""
        s = self.summary
        lines = [
            f"frames: {s['frames']} of {s['frames_wanted']} in {self.seconds:.0f} s",
            f"speed: {s['seconds_per_frame']:.2f} s a frame,"
            f" {s['iterations_per_window']:.0f} iterations a window",
            f"inside the surface: PSNR {s.get('psnr_mask', float('nan')):.2f} dB,"
            f" SSIM {s.get('ssim_mask', float('nan')):.3f}"
            + (f", silhouettes: IoU {s['iou']:.3f}" if "iou" in s else ""),
            *_fits(s),
            *_doubts(s.get("doubtful", {})),
            f"surfaces: {os.path.join(self.out, 'surface.npz')}",
            f"meshes: {os.path.join(self.out, 'meshes')}",
            f"pictures: {os.path.join(self.out, 'comparison.png')}",
            f"video: {s['video']}",
            "next: the same command with --resume, for what is missing"
            if self.interrupted
            else f"next: open {self.report or s['video']}",
        ]
        if known := s.get("undecided"):
            first = f"undecided: from frame {known['from']} on"
            other = os.path.join(self.out, folder.OTHER)
            lines.insert(-1, f"{first} a second surface explains the video nearly as well: {other}")
        return "".join(line + "\n" for line in lines)


def _fits(summary):
    """A line for each kind of evidence beside the images: how much of it was used, and how far from
    the surface it is.
    """
    for name, of, unit, least in (("tracks", "", "px", _DOUBTED), ("depth", " images", "mm", None)):
        if not (known := summary.get(name)):
            continue
        line = f"{name}: {known['used']} of {known['given']}{of} used"
        noise = known[f"noise_{unit}"]
        if math.isfinite(noise):
            line += f", noise {noise:.2g} {unit}"
        if least and noise > least:
            line += ": are they of this video?"
        yield line


def _doubts(doubtful):
    """A line for each row of frames that their surfaces do not explain."""
    frames = [int(frame) for frame in doubtful]
    rows: list[list[int]] = []
    for frame in frames:
        if rows and frame == rows[-1][-1] + 1:
            rows[-1].append(frame)
        else:
            rows.append([frame])
    for row in rows[:_DOUBTS]:
        which = f"frames {row[0]} to {row[-1]}" if len(row) > 1 else f"frame {row[0]}"
        yield f"doubtful: {which}: {doubtful[str(row[0])]}"
    if len(rows) > _DOUBTS:
        yield f"doubtful: and {sum(map(len, rows[_DOUBTS:]))} more frames, in metrics.json"


def reconstruct(
    scene: str | os.PathLike[str],
    out: str | os.PathLike[str],
    overrides: Mapping[str, object] | None = None,
    *,
    variant: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    exr_frames: int = 20,
    fps: float | None = None,
    report: bool = True,
    quiet: bool = True,
    command: str | None = "polysft_mi.reconstruct",
) -> Outcome:
    """Reconstruct the surface in every frame of a scene's video: what ``polysft run`` does.

    ``scene``: the path of the scene; ``out``: the folder for the results; ``overrides``: name to
    value of the scene's defaults; ``variant``: Mitsuba's, as
    :func:`polysft_mi.set_variant` takes it. ``resume`` goes on with the run that ``out``
    holds, ``overwrite`` replaces it. ``exr_frames``: comparison EXRs at most; ``fps``: frames a
    second of the result, by default the scene's; ``report``: whether report.html is written;
    ``quiet``: no progress on stderr; ``command``: what run.json and the report say made the result.

    Returns the :class:`Outcome`; Ctrl-C ends the run early and keeps the frames that are done.
    Raises InputError.
    """
    scene, out = os.fspath(scene), os.fspath(out)
    from polyfit.backend import set_variant
    from polyfit.mesh import seam_note, size_note

    from .scene import resolved_defaults

    if fps is not None and not 0 < fps <= 1000:
        raise InputError(f"--fps {fps:g}: a rate above 0, at most 1000, is needed")
    began = time.perf_counter()
    overrides = {name: str(value) for name, value in (overrides or {}).items()}
    folder.check_output(out, resume=resume, overwrite=overwrite)
    resolved_defaults(scene, overrides)  # a wrong name is told before anything heavy is loaded
    set_variant(variant)

    from .objective import Problem
    from .pictures import Drawing
    from .render import threads
    from .results import outputs
    from .scene import experiment as experiments
    from .surface.meshio import uv_note
    from .tracker import FrameTracker

    experiment = experiments.load(scene, overrides)
    mesh = experiment.template
    notes = (
        size_note(mesh.vertices, scene, "template"),
        seam_note(mesh.vertices, mesh.faces, scene),
    )
    far = uv_note(mesh.texcoords, scene)
    for note in (*experiment.notes, *notes, far and f"note: {far}"):
        if note:
            print(note, file=sys.stderr)
    s = experiment.settings
    fps = s.rate if fps is None else fps
    sequence = experiment.sequence()
    problem = Problem(experiment, sequence)
    problem.check_start()
    if problem.bleached:
        note = "the frames are grey, and so the texture is taken without its colours"
        print(f"note: {scene}: {note}", file=sys.stderr)
    tracker = FrameTracker(problem)
    text, inputs = outputs.resolved_scene(experiment), folder.digest(experiment.inputs(sequence))
    if resume:
        folder.check_same(out, text, inputs)
    elif overwrite:
        folder.clear(out)
    os.makedirs(out, exist_ok=True)
    if not resume:
        cameras = problem.camera, sequence.cameras
        outputs.write_beginning(out, text, *cameras, command, fps, inputs)

    gc.freeze()  # what is loaded by now stays: the collector need not go through it again and again
    about = {"scene": os.path.abspath(experiment.path), **outputs.versions()}
    with (
        threads(0.5 if tracker.solver.name == "gauss-newton" else 1.0),
        Progress(len(sequence.indices), s, quiet) as progress,
        Drawing(problem, overrides, out, exr_frames=exr_frames, about=about) as drawing,
    ):
        progress.say(_beginning(problem))
        done, interrupted = _track(tracker, out, resume, progress, drawing)
        if not done.states:
            return Outcome(out, interrupted=interrupted)
        try:
            summary, plotted = outputs.write(
                problem,
                done,
                out,
                drawing,
                fps=fps,
                command=command,
                say=progress.stage,
                fits=tracker.objective.fits,
            )
            if sequence.cameras:
                plotted()  # the page shows their pictures
            page = _report(out, progress) if report else None
            plotted()
        except KeyboardInterrupt:
            progress.say("interrupted while results were written; --resume writes them")
            raise
    for frame, reason in summary["lost"].items():
        print(f"frame {frame}: {reason}; it keeps the state of the frame before", file=sys.stderr)
    return Outcome(out, summary, page, time.perf_counter() - began, interrupted)


def _beginning(problem):
    experiment, template = problem.experiment, problem.template
    jets = "its jet" if len(template) == 1 else f"its {len(template)} jets"
    residual = round(1e3 * template.residual_rms, 9)  # [mm]
    return (
        f"template: {len(template.vertices)} vertices\n"
        f"{jets}: order {template.order}, residual {residual:.3g} mm RMS\n"
        f"video: {len(problem.sequence.indices)} frames of"
        f" {experiment.size[0]}x{experiment.size[1]},"
        f" {'with' if experiment.masks else 'without'} masks"
    )


def _track(tracker, out, resume, progress, drawing):
    """The :class:`polysft_mi.tracker.Track`, and whether Ctrl-C ended it early."""
    from .tracker import CHECKPOINT, Track, track

    count = len(tracker.problem.sequence.indices)
    try:
        done = track(tracker, count, out, resume=resume, progress=progress, solved=drawing.frame)
        return done, False
    except KeyboardInterrupt:
        path = os.path.join(out, CHECKPOINT)
        done = Track.load(path) if os.path.exists(path) else Track()
        progress.say(
            f"interrupted: {len(done.states)} of {count} frames are kept; --resume continues"
        )
        return done, True


def _report(out, progress):
    """The path of the report, or None after a warning: a finished run must not be lost to its
    page.
    """
    from .pictures import write_report

    progress.stage("report")
    try:
        return write_report(out)
    except Exception as error:  # whatever it is, the results stand without the page
        print(f"no report: {type(error).__name__}: {error}", file=sys.stderr)
        return None


if __name__ == "__main__":
    cli(main)
