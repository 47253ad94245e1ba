"""The chart of each patch: its frame, turned along the bone that moves it, and the jet of the cloth
in it. Patches of different garments at the same place of the body get alike charts.
"""

import numpy as np
import torch

from polyfit import jets
from polyfit.jets import CanonicalFrame

# weight of the ridge that holds jets to the chart's plane, see steady_jets
_JET_RIDGE = 1e-3


def along_bones(surface, weights, body):
    """Frames turned about z until v lies along the bone of the joint that ``weights`` (K, J) give
    most, and the jets there: (frame, alpha, uv (E, 2) NumPy).
    """
    p = surface.patches
    bones = _bones(body)[torch.as_tensor(weights).argmax(1)]
    along = (surface.frame.R.mT @ bones[..., None])[..., 0]
    angle = torch.atan2(-along[:, 0], along[:, 1])
    cos, sin, zero, one = angle.cos(), angle.sin(), 0 * angle, 1 + 0 * angle
    turn = torch.stack(
        [torch.stack(row, -1) for row in [(cos, -sin, zero), (sin, cos, zero), (zero, zero, one)]],
        -2,
    )
    frame = CanonicalFrame(surface.frame.s, surface.frame.R @ turn, surface.frame.T)
    patch = torch.as_tensor(p.entry_patch)
    points = torch.as_tensor(p.vertices[p.entry_vertex]) - frame.T[patch]
    x = (frame.R[patch].mT @ points[..., None])[..., 0] / frame.s[patch, None]
    alpha = steady_jets(
        x,
        patch,
        torch.as_tensor(p.entry_weight),
        len(weights),
        jets.order_of(surface.alpha.shape[1]),
    )
    return frame, alpha, jets.nearest(alpha[patch], x[:, None])[:, 0].numpy()


def steady_jets(x, patch, weight, count, order):
    """Jets (K, A) of the points ``x`` (E, 3) of the charts ``patch`` (E,): least squares, held by
    _JET_RIDGE times the mean square of the jet over the chart's unit disc.

    A strip of cloth (a hem turned in, a waistband) does not determine a jet across it: coefficients
    a hundred times those of other patches fit it a little better, and a network that reads them
    answers with nonsense.
    """
    b = jets.basis(x[:, :2], order)
    share = (weight / torch.zeros(count, dtype=x.dtype).index_add(0, patch, weight)[patch])[:, None]
    A = b.shape[1]
    gram = (
        x.new_zeros(count, A * A)
        .index_add(0, patch, ((share * b)[:, :, None] * b[:, None]).flatten(1))
        .unflatten(1, (A, A))
    )
    right = x.new_zeros(count, A).index_add(0, patch, share * b * x[:, 2:])
    ring = torch.linspace(0, 2 * np.pi, 33, dtype=x.dtype)[1:]
    radius = torch.linspace(0, 1, 33, dtype=x.dtype)[1:].sqrt()  # rings of equal area
    disc = jets.basis(
        torch.stack([torch.outer(radius, ring.cos()), torch.outer(radius, ring.sin())], -1).flatten(
            0, 1
        ),
        order,
    )
    return torch.linalg.solve(gram + _JET_RIDGE * disc.T @ disc / len(disc), right)


def _bones(body):
    """Directions (J, 3) of the bones that begin in each joint: to the mean of its children, for a
    last joint from its parent.
    """
    joints, parents = body.joints.double(), torch.as_tensor(body.parents)
    child = torch.arange(len(joints))[parents >= 0]
    count = torch.bincount(parents[child], minlength=len(joints))[:, None]
    ahead = torch.zeros_like(joints).index_add(0, parents[child], joints[child]) / count.clamp(
        min=1
    )
    behind = joints[parents.clamp(min=0)]
    return torch.nn.functional.normalize(
        torch.where(count > 0, ahead - joints, joints - behind), dim=-1
    )
