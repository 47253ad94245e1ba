"""The adaptive sliding window over a video (supplement, "Adaptive Window Optimization"), with
checkpoints. Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

import functools
import json
import math
import os
import time
from collections.abc import Callable

import numpy as np
from scipy.linalg import LinAlgError
from threadpoolctl import ThreadpoolController

from polyfit.files import aside, naming
from polysft_mi.errors import BadFrame, InputError
from polysft_mi.render import interruptible
from polysft_mi.surface import Unknowns

from . import branches
from .checkpoint import CHECKPOINT, Track
from .frame import FrameTracker

_LOG = "log.jsonl"
_MIN_VISIBLE_SHARE = (
    0.02  # share of the vertices inside the image below which the surface is said to have left it
)
_MAX_HISTORY = 20  # frames before that a frame is told of
_LATEST = 20  # frames after which a mirror image, or a rim, is tried again
_RIM_EVERY = 3  # frames, at least, from one try of a rim to the next


def track(
    tracker: FrameTracker,
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
    as no later window moves it; only a second pass over a noisy video, and the settings ``sweeps``
    and ``smooth``, may still change it.
    If the objective stops being finite, or the surface leaves the image, the new frame keeps the
    state of the one before, and the run goes on. KeyboardInterrupt passes through; the checkpoint
    on disk is then that of the last complete window, or of the last frame that a sweep went over.
    Raises InputError where the video has fewer frames.
    """
    count = len(tracker.problem.sequence)
    if not 1 <= frames <= count:
        raise InputError(f"frames = {frames}; 1 to {count}, as many as the video has, are needed")
    settings, checkpoint = tracker.settings, os.path.join(out, CHECKPOINT)
    width, log_path = min(settings.window, frames), os.path.join(out, _LOG)
    stages, rules = tracker.objective.stages, tracker.objective.rules
    found = resume and os.path.exists(checkpoint)
    done = Track.load(checkpoint, stages, rules) if found else Track()
    done.solver = tracker.solver.name
    _trim_log(log_path, done.next_window)
    # BLAS's own threads cost more than they bring on small blocks, and wait for Dr.Jit's
    one_thread = ThreadpoolController().limit(limits=1, user_api="blas")
    with (
        interruptible(),
        one_thread,
        naming(log_path),
        open(log_path, "a", encoding="utf-8") as log,
    ):
        for k in range(done.next_window + width - 1 if done.states else 0):
            _observe(tracker, done, k)
        for start in range(done.next_window, frames - width + 1):
            _advance(tracker, done, start, width, log, progress)
            for k in range(start + width - 1 if start else 0, start + width):
                _observe(tracker, done, k)
            log.flush()
            _look_around(tracker, done, start, progress)
            done.save(checkpoint, stages)
            if solved:
                solved(start, _vertices(tracker.problem, done.states[start]))
        if done.other and len(done.totals) == frames:
            branches.decide(done)  # which is shown; the other one is kept beside it
        if not done.second and tracker.doubts(done.totals, done.memories):
            _second_pass(tracker, done, frames, checkpoint, progress)
        for k, neighbour in _swept(frames, settings.sweeps)[done.swept :]:
            _retry(tracker, done, k, neighbour, progress)
            done.swept += 1
            done.save(checkpoint, stages)
        if settings.smooth > 0 and len(done.totals) == frames and not done.finished:
            _smooth(tracker, done)
            done.finished = True
            done.save(checkpoint, stages)
    return done


def _second_pass(tracker, done, frames, checkpoint, progress):
    """Track a video that was done once more, boldly, and keep that where other terms than the one
    whose misfit is doubted say so.
    """
    stages = tracker.objective.stages
    report = progress and (lambda n, *told: progress(len(done.totals) + n, *told))
    if not done.again:
        done.again = branches.second_pass(done)
    again = done.again
    for k in range(again.next_window):
        _observe(tracker, again, k)
    for k in range(again.next_window, frames):
        _advance(tracker, again, k, 1, None, report)
        _observe(tracker, again, k)
        _look_around(tracker, again, k, report)
        done.save(checkpoint, stages)
    if again.other:
        branches.decide(again)
    branches.settle(done, tracker.objective.rules.second_pass)
    done.save(checkpoint, stages)


def _look_around(tracker, done, k, progress):
    """What else may explain frame ``k``, that was solved: its mirror image, another rim."""
    _follow(tracker, done, k, progress)
    for branch in filter(None, (done, done.other)):
        _unfold(tracker, branch, k, progress)


