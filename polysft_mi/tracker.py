"""The adaptive sliding window over a video (supplement, "Adaptive Window Optimization"), with
checkpoints.

Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

import functools
import json
import math
import os
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from polyfit.files import aside, naming

from .errors import BadFrame, InputError
from .objective import TERMS, Problem
from .render import interruptible
from .solvers import Solver
from .surface import Unknowns

CHECKPOINT, _LOG = "checkpoint.npz", "log.jsonl"
_MIN_VISIBLE_SHARE = (
    0.02  # share of the vertices inside the image below which the surface is said to have left it
)
_MAX_HISTORY = 20  # frames that a solver is told of
_LOG_EVERY = 10  # iterations between records of the log


@dataclass
class Track:
    """The state of a run: unknowns of the frames reached so far, and what each window took.

    ``states``: one dict of arrays (:meth:`Unknowns.to_numpy`) a frame; ``next_window``: first frame
    of the next window to solve; ``iterations``, ``seconds``: one entry a solved window; ``totals``:
    its terms at the minimum; ``lost``: frame -> reason for those that keep the state of the frame
    before; ``unusable``: those among them whose image breaks the objective; ``sigma``: frame ->
    standard deviation of each vertex along its ray [m], from solvers that know; ``swept``: frames
    gone over by the setting ``sweeps``, each as often as it was; ``finished``: whether the solver
    has looked back over the whole.
    """

    states: list = field(default_factory=list)
    next_window: int = 0
    iterations: list = field(default_factory=list)
    seconds: list = field(default_factory=list)
    totals: list = field(default_factory=list)
    lost: dict = field(default_factory=dict)
    unusable: dict = field(default_factory=dict)
    sigma: dict = field(default_factory=dict)
    swept: int = 0
    finished: bool = False

    def save(self, path: str | os.PathLike[str]) -> None:
        arrays: dict[str, Any] = {
            name: np.stack([s[name] for s in self.states]) for name in Unknowns.NAMES
        }
        meta = {
            k: getattr(self, k)
            for k in (
                "next_window",
                "iterations",
                "seconds",
                "totals",
                "lost",
                "unusable",
                "swept",
                "finished",
            )
        }
        known = sorted(self.sigma)
        sigma: dict[str, Any] = (
            {
                "sigma_frames": np.array(known, dtype=np.int64),
                "sigma": np.stack([self.sigma[k] for k in known]),
            }
            if known
            else {}
        )
        with aside(path) as temporary:
            np.savez(temporary, meta=json.dumps(meta), **arrays, **sigma)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Track:
        try:
            with np.load(path) as data:
                meta = json.loads(str(data["meta"]))
                arrays = {name: data[name] for name in Unknowns.NAMES}
                sigma = (
                    dict(zip(data["sigma_frames"].tolist(), data["sigma"]))
                    if "sigma" in data
                    else {}
                )
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(
                f"{path}: not a checkpoint of a run ({error}); start again with --overwrite"
            ) from None
        for name in ("lost", "unusable"):
            meta[name] = {int(k): v for k, v in meta[name].items()}
        count = len(arrays["rotation"])
        return cls(
            states=[{name: arrays[name][k] for name in arrays} for k in range(count)],
            sigma=sigma,
            **meta,
        )


def track(
    problem: Problem,
    solver: Solver,
    frames: int,
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    progress: Callable[[int, int, int, float, dict], None] | None = None,
    solved: Callable[[int, np.ndarray], None] | None = None,
) -> Track:
    """Solve window after window; checkpoints and the log go to the folder ``out``. Returns the
    :class:`Track`.

    ``frames``: number of frames. ``progress(done, frame, iteration, total, terms)`` is called after
    each evaluation; ``done``: windows, and frames gone over again, before this one.
    ``solved(frame, vertices)`` is called with the surface (N, 3) [m, world] of each frame as soon
    as no later window moves it; only the settings ``sweeps`` and ``smooth`` may still change it.
    If the objective stops being finite, or the surface leaves the image, the new frame keeps the
    state of the one before, and the run goes on. KeyboardInterrupt passes through; the checkpoint
    on disk is then that of the last complete window, or of the last frame that a sweep went over.
    """
    width = min(problem.settings.width, frames)
    checkpoint, log_path = os.path.join(out, CHECKPOINT), os.path.join(out, _LOG)
    done = Track.load(checkpoint) if resume and os.path.exists(checkpoint) else Track()
    _trim_log(log_path, done.next_window)
    with interruptible(), naming(log_path), open(log_path, "a", encoding="utf-8") as log:
        for start in range(done.next_window, frames - width + 1):
            _advance(problem, solver, done, start, width, log, progress)
            log.flush()
            done.save(checkpoint)
            if solved:
                solved(start, problem.surface(Unknowns.from_numpy(done.states[start])))
        for k, neighbour in _swept(frames, problem.settings.sweeps)[done.swept :]:
            _retry(problem, solver, done, k, neighbour, progress)
            done.swept += 1
            done.save(checkpoint)
    smooth = problem.settings.smooth > 0 and hasattr(solver, "revisit")
    if smooth and len(done.totals) == frames and not done.finished:
        with interruptible():
            _smooth(problem, solver, done)
        done.finished = True
        done.save(checkpoint)
    return done


def _swept(frames, sweeps):
    """(frame, neighbour that it starts from) of so many sweeps, each backward and then forward over
    all frames but the first, which the texture was taken from.
    """
    backward = [(k, k + 1) for k in range(frames - 2, 0, -1)]
    return (backward + [(k, k - 1) for k in range(1, frames)]) * sweeps


def _retry(problem, solver, done, k, neighbour, progress):
    """Solve frame ``k`` again from its neighbour's surface, and keep what costs less."""
    if k in done.unusable:
        return
    began, before = time.perf_counter(), range(max(0, k - _MAX_HISTORY), k)
    past = [(done.states[j], done.totals[j]) for j in before]
    report = progress and functools.partial(progress, len(done.totals) + done.swept, k)
    start, state, terms = done.states[neighbour], done.states[k], done.totals[k]
    try:
        solution = solver.retry(problem, k, start, state, terms, past, report)
    except BadFrame:
        return
    if solution and problem.visible_share(solution.window[0]) >= _MIN_VISIBLE_SHARE:
        _replace(done, k, solution)
    done.seconds[k] += time.perf_counter() - began


