"""Several frames together, and looking both ways."""

import copy
import dataclasses

import numpy as np
import pytest
from problems import problem_of

from polysft_mi.errors import InputError
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import CHECKPOINT, FrameTracker, Track, track


@pytest.mark.parametrize("k_tc", [0.05, 1000.0])
def test_a_window_follows_the_sheet_and_couples_its_frames(truth, tracked, tmp_path, k_tc):
    """More coupling means less motion between frames; the default follows the truth as single
    frames do.
    """
    problem = problem_of(truth.folder, window=3, k_tc=k_tc)
    done = track(FrameTracker(problem), 4, str(tmp_path))
    assert len(done.states) == 4 and len(done.totals) == 2 and set(done.certainty) == {0, 1, 2, 3}
    error = [
        np.linalg.norm(problem.surface(Unknowns.from_numpy(s)) - t, axis=1).mean()
        for s, t in zip(done.states, truth.vertices)
    ]
    if k_tc < 1:
        assert max(error) < 0.003
        return
    moved = [
        sum(((b["delta_u"] - a["delta_u"]) ** 2).sum() for a, b in zip(x.states, x.states[1:]))
        for x in (done, tracked)
    ]
    assert moved[0] < 0.5 * moved[1]


@pytest.mark.parametrize("solver", ["gauss-newton", pytest.param("adam", marks=pytest.mark.slow)])
def test_windows_that_begin_at_the_frame_before_follow_the_sheet(truth, tmp_path, solver):
    """The paper's way through a video, by either solver: all frames together, no other starts."""
    adam = {"preset": "paper", "canonical_frame": "pca", "period": 150}
    newton = {"starts": "previous", "window": 2, "blur": 1.0}
    problem = problem_of(truth.folder, **(adam if solver == "adam" else newton))
    done = track(FrameTracker(problem), 4, str(tmp_path))
    assert done.solver == solver and not done.lost
    still = np.linalg.norm(truth.vertices - truth.vertices[0], axis=2).mean(1)
    assert (errors(problem, truth, done)[1:] < 0.6 * still[1:]).all()


def test_looking_back_smooths_and_keeps_what_frames_know(truth, tracked, tmp_path):
    """``smooth`` holds every inner frame to the middle of its neighbours, and loses none of the
    facts that later frames go by.
    """
    rough = lambda surfaces: np.abs(np.diff(surfaces, n=2, axis=0)).mean()
    problem = problem_of(truth.folder, smooth=10.0)
    back = track(FrameTracker(problem), 4, str(tmp_path))
    assert back.finished and not tracked.finished
    assert len(back.totals) == len(back.certainty) == 4
    assert all(m.least_misfit > 0 and m.light.is_known for m in back.memories[1:])
    least, usual, smooth = (
        rough(truth.vertices),
        *(
            rough(np.stack([problem.surface(Unknowns.from_numpy(s)) for s in x.states]))
            for x in (tracked, back)
        ),
    )
    assert least < smooth and smooth - least < 0.95 * (usual - least)  # 0.91 on a GPU


def mislaid(problem, tracked, frame):
    """A copy of a track whose ``frame`` bulges the wrong way: its surface, mirrored in depth about
    its mean, and so nearly the same in the image.
    """
    atlas, done = Atlas(problem.template), copy.deepcopy(tracked)
    state = atlas.state(done.states[frame])
    wanted = atlas.surface(state).vertices.copy()
    wanted[:, 2] = 2 * wanted[:, 2].mean() - wanted[:, 2]
    for _ in range(10):
        surface = atlas.surface(state)
        missing = (wanted - surface.vertices)[..., None]
        offset = state.offset + np.linalg.solve(surface.offset_jacobian, missing)[..., 0]
        state = dataclasses.replace(state, offset=offset)
    done.states[frame] = atlas.arrays(state)
    return done


def errors(problem, truth, done):
    """Mean distances (T,) [m] to the true surfaces."""
    found = [problem.surface(Unknowns.from_numpy(s)) for s in done.states]
    return np.array([np.linalg.norm(a - b, axis=1).mean() for a, b in zip(found, truth.vertices)])


def test_a_sweep_finds_a_lost_frame(truth, tracked, tmp_path):
    """It keeps the state of the frame before, and has no facts."""
    problem, done = problem_of(truth.folder, sweeps=1), copy.deepcopy(tracked)
    done.states[2], done.memories[2], done.lost = done.states[1], None, {2: "away"}
    lost = errors(problem, truth, done)[2]
    done.save(tmp_path / CHECKPOINT, FrameTracker(problem).objective.stages)
    found = track(FrameTracker(problem), 4, str(tmp_path), resume=True)
    assert not found.lost and found.memories[2].least_misfit > 0
    assert errors(problem, truth, found)[2] < 0.5 * lost


def test_a_sweep_cures_a_frame_on_a_wrong_branch_and_can_be_interrupted(truth, tracked, tmp_path):
    """Backward comes first, and lays right what the later neighbour has right; the other frames
    stay as good as they were. An interrupted sweep goes on where it was, with the same result.
    """
    problem = problem_of(truth.folder, sweeps=1)
    wrong = mislaid(problem, tracked, 2)
    usual, bad = errors(problem, truth, tracked), errors(problem, truth, wrong)
    assert bad[2] > 3 * usual[2]

    def sweep(folder, stop_before=None):
        said = []

        def progress(done, frame, *_):
            if (done, frame) == stop_before:
                raise KeyboardInterrupt
            said.append((done, frame))

        done = track(FrameTracker(problem), 4, str(folder), resume=True, progress=progress)
        return done, sorted(set(said))

    stages = FrameTracker(problem).objective.stages
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
        wrong.save(tmp_path / name / CHECKPOINT, stages)
    whole, gone_over = sweep(tmp_path / "whole")
    assert gone_over == [(4, 2), (5, 1), (6, 1), (7, 2), (8, 3)]
    assert (errors(problem, truth, whole) < 1.5 * usual.max()).all()
    with pytest.raises(KeyboardInterrupt):
        sweep(tmp_path / "parts", stop_before=(7, 2))
    half = Track.load(tmp_path / "parts" / CHECKPOINT)
    assert half.swept == 3 and errors(problem, truth, half)[2] < 1.5 * usual.max()
    parts, gone_over = sweep(tmp_path / "parts")
    assert gone_over == [(7, 2), (8, 3)] and whole.swept == parts.swept == 5
    for a, b in zip(whole.states, parts.states, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a)


def test_more_frames_than_the_video_has_are_named(truth, tmp_path):
    problem = problem_of(truth.folder)
    count = len(problem.sequence)
    for frames in 0, count + 1:
        with pytest.raises(InputError, match=f"frames = {frames}; 1 to {count}"):
            track(FrameTracker(problem), frames, tmp_path)
