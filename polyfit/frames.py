"""Canonical frames: the orientation O = (s, R, T) that takes a patch to its chart and back (paper, section "PolyFit")."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class CanonicalFrame:
    """p = s R x + T, with x in the chart (u, v, z) and p in the surface's own frame [m].

    ``s`` is a scalar [m], ``R`` (3, 3) a rotation whose columns are the chart's axes, ``T`` (3,) the chart's origin [m].
    """

    s: torch.Tensor
    R: torch.Tensor
    T: torch.Tensor

    @classmethod
    def from_points(cls, points):
        """By principal components of points (P, 3): T is their mean, s their largest distance from it, z the direction of least spread.

        Signs are fixed by the data so that the frame turns with the points: u and v point to the side where the third moment of
        the coordinate is positive (for a symmetric patch: to the side of the farthest first point), z follows by the right hand.
        """
        points = points.to(torch.float64)
        T = points.mean(0)
        centred = points - T
        s = centred.norm(dim=1).max()
        if not s > 0:
            raise ValueError("the points coincide")
        _, _, vt = torch.linalg.svd(centred / s, full_matrices=False)
        axes = []
        for axis in vt[:2]:
            x = centred @ axis / s
            skew = (x**3).mean()
            side = skew if skew.abs() > 1e-9 else x[x.abs().argmax()]
            axes.append(axis if side >= 0 else -axis)
        axes.append(torch.linalg.cross(axes[0], axes[1]))
        return cls(s, torch.stack(axes, 1), T)

    def to_chart(self, points):
        """Chart coordinates (P, 3) of points (P, 3) [m]."""
        return (points.to(self.R.dtype) - self.T) @ self.R / self.s

    def from_chart(self, x):
        """Points (P, 3) [m] of chart coordinates (P, 3)."""
        return self.s * x.to(self.R.dtype) @ self.R.T + self.T