def _replace(done, k, solution):
    """Let frame ``k``, solved again, have this solution."""
    done.states[k] = solution.window[0].to_numpy()
    done.totals[k] = _numbers({**solution.terms, **solution.facts})
    done.sigma[k] = solution.sigma[0]
    done.lost.pop(k, None)


def _smooth(problem, solver, done):
    """Solve every frame again, from the last to the first and back, held to the middle of its
    neighbours by the setting ``smooth``.
    """
    count, weight = len(done.totals), problem.settings.smooth
    for k in (*range(count - 2, 0, -1), *range(1, count - 1)):
        if k in done.unusable:
            continue
        began = time.perf_counter()
        try:
            solution = solver.revisit(
                problem, k, done.states[k - 1], done.states[k + 1], done.totals[k], weight
            )
        except BadFrame:
            continue
        _replace(done, k, solution)
        done.seconds[k] += time.perf_counter() - began


def _numbers(values):
    """JSON has no NaN: None instead."""
    return {name: x if np.isfinite(x).all() else None for name, x in values.items()}


def _advance(problem, solver, done, start, width, log, progress):
    """Solve the window of frames start .. start + width - 1."""
    members = list(range(start, start + width))
    while len(done.states) < start + width:
        done.states.append(
            dict(done.states[-1]) if done.states else problem.patch.rest().to_numpy()
        )
    began = time.perf_counter()
    latest = [0]

    def record(iteration, total, terms, **more):
        numbers = _numbers({"loss": total, **terms})
        log.write(
            json.dumps(
                {
                    "frame": problem.sequence.indices[members[-1]],
                    "iteration": iteration,
                    **numbers,
                    **more,
                }
            )
            + "\n"
        )

    def report(iteration, total, terms):
        latest[0] = iteration + 1
        if iteration % _LOG_EVERY == 0:
            record(iteration, total, terms)
        if progress:
            progress(start, members[-1], iteration, total, terms)

    solved, sigma, terms, facts, failed = {}, {}, dict.fromkeys(TERMS, math.nan), {}, {}
    while usable := [k for k in members if k not in done.unusable]:
        before = [Unknowns.from_numpy(done.states[k]) for k in usable]
        try:
            earlier = range(max(0, members[-1] - _MAX_HISTORY), members[-1]) if start else []
            past = [
                (done.states[k], done.totals[k - width + 1] if k >= width - 1 else {})
                for k in earlier
            ]
            solution = solver.solve(problem, before, usable, report, past)
            solved, terms, facts, latest[0] = (
                dict(zip(usable, solution.window)),
                solution.terms,
                solution.facts,
                solution.iterations,
            )
            sigma = dict(zip(usable, solution.sigma or []))
            break
        except BadFrame as error:
            if latest[
                0
            ]:  # it was finite at the start: the solver ran away, the image is not to blame
                failed[members[-1]] = f"{error} at iteration {latest[0]}"
                break
            done.unusable[error.frame] = f"{error} from the start"
    record(latest[0], sum(terms.values()), terms, best=True)

    for k in members:
        if k in solved:
            state = solved[k].to_numpy()
            if not all(np.isfinite(x).all() for x in state.values()):
                failed[k] = "its state is not finite"
            elif problem.visible_share(solved[k]) < _MIN_VISIBLE_SHARE:
                failed[k] = "the surface left the image"
            else:
                done.states[k] = state
                if k in sigma:
                    done.sigma[k] = sigma[k]
        if k > 0 and (k in failed or k in done.unusable):
            done.states[k] = dict(done.states[k - 1])
    done.lost = (
        {k: reason for k, reason in done.lost.items() if k not in members} | failed | done.unusable
    )
    done.next_window = start + 1
    done.iterations.append(latest[0])
    done.seconds.append(time.perf_counter() - began)
    done.totals.append(_numbers({**terms, **facts}))


def _trim_log(path, next_window):
    """Keep the records of the windows that the checkpoint holds: each ends with one marked
    ``best``.
    """
    if not os.path.exists(path):
        return
    kept, whole = [], 0
    with open(path, encoding="utf-8") as file:
        pending = []
        for line in file:
            pending.append(line)
            if whole < next_window and '"best": true' in line:
                kept, pending, whole = kept + pending, [], whole + 1
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.writelines(kept)
