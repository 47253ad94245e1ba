"""How far fitted jets are from their patches: what training lowers and what the tables report.

Heights are in the chart's unit s, the patch's largest distance from its mean, which no rotation
changes. Height alone misleads: a frame that looks at the patch from its edge folds it onto itself,
and the two sheets then lie close together. The normals tell, because over a fold half of them point
against the jet's. So training lowers both, and every table gives both. The tables also give the
distance to the surface, which does not depend on the frame.
"""

from dataclasses import dataclass

import torch

from polyfit import jets


@dataclass(frozen=True)
class Discrepancy:
    """Of each patch, (B,).

    ``height``: RMS of z - z(u, v), in s. ``distance``: RMS of the same divided by the jet's slope
    there, sqrt(1 + z_u^2 + z_v^2): the distance to the tangent plane, and to first order to the
    surface, in s. ``cosine``: mean cosine between the jet's normal and the surface's own;
    ``angle``: mean angle between them in degrees; both with the side of the surface, inner or
    outer, chosen once for a whole patch.
    """

    height: torch.Tensor
    distance: torch.Tensor
    cosine: torch.Tensor
    angle: torch.Tensor


def discrepancy(alpha, x, normals, mask=None):
    """:class:`Discrepancy` between jets ``alpha`` (B, A) and the points x (B, P, 3) of their charts
    with unit ``normals`` (B, P, 3) in the same axes; differentiable.
    """
    count = x.shape[1] if mask is None else mask.sum(1)

    def mean(values):
        return (values if mask is None else torch.where(mask, values, 0)).sum(1) / count

    z, zu, zv = jets.derivatives(alpha, x[..., :2], (0, 0), (1, 0), (0, 1))
    residual = z - x[..., 2]
    slope = 1 + zu * zu + zv * zv
    cosine = (normals[..., 2] - zu * normals[..., 0] - zv * normals[..., 1]) * slope.rsqrt()
    side = mean(cosine).detach().sign()
    side = torch.where(side == 0, 1, side)
    cosine = cosine * side[:, None]
    # RMS of an exact fit has no derivative; a residual of 1e-6 s is nothing
    height = (mean(residual**2) + 1e-12).sqrt()
    distance = (mean(residual**2 / slope) + 1e-12).sqrt()
    return Discrepancy(
        height,
        distance,
        mean(cosine),
        torch.rad2deg(mean(torch.arccos(cosine.detach().clamp(-1, 1)))),
    )


def share_behind(normals, mask=None):
    """Share of each patch, (B,), that faces away from the z axis, whichever side of the patch is
    up: 0 for a height graph; ``normals`` (B, P, 3).
    """
    count = normals.shape[1] if mask is None else mask.sum(1)
    down = normals[..., 2] < 0
    share = (down if mask is None else down & mask).sum(1) / count
    return torch.minimum(share, 1 - share)
