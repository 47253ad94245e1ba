"""Maps from a body's rest to its frames, and their derivatives."""

import numpy as np
import pytest
import synthetic
from worn import arm, some_pose, turned

from polysft_mi.body import Carrier

T, BEND = 3, 0.8


@pytest.fixture
def rng():
    return np.random.default_rng(2)


@pytest.fixture
def sleeve():
    return synthetic.tube(0.0, 7, 10)


@pytest.fixture
def carrier(sleeve, rng):
    draped = 0.01 * rng.normal(size=(T, *sleeve.shape))
    return arm(sleeve, BEND * np.arange(T), 0.1 * rng.normal(size=(T, 3)), draped)


def test_what_hangs_on_one_bone_moves_with_it(sleeve):
    carrier = arm(sleeve, np.array([0.0, BEND]), np.array([[0, 0, 0], [0.1, 0, 0]]))
    assert np.abs(carrier.maps(carrier.at(0))(sleeve) - sleeve).max() < 1e-12
    moved, elbow = carrier.maps(carrier.at(1))(sleeve), carrier.joints[1]
    near, far = (carrier.weights[:, k] == 1 for k in (0, 1))
    assert near.any() and far.any()
    assert np.abs(moved - sleeve - (0.1, 0, 0))[near].max() < 1e-12
    there = (sleeve - elbow) @ turned(BEND).T + elbow + (0.1, 0, 0)
    assert np.abs(moved - there)[far].max() < 1e-12
    assert np.abs(carrier.body(carrier.at(1)) - moved).max() < 1e-12  # its skin is the sleeve


def test_derivatives_by_the_pose(carrier, sleeve, rng):
    pose = some_pose(carrier, rng)
    columns, h = carrier.columns(pose, sleeve), 1e-6
    for k in range(len(carrier)):
        step = h * np.eye(len(carrier))[k]
        ends = [carrier.maps(pose.after_step(s * step))(sleeve) for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h)
        assert np.abs(columns[..., k] - slope).max() < 1e-7 * max(1, np.abs(slope).max())
    assert np.abs(columns[..., : len(carrier) - 3]).max() > 0.05


def test_what_is_carried_comes_back(carrier, sleeve, rng):
    maps = carrier.maps(some_pose(carrier, rng))
    assert np.abs(maps.back(maps(sleeve)) - sleeve).max() < 1e-9


def test_a_drape_is_worn_before_it_is_carried(carrier, sleeve):
    pose = carrier.at(2)
    bare = arm(sleeve, BEND * np.arange(T), carrier.translation)
    expected = bare.maps(pose)(sleeve + carrier.draped[2])
    assert np.abs(carrier.maps(pose)(sleeve) - expected).max() < 1e-12


def test_corrections_and_numbers_come_back(carrier, rng):
    step = 0.05 * rng.normal(size=len(carrier))
    pose = carrier.at(1, step)
    assert np.abs(carrier.correction(pose) - step).max() < 1e-12
    again = carrier.pose(pose.to_numpy())
    assert again.frame == 1
    assert np.abs(carrier.correction(again) - step).max() < 1e-12


def test_joints_that_move_nothing_are_left_out(sleeve):
    carrier = arm(sleeve, np.zeros(1), np.zeros((1, 3)))
    weights = np.tile([1.0, 0.0], (len(sleeve), 1))
    parts = carrier.joints, carrier.parents, np.zeros((2, 3)), weights
    alone = Carrier(*parts, carrier.poses, carrier.translation)
    assert alone.free.tolist() == [0] and len(alone) == 6
    assert carrier.free.tolist() == [0, 1]


def test_the_maps_are_onefits():
    torch = pytest.importorskip("torch")
    pytest.importorskip("anny")
    from onefit import AnnyBody
    from onefit.body import skinning

    body, rng = AnnyBody().body(), np.random.default_rng(0)
    poses, places = 0.3 * rng.normal(size=(2, 24, 3)), 0.1 * rng.normal(size=(2, 3))
    some = rng.choice(len(body.vertices), 50)
    points, weights = body.vertices[some].double(), body.blend_weights[some].double()
    maps = skinning.transforms(body, torch.as_tensor(poses), torch.as_tensor(places))
    skinned = skinning.skin(points, weights, maps).numpy()
    numbers = (x.double().numpy() for x in (body.joints, body.rest_pose, weights))
    joints, rest_pose, weights = numbers
    carrier = Carrier(joints, body.parents, rest_pose, weights, poses, places)
    for k in range(2):
        assert np.abs(carrier.maps(carrier.at(k))(points.numpy()) - skinned[k]).max() < 1e-6
