"""Chromaticity: what a colour is but for its brightness, which no white light changes. NumPy."""

from dataclasses import dataclass

import numpy as np

from .triangles import cross

_LEAST = 1e-3  # of a colour, over the mean of the texture's luminance: a darker one has none
# what a white balance changes: the channels but for their sum
_CHANNELS = np.array([[1, -1, 0], [1, 1, -2]]).T / np.sqrt([2, 6])
_REFITS = 3  # of the white balance; each counts outliers less


@dataclass
class Chroma:
    """How the chromaticity of F triangles departs from their texture's.

    ``residual`` (F, 2): the part of the colour shown that is across the colour of the texture, as
    linear RGB over the mean of the texture's luminance; ``slope`` (F, 2, 2): its derivative by
    the triangle's place in the image [1/pixel]; ``by_vertex`` (N, 2, 3): derivatives of the
    vertices' places by their positions [pixels/m]; ``area`` (F,): 1 on average over the triangles
    that count, 0 for others.
    """

    residual: np.ndarray
    slope: np.ndarray
    by_vertex: np.ndarray
    area: np.ndarray

    @classmethod
    def of(cls, colours, prepared, vertices, camera, pixels, cast, scale, texture=None):
        """Of the surface with ``vertices`` (N, 3) [m] in the frame ``prepared`` by the ``colours``,
        :class:`polysft_mi.images.triangles.TriangleColours`. ``pixels`` (F,) of its triangles are
        seen; ``texture`` (F, 3): colours of the texture as an image shows it; ``cast`` (F, 3): what
        those of the template are multiplied by, as another frame shows it (:func:`colour_cast`).

        A frame's white balance is its own: the channels' gains, whose mean is 1, are those of the
        least sum of ``scale`` ^2 log(1 + r^2 / ``scale`` ^2). At its least, that has no slope along
        them.
        """
        position, _ = camera.project(vertices)
        centres = position[colours.faces].sum(1) / 3
        shown, expected = colours.shown(prepared, centres), colours.known(texture) * cast
        length = np.linalg.norm(expected, axis=1)
        counts = colours.trusted & (pixels > 0) & (length > _LEAST)
        unit = expected / np.maximum(length, _LEAST)[:, None]
        one = cross(unit, np.eye(3)[np.abs(unit).argmin(1)])
        one /= np.maximum(np.linalg.norm(one, axis=1), _LEAST)[:, None]
        across = np.stack([one, cross(unit, one)], 1)
        corner = vertices[colours.faces]
        sides = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        area = np.where(counts, np.linalg.norm(cross(*sides), axis=1), 0.0)
        area *= counts.sum() / max(area.sum(), 1e-30)
        channels = across * shown[:, None]
        plain, by_gain = channels.sum(-1), channels @ _CHANNELS
        gain = np.zeros(2)
        for _ in range(_REFITS):
            squared = ((plain + by_gain @ gain) ** 2).sum(1)
            heavy = (area / (1 + squared / scale**2))[:, None, None] * by_gain
            matrix = np.tensordot(heavy, by_gain, ((0, 1), (0, 1))) + 1e-9 * np.eye(2)
            gain = -np.linalg.solve(matrix, np.tensordot(heavy, plain, ((0, 1), (0, 1))))
        balanced = across * (1 + _CHANNELS @ gain)
        slope = balanced @ colours.slopes(prepared, centres)
        return cls(plain + by_gain @ gain, slope, camera.derivatives(vertices), area)

    def at_vertices(self, factor, pattern):
        """Half the sum of ``factor`` (F,) times the squared residuals, to second order in the
        vertices: gradient (N, 3) [1/m] and, for the U pairs of neighbours of a
        :class:`polysft_mi.surface.pattern.Pattern`, Gauss-Newton's curvature (U, 2, 2) in their
        places in the image [1/pixel^2].
        """
        heavy = factor[:, None, None] * self.slope.transpose(0, 2, 1) / 3  # a corner's share
        at_corners = pattern.corners @ (heavy @ self.residual[:, :, None])[:, :, 0]
        second = pattern.shares @ (heavy @ self.slope / 3).reshape(-1, 4)
        return np.einsum("np,npk->nk", at_corners, self.by_vertex), second.reshape(-1, 2, 2)


def colour_cast(colours, shown, pixels):
    """(F, 3): by what a frame that shows the triangles as ``shown`` (F, 3) multiplies the colours
    of their texture, over the usual: a camera's curve, the light's colour. Between 1/2 and 2; the
    usual where none of the ``pixels`` (F,) is a triangle's.
    """
    ratio = np.maximum(shown, _LEAST) / np.maximum(colours.colour, _LEAST)
    known = colours.trusted & (pixels > 0)
    if not known.any():
        return np.ones_like(ratio)
    usual = np.median(ratio[known])
    ratio[~known] = np.median(ratio[known], axis=0)
    return np.clip(ratio / usual, 0.5, 2.0)
