"""Motions for tests."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from onefit.body import skeleton, skinning
from onefit.motion import Motion, generate

T_POSE = skeleton.standard_joints()


FROM_SMPL = Rotation.from_euler("x", 90, degrees=True)


KINDS = generate.TRAINING + generate.HELD_OUT


def places(motion, joints=T_POSE):
    """Joints (T, 24, 3) of the standard skeleton in a motion."""
    return skinning.joint_places(
        joints.double(), motion.poses.double(), motion.translation.double()
    ).numpy()


def some_motion(frames=20, size=0.4, seed=0):
    """A motion of random rotations, slow enough to be someone's, the body upright."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(frames, 24, 3)) * size
    poses[:, 0] *= 0.3
    return Motion(
        torch.tensor(poses).float(),
        torch.tensor(np.cumsum(rng.normal(size=(frames, 3)) * 0.02, 0)).float(),
        30.0,
        "some",
    )
