"""A moving mesh as bones, and what they carry."""

import numpy as np
import pytest
import synthetic
from scipy.spatial.transform import Rotation
from worn import arm, some_pose

from polysft_mi.body import Bones

ROWS, COLUMNS, T = 15, 20, 3


@pytest.fixture(scope="module")
def mesh():
    """(at rest (V, 3) [m], faces): a sleeve."""
    return synthetic.tube(0.0, ROWS, COLUMNS), synthetic.tube_faces(ROWS, COLUMNS)[0]


@pytest.fixture(scope="module")
def frames(mesh):
    """The sleeve on an arm that bends up to 50 degrees, and walks."""
    places = np.outer(np.arange(T), (0.1, 0.0, 0.05))
    by = arm(mesh[0], np.radians(25) * np.arange(T), places)
    return np.stack([by.maps(by.at(k))(mesh[0]) for k in range(T)])


def carried(bones, points, weights):
    by = bones.carrier(weights)
    return np.stack([by.maps(by.at(k))(points) for k in range(len(bones.poses))])


def test_a_rigid_motion_is_exact(mesh):
    rest, faces = mesh
    turns = Rotation.from_rotvec([[0, 0, 0], [0.3, -1.2, 2.0], [3.0, 0.1, 0.2]])
    shifts = np.array([[0, 0, 0], [1, -2, 0.5], [0.2, 0.1, 3]])
    frames = np.stack([turn.apply(rest) + shift for turn, shift in zip(turns, shifts)])
    bones = Bones.of(rest, faces, frames, count=12)
    assert np.abs(bones.weights.sum(1) - 1).max() < 1e-12 and bones.weights.min() >= 0
    assert np.abs(carried(bones, rest, bones.weights) - frames).max() < 1e-9
    root = Rotation.from_rotvec(bones.poses[:, 0])
    assert (root * turns.inv()).magnitude().max() < 1e-9
    assert np.abs(bones.poses[:, 1:]).max() < 1e-6  # the root moves all of it


def test_a_bend_is_followed_the_better_the_more_bones(mesh, frames):
    rest, faces = mesh
    error = []
    for count in (6, 24):
        bones = Bones.of(rest, faces, frames, count=count)
        off = np.linalg.norm(carried(bones, rest, bones.weights) - frames, axis=2)
        error.append(np.sqrt((off**2).mean()))
    size, moved = np.ptp(rest[:, 0]), np.sqrt(((frames[-1] - rest) ** 2).sum(1).mean())
    assert error[1] < 0.5 * error[0] and error[1] < 0.02 * size < 0.1 * moved


def test_parts_that_hang_on_nothing_move_with_what_is_near(mesh, frames):
    """A button: three vertices that no edge joins to the rest, too small for a bone of its own."""
    rest, faces = mesh
    button = rest[:1] + 1e-3 * np.eye(3)
    whole = np.concatenate([rest, button])
    faces = np.concatenate([faces, [len(rest) + np.arange(3)]])
    moving = np.concatenate([frames, frames[:, :1] + 1e-3 * np.eye(3)], 1)
    bones = Bones.of(whole, faces, moving, count=4)
    assert np.isfinite(bones.weights).all() and np.abs(bones.weights.sum(1) - 1).max() < 1e-12


def test_derivatives_by_the_place_of_the_whole(mesh, frames):
    rest, faces = mesh
    bones, rng = Bones.of(rest, faces, frames, count=12), np.random.default_rng(1)
    root = np.arange(len(bones.joints)) == 0
    carrier = bones.carrier(bones.weights, corrected=root)
    assert len(carrier) == 6
    pose, h = some_pose(carrier, rng), 1e-6
    columns = carrier.columns(pose, rest)
    for k in range(6):
        ends = [carrier.maps(pose.after_step(s * h * np.eye(6)[k]))(rest) for s in (1, -1)]
        assert np.abs(columns[..., k] - (ends[0] - ends[1]) / (2 * h)).max() < 1e-7


def test_a_correction_moves_all_as_a_rigid_body(mesh, frames):
    """The skin, too, which is known exactly: in each frame it has a form of its own at rest."""
    rest, faces = mesh
    bones, step = Bones.of(rest, faces, frames, count=12), np.array([0.1, 0, -0.2, 0.3, 0, 0.1])
    carrier = bones.carrier(bones.weights, corrected=np.arange(len(bones.joints)) == 0, fps=25.0)
    back = [carrier.maps(carrier.at(k)).back(x) for k, x in enumerate(frames)]
    carrier.skin = np.stack(back), bones.weights, faces
    known, pose = carrier.at(2), carrier.at(2, step)
    assert np.abs(carrier.body(known) - frames[2]).max() < 1e-9
    turn, root = Rotation.from_rotvec(step[:3]), frames[2].mean(0)
    assert (
        np.abs(carrier.body(pose) - (turn.apply(frames[2] - root) + root + step[3:])).max() < 1e-9
    )
    told = carrier.motion([carrier.at(0), pose])
    assert told["vertices"].shape == (2, *rest.shape) and told["fps"] == 25
    assert np.abs(told["vertices"][1] - carrier.body(pose)).max() < 1e-6


def test_the_rest_leads_to_the_first_frame(mesh, frames):
    rest, faces = mesh
    bones = Bones.of(rest, faces, frames[1:], count=24)
    led = bones.led_in(5)
    way = carried(led, rest, led.weights)
    assert len(way) == 5 + len(bones.poses)
    assert np.abs(way[5:] - carried(bones, rest, bones.weights)).max() < 1e-12
    lengths = lambda x: np.linalg.norm(x[faces[:, 0]] - x[faces[:, 1]], axis=1)
    assert np.abs(lengths(way[0]) - lengths(rest)).max() < 1e-9  # moved, but not bent yet
    away = np.linalg.norm(way[:6] - way[5], axis=2).max(1)
    assert (np.diff(away) <= 0).all() and away[0] > 0.01
