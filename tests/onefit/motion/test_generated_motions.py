"""Motions that are generated."""

import functools

import numpy as np
import pytest
import torch
from motions import KINDS, T_POSE, places
from scipy.spatial.transform import Rotation
from scripts import load

from onefit.body import AnnyBody, skinning
from onefit.body.skeleton import INDEX
from onefit.motion import Motion, generate
from polyfit.errors import InputError

# --- generated motions ----------------------------------------------------------------------------


def test_kinds():
    assert len(generate.TRAINING) >= 12 and len(generate.HELD_OUT) >= 4
    assert not set(generate.TRAINING) & set(generate.HELD_OUT)
    with pytest.raises(InputError, match="no kind of motion 'fly'; there are idle"):
        Motion.generate("fly")
    with pytest.raises(InputError, match="at least one frame"):
        Motion.generate("walk", seconds=0)


@functools.cache
def eight_seconds(kind):
    """One motion of a kind, at 120 frames a second."""
    return Motion.generate(kind, seconds=8, seed=11, fps=120.0)


@pytest.mark.parametrize("kind", KINDS)
def test_generated_motions_are_smooth_and_within_joints_limits(kind):
    motion = eight_seconds(kind)
    J = places(motion)
    # accelerations are continuous: nearly the same at half the rate, where a jump would be halved,
    # a kink's peak too
    fine, coarse = (
        np.abs(np.diff(x, 2, axis=0)).max((0, 2)) * fps**2 for x, fps in ((J, 120), (J[::2], 60))
    )
    assert (fine < 1.6 * coarse + 1.5).all() and fine.max() < 400  # m/s²
    knees = motion.poses[:, [INDEX["left_knee"], INDEX["right_knee"]]].reshape(-1, 3)
    bend = Rotation.from_rotvec(knees.double().numpy()).as_rotvec()
    assert bend[:, 0].min() > -0.02 and bend[:, 0].max() < 2.45
    assert np.abs(bend[:, 1:]).max() < 1e-5
    elbow = motion.poses[:, [INDEX["left_elbow"], INDEX["right_elbow"]]].double()
    for side, x in ((0, 1.0), (1, -1.0)):  # a forearm never bends backwards
        assert Rotation.from_rotvec(elbow[:, side].numpy()).apply([x, 0, 0])[:, 1].max() < 0.01
    assert elbow.norm(dim=-1).max() < 2.6
    for joint, most in (
        ("spine1", 0.5),
        ("spine2", 0.65),
        ("spine3", 0.5),
        ("neck", 0.75),
        ("head", 0.75),
        ("left_ankle", 1.25),
        ("left_collar", 0.75),
    ):
        assert motion.poses[:, INDEX[joint]].norm(dim=-1).max() < most, joint


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_at_any_rate_and_length_and_another_by_another_seed(kind):
    long = eight_seconds(kind)
    short, other = (Motion.generate(kind, seconds=4, seed=seed) for seed in (11, 12))
    assert np.abs(places(long)[:400:4] - places(short)[:100]).max() < 0.02
    assert (short.poses - other.poses).abs().max() > 0.2


@pytest.mark.parametrize("kind", KINDS)
def test_feet_stand_still_on_the_ground(kind):
    feet = places(eight_seconds(kind)[::2])[:, [INDEX["left_foot"], INDEX["right_foot"]]]
    ground = T_POSE[INDEX["left_foot"], 2].item()
    assert feet[..., 2].min() > ground - 0.02
    down = (feet[1:, :, 2] < ground + 0.004) & (feet[:-1, :, 2] < ground + 0.004)
    speed = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) * 60
    assert down.any() and np.percentile(speed[down], 98) < 0.08  # m/s


def test_feet_stand_still_on_other_bodies_when_the_way_is_fitted():
    body = AnnyBody().body((0.3, 0.75, 0.5, 0.5, 0.5, 0.5))
    motion = Motion.generate("walk", seconds=6, seed=1, fps=60.0)

    def slides(motion):
        feet = skinning.posed_joints(
            body, skinning.transforms(body, motion.poses, motion.translation)
        )[:, [10, 11]].numpy()
        down = feet[1:, :, 2] < feet[..., 2].min() + 0.006
        return np.median(np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1)[down]) * 60

    assert slides(motion.fitted(body)) < 0.03 < 0.1 < slides(motion)  # m/s
    standard = AnnyBody().body()
    assert torch.allclose(motion.fitted(standard).translation, motion.translation, atol=1e-3)


def test_walking_and_running_get_somewhere():
    for kind, low, high in (("walk", 0.6, 1.7), ("run", 1.9, 3.7)):
        for seed in range(5):
            motion = Motion.generate(kind, seconds=5, seed=seed)
            path = np.linalg.norm(np.diff(motion.translation[:, :2].numpy(), axis=0), axis=1).sum()
            assert low < path / (len(motion) / motion.fps) < high
            ahead = motion.translation[30] - motion.translation[0]
            assert ahead[1] < -0.5 * ahead[:2].norm()  # where it faces
    running = places(Motion.generate("run", seconds=5, seed=0, fps=60.0))[:, [10, 11], 2]
    assert (running.min(1) > T_POSE[10, 2].item() + 0.02).mean() > 0.1  # both feet off the ground


def test_arms_do_not_pass_through_the_body():
    body = AnnyBody().body()
    script = load("benchmarks/onefit_motions.py")
    core = script.Core(body)
    assert len(core.rings) == 2  # cut at the shoulders
    through = torch.zeros(1, 24, 3)
    through[:, INDEX["left_shoulder"], 1] = np.pi / 2 + 0.6  # an arm let down into the hip
    assert core.depth(script.posed(body, Motion(through, torch.zeros(1, 3), 30.0))[0]) > 0.03
    for kind in KINDS:
        depths = [core.depth(V) for V in script.posed(body, eight_seconds(kind)[::140])]
        assert max(depths) < (0.03 if kind == "pick_up" else 0.015), kind
