"""The surfaces that :mod:`scaling` tracks: both are developed from a plane, so lengths stay."""

from dataclasses import dataclass

import numpy as np

from polysft_mi.camera import Intrinsics

SHARE = 1 / 3  # of the image that a sheet covers
PLEATED_SHARES = 0.85, 0.55  # of the image's width and height that pleats cover at the end
STEEPEST = np.radians([100.0, 83.0])  # slope of pleats at the start, where they hang over; the end
_FINE = 40  # steps of the quadrature for each vertex


@dataclass(frozen=True)
class Surface:
    """``columns`` times ``rows`` vertices; a sheet, or one with so many ``pleats``."""

    columns: int
    rows: int
    pleats: int = 0

    @property
    def name(self):
        vertices = f"{self.columns * self.rows} vertices"
        return f"{vertices}, {self.pleats} pleats" if self.pleats else vertices

    def at(self, size, t):
        """Vertices (N, 3) [m, camera frame] at the time t in [0, 1]; ``size`` of the image."""
        return self._pleated(size, t) if self.pleats else self._sheet(size, t)

    def faces_and_uv(self):
        """Triangles (F, 3), and texture coordinates (N, 2)."""
        k = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        a, b, d, e = (q.ravel() for q in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
        u, v = self._grid(0, 1)
        return np.stack([a, d, b, b, d, e], axis=1).reshape(-1, 3), np.stack([u, 1 - v], axis=1)

    def _grid(self, low, high):
        sides = (np.linspace(low, high, n) for n in (self.columns, self.rows))
        return (a.ravel() for a in np.meshgrid(*sides))

    def _sheet(self, size, t):
        """Flat at 0, a part of a cylinder around a slanting axis later."""
        x, y = self._grid(-0.5, 0.5)
        extent = np.sqrt(SHARE) * np.array(size) / camera(size).fx
        x, y = x * extent[0], y * extent[1]
        c, s = np.cos(0.4), np.sin(0.4)
        along, across = c * x + s * y, c * y - s * x
        curvature = max(1.5 * t, 1e-9) / extent[0]
        bent, z = np.sin(curvature * along) / curvature, (1 - np.cos(curvature * along)) / curvature
        x, y = c * bent - s * across, s * bent + c * across
        c, s = np.cos(0.2 * t), np.sin(0.2 * t)
        return np.stack([c * x - s * y + 0.02 * t, s * x + c * y, 1 + z], axis=1)

    def _pleated(self, size, t):
        """A curtain whose pleats are drawn apart: its slope is a sine of the length."""
        width, height = np.array(PLEATED_SHARES) * size / camera(size).fx
        ends = [self._profile(steepest) for steepest in STEEPEST]
        x, z = self._profile((1 - t) * STEEPEST[0] + t * STEEPEST[1])
        scale = width / np.ptp(ends[1][0])
        y = height * np.linspace(-0.5, 0.5, self.rows)
        grid = np.broadcast_arrays(scale * x, y[:, None], 1 + scale * z)
        return np.stack([a.ravel() for a in grid], axis=1)

    def _profile(self, steepest):
        """(x, z) of the columns for a length of 1, their middle at 0."""
        step = 1 / ((self.columns - 1) * _FINE)
        middle = step * (np.arange((self.columns - 1) * _FINE) + 0.5)
        slope = steepest * np.sin(2 * np.pi * self.pleats * middle)
        x, z = (np.append(0, step * np.cumsum(f(slope)))[::_FINE] for f in (np.cos, np.sin))
        return x - x.mean(), z - z.mean()


def camera(size):
    """The :class:`polysft_mi.camera.Intrinsics` [pixels] of images of ``size`` (width, height)."""
    width, height = size
    return Intrinsics(1.1 * width, 1.1 * width, width / 2, height / 2, width, height)
