"""The rim of a sheet, continued from the inside, as another start of a frame."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic
import trimesh
from problems import problem_of, small_tube
from scipy.spatial.transform import Rotation

from polyfit.mesh import edges_of
from polysft_mi.scene.rules import Rules
from polysft_mi.surface import hinges
from polysft_mi.tracker import FrameTracker, track
from polysft_mi.tracker.rims import Rim

ROWS, COLUMNS = 13, 21
WIDTH = 0.15


def flap(t, rows, columns, most=0.8, depth=0.4):
    """Points (rows * columns, 3) [m] of a sheet whose left end is turned towards the camera, by t
    times ``most`` [rad]; from it where that is negative. The angle grows over the flap's half.
    """
    flat = synthetic.sheet(0.0, rows, columns, depth=depth)
    x = flat[:columns, 0]
    into = np.clip((x[0] + WIDTH * (x[-1] - x[0]) - x) / (0.5 * WIDTH * (x[-1] - x[0])), 0, 1)
    angle = most * t * into
    middle = 0.5 * (angle[1:] + angle[:-1])
    steps = np.diff(x)[:, None] * np.stack([np.cos(middle), np.sin(middle)], 1)
    line = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    line += [x[-1] - line[-1, 0], -line[-1, 1]]
    points = flat.reshape(rows, columns, 3).copy()
    points[..., 0], points[..., 2] = line[:, 0], points[..., 2] + line[:, 1]
    return points.reshape(-1, 3)


def template_of(points, faces):
    edges, _ = edges_of(faces)
    return SimpleNamespace(vertices=points, faces=faces, edges=edges)


def rim_of(points, faces, share=0.15):
    return Rim(template_of(points, faces), hinges(points, faces)[1], share)


@pytest.fixture
def flat():
    return synthetic.sheet(0.0, ROWS, COLUMNS), synthetic.grid_faces(ROWS, COLUMNS)


def test_a_rim_is_what_is_near_the_border(flat):
    points, faces = flat
    rim, size = rim_of(*flat), np.sqrt(0.24 * 0.18)
    inner = (np.abs(points[:, :2]) < [[0.12, 0.09]] - 0.15 * size - np.array([1e-9, 1e-9])).all(1)
    assert rim and np.array_equal(rim.vertices, ~inner)
    assert not rim_of(points, faces, share=0.0) and not rim_of(points, faces, share=1.0)
    for rows, columns in ((2, 9), (3, 3), (3, 9)):  # what is inside lies in a line, at most
        assert not rim_of(
            synthetic.sheet(0.0, rows, columns), synthetic.grid_faces(rows, columns), share=0.01
        )
    ball = trimesh.creation.icosphere(2)
    assert not rim_of(np.asarray(ball.vertices), np.asarray(ball.faces))


def test_a_plane_goes_on_as_a_plane(flat):
    points, _ = flat
    rim = rim_of(*flat)
    turned = Rotation.from_rotvec([0.3, -0.5, 0.2]).apply(points) + (0.1, 0.2, 0.9)
    spoilt = turned.copy()
    spoilt[rim.vertices] += np.random.default_rng(0).normal(size=(rim.vertices.sum(), 3))
    assert np.abs(rim.continued(spoilt) - turned).max() < 1e-5


def test_a_roll_goes_on_bending_ever_less(flat):
    rim = rim_of(*flat)
    rolled = synthetic.sheet(1.0, ROWS, COLUMNS, turn=0.0, shift=0.0)
    found = rim.continued(rolled)
    assert np.array_equal(found[~rim.vertices], rolled[~rim.vertices])
    bends = hinges(*flat)[1]
    assert ((bends @ found) ** 2).sum() < ((bends @ rolled) ** 2).sum()
    assert 0 < np.abs(found - rolled).max() < 0.02


def test_a_tube_goes_on_as_a_tube():
    points, (faces, _) = synthetic.tube(0.0, 12, 18), synthetic.tube_faces(12, 18)
    rim = rim_of(points, faces, share=0.2)
    assert 0 < rim.vertices.sum() < len(points)
    moved = Rotation.from_rotvec([0.1, 0.4, -1.2]).apply(points) + (0.3, 0.0, 0.1)
    spoilt = moved + 0.02 * rim.vertices[:, None]
    assert np.abs(rim.continued(spoilt) - moved).max() < 1e-6


def test_parts_are_connected_and_in_the_rim(flat):
    points, _ = flat
    rim = rim_of(*flat)
    left, right = points[:, 0] < -0.1, points[:, 0] > 0.1
    parts = rim.parts(left | right)
    assert len(parts) == 2
    assert sorted(np.concatenate(parts)) == list(np.flatnonzero((left | right) & rim.vertices))
    assert rim.parts(np.zeros(len(points), dtype=bool)) == []


def test_what_a_rim_becomes_costs_less_or_is_not_taken(tmp_path):
    truth = synthetic.cloth(
        tmp_path / "cloth", frames=4, size=(160, 120), rows=ROWS, columns=COLUMNS, shape=flap
    )
    problem = problem_of(truth.folder)
    tracker, atlas = FrameTracker(problem), problem.atlas
    done = track(tracker, 4, tmp_path)
    states = [atlas.state(x) for x in done.states]
    true, other = (
        flap(t, ROWS, COLUMNS) @ problem.camera.axes + problem.camera.origin for t in (1.0, -1.0)
    )
    wrong = atlas.with_relief_in_jets(atlas.reaching(other, states[3], iterations=20))

    def left(state):
        """Metres of the way to the truth, at the end of the flap."""
        apart = np.linalg.norm(atlas.surface(state).vertices - true, axis=1)
        return apart[::COLUMNS].mean()

    memory, certainty = done.memories[3], done.certainty[3]
    past = list(zip(states, done.memories, strict=True))[:3]
    assert left(states[3]) < 0.1 * left(wrong)
    solution, excess = tracker.unfold(3, memory, wrong, certainty, past)
    assert excess < 0 and left(solution.states[0]) < 0.7 * left(wrong)
    solution, excess = tracker.unfold(3, memory, states[3], certainty, past)
    assert excess > -tracker.objective.rules.gain or left(solution.states[0]) < 0.1 * left(wrong)


def test_no_rim_is_tried_by_the_rule_nor_where_frames_hang_together(tmp_path):
    folder = synthetic.cloth(tmp_path / "cloth", frames=2).folder
    assert FrameTracker(problem_of(folder)).rim
    assert FrameTracker(problem_of(folder, dataclasses.replace(Rules(), rim=0.0))).rim is None
    assert FrameTracker(problem_of(folder, window=2)).rim is None
    assert FrameTracker(problem_of(small_tube(tmp_path, 2).folder)).rim
