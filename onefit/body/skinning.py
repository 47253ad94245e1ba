"""Linear blend skinning from the rest space to a posed body, differentiable and on any device."""

import torch

from . import skeleton


def transforms(body, poses, translation):
    """The affine maps (T, 24, 3, 4) that take points of the body's rest space [m] to the world [m],
    one for each joint.

    ``poses`` (T, 24, 3) [rad] as in :mod:`onefit.body.skeleton`; ``translation`` (T, 3) [m] is
    added to the rest position of the root joint. Joint j turns by G_j(pose) G_j(rest_pose)^T, G_j
    the product of rotations from the root to j, about its own place, which follows from its
    parent's map. With ``poses`` equal to ``body.rest_pose`` and no translation, all maps are the
    identity. ``body`` may be one for each frame, with ``joints`` and ``rest_pose`` (T, 24, 3).
    """
    R = (
        skeleton.chained_rotations(poses)
        @ skeleton.chained_rotations(body.rest_pose.to(poses.dtype)).mT
    )
    joints = body.joints.to(poses.dtype)
    t = _chained_places(joints, R, translation) - (R @ joints[..., None])[..., 0]
    return torch.cat([R, t[..., None]], -1)


def joint_places(joints, poses, translation):
    """Positions (T, 24, 3) [m] of the joints whose places in the T-pose are ``joints`` (24, 3)
    [m].
    """
    return _chained_places(joints, skeleton.chained_rotations(poses), translation)


def _chained_places(joints, R, translation):
    """Places (T, 24, 3) of joints that are at ``joints``, (24, 3) or (T, 24, 3), before they turn
    by R (T, 24, 3, 3) in the world.
    """
    offsets = joints - joints[..., [max(p, 0) for p in skeleton.PARENTS], :]
    places = [joints[..., 0, :] + translation]
    for j in range(1, len(skeleton.PARENTS)):
        p = skeleton.PARENTS[j]
        places.append(places[p] + (R[..., p, :, :] @ offsets[..., j, :, None])[..., 0])
    return torch.stack(places, -2)


def skin(points, blend_weights, transforms):
    """Points (T, N, 3) [m] in the world, of points (N, 3) or (T, N, 3) [m] in the rest space.

    ``blend_weights`` (N, 24), rows that sum to one; ``transforms`` (T, 24, 3, 4) of
    :func:`transforms`. Points that differ from frame to frame need 48 bytes a point and frame on
    the way: pass long motions in pieces.
    """
    if points.ndim == 2:  # the same points in all frames: one product of matrices
        homogeneous = torch.nn.functional.pad(points, (0, 1), value=1.0)
        weighted = blend_weights[..., None] * homogeneous[:, None]
        maps = transforms.permute(1, 3, 0, 2).flatten(2).flatten(0, 1)
        return (weighted.flatten(1) @ maps).unflatten(1, (-1, 3)).transpose(0, 1)
    A = blended(blend_weights, transforms)
    return (A[..., :3] @ points[..., None])[..., 0] + A[..., 3]


def blended(blend_weights, transforms):
    """The affine maps (T, N, 3, 4) of single points: Σ_j w_j A_j, for weights (N, 24) and maps (T,
    24, 3, 4).
    """
    return (blend_weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))


def posed_joints(body, transforms):
    """Positions (T, 24, 3) [m] of the joints in the world."""
    return (transforms[..., :3] @ body.joints.to(transforms.dtype)[..., None])[..., 0] + transforms[
        ..., 3
    ]
