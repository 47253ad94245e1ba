"""Bodies in poses, and in SMPL's form, for tests."""

import numpy as np
import torch

from onefit.body import skeleton, skinning
from onefit.body.smpl import FROM_SMPL


def random_poses(count, seed=0, size=0.5):
    return torch.randn(count, 24, 3, generator=torch.Generator().manual_seed(seed)) * size


def smpl_contents(standard):
    """A model file's contents in SMPL's keys and axes, made of the standard body in the T-pose;
    beta 0 scales it, beta 1 widens it.
    """
    A = skinning.transforms(standard, torch.zeros(1, 24, 3), torch.zeros(1, 3))
    turn = FROM_SMPL.double().numpy()
    V = skinning.skin(standard.vertices, standard.blend_weights, A)[0].double().numpy() @ turn
    J = skinning.posed_joints(standard, A)[0].double().numpy() @ turn
    regressor = np.linalg.lstsq(
        np.concatenate([V, np.ones((len(V), 1))], 1).T,
        np.concatenate([J, np.ones((24, 1))], 1).T,
        rcond=None,
    )[0].T
    parents = np.array(skeleton.PARENTS, dtype=np.int64)
    parents[0] = 2**32 - 1
    shapedirs = np.stack([0.05 * V, 0.05 * V * [1, 0, 0]], -1)
    return {
        "v_template": V, "f": standard.faces.numpy().astype(np.uint32),
        "weights": standard.blend_weights.double().numpy(), "J_regressor": regressor,
        "kintree_table": np.stack([parents.astype(np.uint32), np.arange(24, dtype=np.uint32)]),
        "shapedirs": shapedirs,
    }  # fmt: skip