def _follow(tracker, done, k, progress):
    """Go on with the other branch of the track in frame ``k``, and drop what has cost more. Where
    there is none, begin one if the mirror image explains this frame as well; the worse it does,
    the later it is tried again.
    """
    share = tracker.objective.rules.mirror_share
    if done.other:
        _advance(tracker, done.other, k, 1, None, progress)
        done.seconds[k] = done.other.seconds[k] = done.seconds[k] + done.other.seconds[k]
        if branches.decide(done, share):
            done.other, done.mirror_at = None, k + 1
    elif tracker.mirrors and k >= done.mirror_at and k not in done.lost:
        began = time.perf_counter()
        solution, excess = _tried(tracker, done, k, progress, functools.partial(tracker.mirror, k))
        if solution:
            other = branches.split(done, k)
            _replace(other, k, _rounded(tracker.problem, solution.states[0]), solution)
        done.mirror_at = _again_at(k, excess, share, 1)
        done.seconds[k] += time.perf_counter() - began


def _unfold(tracker, done, k, progress):
    """Keep what frame ``k`` becomes with its rim continued from the inside, where that costs less;
    the more it costs, the later it is tried again.
    """
    if not tracker.rim or k < done.rim_at or k in done.lost:
        return
    began, share = time.perf_counter(), tracker.objective.rules.mirror_share
    unfold = functools.partial(tracker.unfold, k, done.memories[k])
    solution, excess = _tried(tracker, done, k, progress, unfold)
    if solution:
        _replace(done, k, _rounded(tracker.problem, solution.states[0]), solution)
    done.rim_at = _again_at(k, excess, share, _RIM_EVERY)
    done.seconds[k] += time.perf_counter() - began


def _tried(tracker, done, k, progress, solve):
    """(solution, excess) of another surface that ``solve`` tries for frame ``k`` from what the
    track has there; None and infinity where that breaks off.
    """
    past = _past(tracker, done, range(max(0, k - _MAX_HISTORY), k))
    state = tracker.problem.atlas.state(done.states[k])
    report = progress and functools.partial(progress, k, k)
    try:
        return solve(state, done.certainty[k], past, report)
    except (BadFrame, LinAlgError):
        return None, math.inf


def _again_at(k, excess, share, least):
    """The frame at which to try again what cost more by a share, the ``excess``, in frame ``k``:
    ``least`` frames later, more where it is above ``share``.
    """
    wait = excess / share if share > 0 else math.inf
    return k + math.ceil(min(least * max(wait, 1), _LATEST))


def _vertices(problem, arrays):
    """Vertices (N, 3) [m, world] of a state in arrays."""
    return problem.surface(Unknowns.from_numpy(arrays))


def _observe(tracker, done, k):
    """Tell the tracker of frame ``k``, where it was solved."""
    if k not in done.lost:
        tracker.observe(k, tracker.problem.atlas.state(done.states[k]))


def _rounded(problem, state):
    """A state as arrays of float32, as the device has it."""
    return Unknowns.from_numpy(problem.atlas.arrays(state)).to_numpy()


def _past(tracker, done, frames, first=0):
    """What the tracker wants to know of ``frames``; ``first``: the frame that the first memory is
    of.
    """
    atlas = tracker.problem.atlas
    return [
        (atlas.state(done.states[k]), done.memories[k - first] if k >= first else None)
        for k in frames
    ]


def _swept(frames, sweeps):
    """(frame, neighbour that it starts from) of so many sweeps, each backward and then forward over
    all frames but the first, which the texture was taken from.
    """
    backward = [(k, k + 1) for k in range(frames - 2, 0, -1)]
    return (backward + [(k, k - 1) for k in range(1, frames)]) * sweeps


def _retry(tracker, done, k, neighbour, progress):
    """Solve frame ``k`` again from its neighbour's surface, and keep what costs less."""
    if k in done.unusable:
        return
    began, atlas = time.perf_counter(), tracker.problem.atlas
    past = _past(tracker, done, range(max(0, k - _MAX_HISTORY), k))
    report = progress and functools.partial(progress, len(done.totals) + done.swept, k)
    start, state = (atlas.state(done.states[j]) for j in (neighbour, k))
    try:
        solution = tracker.retry(k, start, state, done.memories[k], past, report)
    except BadFrame:
        return
    if solution:
        arrays = _rounded(tracker.problem, solution.states[0])
        vertices = _vertices(tracker.problem, arrays)
        if tracker.problem.visible_share(vertices) >= _MIN_VISIBLE_SHARE:
            _replace(done, k, arrays, solution)
    done.seconds[k] += time.perf_counter() - began


