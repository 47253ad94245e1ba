"""A sleeve that is tracked on an arm whose known motion is off."""

import dataclasses
import os

import numpy as np
import pytest
import synthetic
from problems import problem_of
from worn import arm

from polysft_mi.objective import FrameContext, FrameMemory, Objective, Problem
from polysft_mi.solvers import create
from polysft_mi.surface import Unknowns
from polysft_mi.tracker import FrameTracker, Track, track

FRAMES, BEND, HEIGHT = 4, 4.0, 0.18


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """A sleeve that bends by 40 degrees in four frames."""
    folder = tmp_path_factory.mktemp("data") / "bent"
    return synthetic.cloth(
        folder, frames=FRAMES, size=(160, 120), rows=9, columns=18, shape=synthetic.tube, bend=BEND
    )


def worn(truth):
    """Its problem, on an arm whose elbow is 6 degrees off, and whose place 4 mm."""
    problem = problem_of(truth.folder, order=4)
    known = -BEND * HEIGHT * np.arange(FRAMES) / (FRAMES - 1) + 0.1
    places = np.tile((0.004, -0.004, 0.0), (FRAMES, 1))
    vertices, faces = problem.template.vertices, problem.template.faces
    carrier = problem.sequence.carrier = arm(vertices, known, places, faces=faces)
    carried = np.stack([carrier.maps(carrier.at(k))(vertices) for k in range(FRAMES)])
    a, b = problem.template.edges.T
    carrier.lengths = np.linalg.norm(carried[:, a] - carried[:, b], axis=2)  # as of a drape
    carrier.length_errors = np.full(FRAMES, 0.01)
    problem = Problem(problem.experiment, problem.sequence, problem.rules)
    problem.settings = dataclasses.replace(problem.settings, body="known")
    return problem


def surfaces_of(problem, done):
    return np.stack([problem.surface(Unknowns.from_numpy(s)) for s in done.states])


@pytest.fixture(scope="module")
def tracked(bent, tmp_path_factory):
    """(problem, Track)."""
    problem = worn(bent)
    return problem, track(FrameTracker(problem), FRAMES, str(tmp_path_factory.mktemp("worn")))


def test_the_image_corrects_where_the_body_is(bent, tracked):
    problem, done = tracked
    atlas, carrier = problem.atlas, problem.atlas.carrier
    error = np.linalg.norm(surfaces_of(problem, done) - bent.vertices, axis=2).mean(1)
    carried = [atlas.surface(atlas.posed(atlas.start, k)).vertices for k in range(FRAMES)]
    known = np.linalg.norm(carried - bent.vertices, axis=2).mean(1)
    assert not done.lost and (error[2:] < 0.7 * known[2:]).all()
    assert error.mean() < 0.75 * known.mean()
    for k, state in enumerate(done.states):
        assert carrier.pose(state["pose"]).frame == k


def test_a_pose_alone_goes_on_to_its_minimum(bent):
    """However little a step gains of a cost that the pose cannot lower: of what the pose leaves,
    the cloth would make folds.
    """
    problem = worn(bent)
    problem.rules = dataclasses.replace(problem.rules, gain=1.0)
    objective = Objective(problem)
    stage = dataclasses.replace(objective.usual[0], bodily=True)
    start = objective.atlas.posed(objective.atlas.start, 1)
    frozen = objective.frozen([FrameContext(1, start, FrameMemory(0.05))], stage, [start])
    found = create(objective).minimise(frozen, [start], iterations=60)
    again = create(objective).minimise(frozen, found.states, iterations=60)
    assert found.total < 0.95 * frozen.quadratic([start])[0].total
    assert again.total > 0.999 * found.total


def test_depth_is_no_surer_than_lengths(tracked):
    problem, done = tracked
    distance = np.linalg.norm(surfaces_of(problem, done) - problem.camera.origin, axis=2)
    sigma = np.stack([done.certainty[k][0] for k in range(FRAMES)])
    assert (sigma >= 0.00999 * distance).all() and (sigma < 0.05 * distance).any()


def test_a_run_that_was_interrupted_ends_alike(bent, tracked, tmp_path):
    problem, done = tracked
    again, calls = FrameTracker(worn(bent)), []

    def stop(frame, vertices):
        calls.append(frame)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(again, FRAMES, str(tmp_path), solved=stop)
    assert os.path.exists(tmp_path / "checkpoint.npz")
    kept = Track.load(str(tmp_path / "checkpoint.npz"))
    assert len(kept.states) == 2 and kept.states[1]["pose"][0] == 1
    resumed = track(FrameTracker(worn(bent)), FRAMES, str(tmp_path), resume=True)
    a, b = (surfaces_of(problem, x) for x in (done, resumed))
    assert np.abs(a - b).max() < 1e-6
