"""Canonical frames: the orientations O = (s, R, T) that take patches to their charts and back
(paper, section "PolyFit").
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from polyfit.errors import InputError


@dataclass(frozen=True)
class CanonicalFrame:
    """p = s R x + T, with x in the chart (u, v, z) and p in the surface's own frame [m].

    ``s`` (...,) [m], ``R`` (..., 3, 3) rotations whose columns are the chart's axes, ``T`` (..., 3)
    the charts' origins [m]: one frame, or a batch of them.
    """

    s: Tensor
    R: Tensor
    T: Tensor

    @classmethod
    def from_points(
        cls, points: Tensor, mask: Tensor | None = None, *, weights: Tensor | None = None
    ) -> "CanonicalFrame":
        """By principal components of points (..., P, 3): T is their mean, s their largest distance
        from it, z the direction of least spread.

        ``mask`` (..., P) bool: the points that exist; ``weights`` (..., P) not negative, for mean
        and spread. The data fix the signs, so that the frame turns with the points: u and v point
        to the side where the third moment of the coordinate is positive. For a symmetric patch they
        point to the first point that is at least half as far out as the farthest. z follows by the
        right hand. Computed in float64, returned in the points' dtype. Without gradient: a frame is
        a choice of coordinates. Raises InputError where a patch has no points, or points that are
        not finite or all the same.
        """
        with torch.no_grad():
            dtype, points = points.dtype, points.detach().to(torch.float64)
            if points.shape[-2] == 0:
                raise InputError("patches without points")
            w = (
                points.new_ones(points.shape[:-1])
                if weights is None
                else weights.detach().to(torch.float64)
            )
            if mask is not None:
                w = torch.where(mask, w, 0)
                points = torch.where(mask[..., None], points, 0)
            w = w / w.sum(-1, keepdim=True)
            T = (w[..., None, :] @ points)[..., 0, :]
            centred = points - T[..., None, :]
            distance = centred.square().sum(-1)
            if mask is not None:
                distance = torch.where(mask, distance, 0)
            s = distance.amax(-1).sqrt()
            _check(points, mask, s)
            x = centred / s[..., None, None]
            _, axes = torch.linalg.eigh((w[..., None] * x).mT @ x)
            u, v = axes[..., 2], axes[..., 1]
            # float32 points are symmetric only to their rounding
            level = 1e-9 if dtype == torch.float64 else 1e-6
            u = u * _side(x, u, w, mask, level)
            v = v * _side(x, v, w, mask, level)
            R = torch.stack([u, v, torch.linalg.cross(u, v)], -1)
            return cls(s.to(dtype), R.to(dtype), T.to(dtype))

    def to_chart(self, points: Tensor) -> Tensor:
        """Chart coordinates (..., P, 3) of points (..., P, 3) [m]."""
        return (points - self.T[..., None, :]) @ self.R / self.s[..., None, None]

    def from_chart(self, x: Tensor) -> Tensor:
        """Points (..., P, 3) [m] of chart coordinates (..., P, 3)."""
        return self.s[..., None, None] * x @ self.R.mT + self.T[..., None, :]

    def rotated(self, quaternion: Tensor) -> "CanonicalFrame":
        """The frame whose chart is turned by the unit quaternion (..., 4) in the order (x, y, z,
        w): R Q, so that a point of chart coordinates x has Q^T x in the new chart. Differentiable;
        the quaternion is divided by its norm.
        """
        return CanonicalFrame(self.s, self.R @ rotation_matrix(quaternion), self.T)

    def turned_over(self) -> "CanonicalFrame":
        """The frame with v and z pointing the other way: a half turn about u.
        :func:`polyfit.jets.turned_over` does it to a jet.
        """
        return CanonicalFrame(self.s, self.R * self.R.new_tensor([1, -1, -1]), self.T)

    def __getitem__(self, index: Any) -> "CanonicalFrame":
        return CanonicalFrame(self.s[index], self.R[index], self.T[index])

    def to(self, *args: Any, **kwargs: Any) -> "CanonicalFrame":
        """The frame with another dtype or on another device."""
        return CanonicalFrame(*(x.to(*args, **kwargs) for x in (self.s, self.R, self.T)))


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of quaternions (..., 4) in the order (x, y, z, w), which are divided by
    their norm.
    """
    x, y, z, w = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _side(x: Tensor, axis: Tensor, w: Tensor, mask: Tensor | None, level: float) -> Tensor:
    """1 or -1, (..., 1): the side of ``axis`` (..., 3) that it should point to."""
    along = (x @ axis[..., None])[..., 0]
    if mask is not None:
        along = torch.where(mask, along, 0)
    skew = (w * along**3).sum(-1)
    far = along.abs() >= 0.5 * along.abs().amax(-1, keepdim=True)
    first = along.gather(-1, far.to(torch.uint8).argmax(-1, keepdim=True))[..., 0]
    side = torch.where(skew.abs() > level, skew, first)
    return torch.where(side < 0, -1.0, 1.0).to(axis.dtype)[..., None]


def _check(points: Tensor, mask: Tensor | None, s: Tensor) -> None:
    bad = ~(s > 1e-12 * points.abs().amax((-1, -2))) | ~s.isfinite()
    if not bad.any():
        return
    at = tuple(int(i) for i in bad.nonzero()[0])
    name = f"patch {at[0] if len(at) == 1 else at}" if at else "the patch"
    count = int(mask[at].sum()) if mask is not None else points.shape[-2]
    if count == 0:
        raise InputError(f"{name} has no points")
    if not points[at].isfinite().all():
        raise InputError(f"{name} has points that are not finite")
    raise InputError(f"{name}: its {count} points coincide")