def _replace(done, k, arrays, solution):
    """Let frame ``k``, solved again, have this solution."""
    done.states[k], done.totals[k] = arrays, _numbers(solution.terms)
    done.memories[k] = solution.memory
    if solution.certainty:
        done.certainty[k] = solution.certainty[0]
    done.lost.pop(k, None)


def _smooth(tracker, done):
    """Solve every frame again, from the last to the first and back, held to the middle of its
    neighbours by the setting ``smooth``.
    """
    count, weight = len(done.totals), tracker.settings.smooth
    atlas = tracker.problem.atlas
    for k in (*range(count - 2, 0, -1), *range(1, count - 1)):
        if k in done.unusable:
            continue
        began = time.perf_counter()
        before, after = (atlas.state(done.states[j]) for j in (k - 1, k + 1))
        try:
            solution = tracker.revisit(k, before, after, done.memories[k], weight)
        except BadFrame:
            continue
        _replace(done, k, _rounded(tracker.problem, solution.states[0]), solution)
        done.seconds[k] += time.perf_counter() - began


def _numbers(values):
    """JSON has no NaN: None instead."""
    return {name: x if np.isfinite(x).all() else None for name, x in values.items()}


def _advance(tracker, done, start, width, log, progress):
    """Solve the window of frames start .. start + width - 1."""
    problem, members = tracker.problem, list(range(start, start + width))
    while len(done.states) < start + width:
        done.states.append(
            dict(done.states[-1]) if done.states else problem.patch.rest().to_numpy()
        )
    for k in problem.sequence.unmasked.intersection(members):
        done.unusable[k] = "its mask is empty, or nearly"
    began, newest, latest = time.perf_counter(), members[-1], 0

    def record(iteration, total, terms, **more):
        if log is None:
            return
        frame = {"frame": problem.sequence.indices[newest], "iteration": iteration}
        numbers = _numbers({"loss": total, **terms})
        log.write(json.dumps({**frame, **numbers, **more}) + "\n")

    def report(iteration, total, terms):
        nonlocal latest
        latest = iteration + 1
        record(iteration, total, terms)
        if progress:
            progress(start, newest, iteration, total, terms)

    names = [term.name for term in tracker.objective.terms]
    solved, terms, memory, failed = {}, dict.fromkeys(names, math.nan), None, {}
    while usable := [k for k in members if k not in done.unusable]:
        window = [problem.atlas.state(done.states[k]) for k in usable]
        earlier = range(max(0, newest - _MAX_HISTORY), newest) if start else []
        past = _past(tracker, done, earlier, width - 1)
        try:
            solution = tracker.solve(window, usable, past, report)
        except BadFrame as error:
            if latest:  # finite at the start: the solver ran away, the image is not to blame
                failed[newest] = f"{error} at iteration {latest}"
                break
            done.unusable[error.frame] = f"{error} from the start"
            continue
        terms, memory, latest = solution.terms, solution.memory, solution.evaluations
        certainty = solution.certainty or [None] * len(usable)
        solved = dict(zip(usable, zip(solution.states, certainty)))
        break
    record(latest, sum(terms.values()), terms, best=True)

    for k, (state, certainty) in solved.items():
        arrays = _rounded(problem, state)
        if not all(np.isfinite(x).all() for x in arrays.values()):
            failed[k] = "its state is not finite"
        elif problem.visible_share(_vertices(problem, arrays)) < _MIN_VISIBLE_SHARE:
            failed[k] = "the surface left the image"
        else:
            done.states[k] = arrays
            if certainty is not None:
                done.certainty[k] = certainty
    for k in members:
        if k > 0 and (k in failed or k in done.unusable):
            done.states[k] = dict(done.states[k - 1])
    still = {k: reason for k, reason in done.lost.items() if k not in members}
    done.lost = still | failed | done.unusable
    done.next_window = start + 1
    done.iterations.append(latest)
    done.seconds.append(time.perf_counter() - began)
    done.totals.append(_numbers(terms))
    done.memories.append(memory)


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
