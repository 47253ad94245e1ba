"""Meshes with faults, for tests."""

import torch


def turned(vector, by):
    from scipy.spatial.transform import Rotation

    return torch.as_tensor(
        (Rotation.from_rotvec(by) * Rotation.from_rotvec(vector.numpy())).as_rotvec()
    ).float()
