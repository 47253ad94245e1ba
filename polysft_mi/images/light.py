"""Shading as a cue: how bright each triangle is under a light that is learned along with the video.
NumPy and OpenCV.

A triangle with the unit normal n towards the camera and its centre at x, whose texture has the
luminance t, is taken to be seen with t (l_0 + l . n + g . x). Light of first order in the normal
holds most of what a matt surface reflects of any distant light (Basri and Jacobs, "Lambertian
Reflectance and Linear Subspaces", PAMI 2003); that in the position, what of it comes from a lamp
nearby. Where the sheet casts shadows on itself both are wrong, hence a robust norm.
"""

from dataclasses import dataclass, replace

import numpy as np

from polysft_mi.scene import Rules

from .triangles import cross, luminance

_SIZE = 7  # of the unknowns (l_0, l, g)
_UPPER = np.triu_indices(_SIZE)


@dataclass
class Fit:
    """How a light explains the F triangles of a frame: its ``coefficients`` (7,); ``residual``
    (F,): frame, without its exposure, less the light's; ``area`` (F,), 1 on average over the
    triangles that are seen and 0 for others; ``departure``: what it costs that the light is another
    than that of the frames before, in squared residuals of a triangle; ``matrix`` (7, 7), ``right``
    (7,): of the frame's own normal equations.
    """

    coefficients: np.ndarray
    residual: np.ndarray
    area: np.ndarray
    departure: float
    matrix: np.ndarray
    right: np.ndarray


@dataclass(frozen=True)
class Light:
    """What the frames so far say of the light, the last ones most: normal equations ``matrix`` (7,
    7) and ``right`` (7,) of (l_0, l, g), over the mean of the texture's luminance, in triangles.
    """

    matrix: np.ndarray
    right: np.ndarray
    rules: Rules

    @classmethod
    def unknown(cls, rules):
        return cls(np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE), rules)

    @classmethod
    def of(cls, numbers, rules):
        """The light that :meth:`numbers` tell of; unknown where they are None."""
        if numbers is None:
            return cls.unknown(rules)
        matrix = np.zeros((_SIZE, _SIZE))
        matrix[_UPPER] = numbers[:-_SIZE]
        return cls(matrix + np.triu(matrix, 1).T, np.array(numbers[-_SIZE:]), rules)

    def numbers(self):
        """All of it as a list of numbers."""
        return [*self.matrix[_UPPER].tolist(), *self.right.tolist()]

    @property
    def is_known(self):
        """Whether any frame has told of it."""
        return bool(self.matrix.any())

    def mirrored(self, normal, distance):
        """What the same frames would say, had they shown the mirror images of their surfaces at the
        plane with this unit ``normal`` (3,), ``distance`` from the template's centre in the units
        of :class:`Shade`'s ``centre``: a normal keeps its part along the plane's and turns the
        rest, a centre the other way round.
        """
        across = np.outer(normal, normal)
        turn = np.zeros((_SIZE, _SIZE))  # of a triangle's row (1, normal, centre)
        turn[0, 0], turn[0, 4:] = 1, 2 * distance * normal
        turn[1:4, 1:4], turn[4:, 4:] = 2 * across - np.eye(3), np.eye(3) - 2 * across
        matrix = turn.T @ self.matrix @ turn
        # to the last bit, as numbers() has it: a run that is resumed is the same
        return replace(self, matrix=(matrix + matrix.T) / 2, right=turn.T @ self.right)

    def coefficients(self, triangles):
        """(l_0, l, g) (7,), of a sheet of so many triangles; the same from all sides where nothing
        is known.
        """
        if not self.is_known:
            return np.eye(_SIZE)[0]
        return np.linalg.solve(self._prior_curvature(triangles), self.right)

    def _prior_curvature(self, triangles):
        """The curvature (7, 7) that holds the coefficients where they are, in squared residuals of
        a triangle.
        """
        return self.matrix + np.diag([1e-9] + [self.rules.light_ridge * triangles] * (_SIZE - 1))

    def fit(self, shade):
        """The light that explains a frame and the frames before it best, where its surface has the
        triangles ``shade`` (a :class:`Shade`): :class:`Fit`.
        """
        rows = shade.texture[:, None] * np.column_stack(
            [np.ones(len(shade.seen)), shade.normal, shade.centre]
        )
        area = np.where(shade.seen, shade.area, 0.0)
        area *= shade.seen.sum() / max(area.sum(), 1e-30)  # 1 on average
        held, before = self._prior_curvature(len(shade.seen)), self.coefficients(len(shade.seen))
        value = shade.luminance
        if self.rules.exposure:
            value = value / _exposure(value[shade.seen], (rows @ before)[shade.seen])
        found, scale = before, self.rules.light_scale
        for _ in range(self.rules.light_refits):
            weighted = (area / (1 + ((value - rows @ found) / scale) ** 2))[:, None] * rows
            matrix, right = weighted.T @ rows, weighted.T @ value
            matrix = np.triu(matrix) + np.triu(matrix, 1).T  # as a checkpoint has it
            found = np.linalg.solve(held + matrix, held @ before + right)
        change = found - before
        return Fit(found, value - rows @ found, area, float(change @ held @ change), matrix, right)

    def updated(self, shade):
        """The light after a frame whose surface had the triangles ``shade``."""
        if shade.seen.sum() < _SIZE:
            return self
        fit, kept = self.fit(shade), self.rules.light_kept
        matrix, right = kept * (self.matrix + fit.matrix), kept * (self.right + fit.right)
        return replace(self, matrix=matrix, right=right)


@dataclass
class Shade:
    """The triangles of a surface in a frame, (F,) or (F, 3) each: ``normal``, of length 1, towards
    the camera; ``centre``, from that of the template, over ``unit`` [m]; ``texture`` and
    ``luminance``: what the texture has and the frame shows, blurred alike, over the texture's mean;
    ``seen``: those that can be compared; ``edges``: two (F, 3) [m], from the first corner; ``area``
    [m^2]; ``facing``: 1 or -1, whether the normal is that of the two edges or opposite."""

    normal: np.ndarray
    centre: np.ndarray
    unit: float
    texture: np.ndarray
    luminance: np.ndarray
    seen: np.ndarray
    edges: tuple
    area: np.ndarray
    facing: np.ndarray


class Brightness:
    """Luminance of the template's texture and of frames, at the size of the triangles.

    ``colours``: theirs, :class:`polysft_mi.images.triangles.TriangleColours`; ``vertices`` (N, 3)
    [m]: of the template.
    """

    def __init__(self, colours, vertices):
        self.colours, self.faces, self.centre = colours, colours.faces, vertices.mean(0)
        self.unit = float(np.abs(vertices - self.centre).max())

    def irradiance(self, vertices, origin, light):
        """How bright the ``light`` (7,) makes the triangles (F,) of a surface with ``vertices`` (N,
        3) [m], seen from ``origin`` (3,): averages over their neighbours."""
        corner = vertices[self.faces]
        normal = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.sqrt(np.einsum("fk,fk->f", normal, normal)), 1e-15)[:, None]
        centre = corner.sum(1) / 3
        normal *= -np.sign(np.einsum("fk,fk->f", normal, centre - origin))[:, None]
        value = light[0] + normal @ light[1:4] + (centre - self.centre) @ light[4:] / self.unit
        value = np.maximum(value, 0.0)  # no light is less than none
        total, count = (
            sum(np.bincount(k, w, len(vertices)) for k in self.faces.T)
            for w in (value, np.ones(len(value)))
        )
        return (total / np.maximum(count, 1))[self.faces].mean(1)

    def of(self, prepared, vertices, origin, position, pixels, texture=None):
        """The :class:`Shade` of the surface with ``vertices`` (N, 3) [m], which lie at ``position``
        (N, 2) [pixels] in the image and of whose triangles ``pixels`` (F,) are seen; ``origin``
        (3,): the camera's; ``texture`` (F, 3): colours of the texture as an image shows it.
        """
        corner = vertices[self.faces]
        a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        ray = corner.sum(1) / 3 - origin
        across = cross(a, b)
        double = np.maximum(np.sqrt(np.einsum("fk,fk->f", across, across)), 1e-15)
        towards = -np.einsum("fk,fk->f", across, ray)
        facing = np.sign(towards)
        normal = across * (facing / double)[:, None]
        shown = luminance(self.colours.shown(prepared, position[self.faces].sum(1) / 3))
        texture = luminance(self.colours.known(texture))
        seen = self.colours.trusted & (pixels > 0)
        centre = (corner.sum(1) / 3 - self.centre) / self.unit
        return Shade(normal, centre, self.unit, texture, shown, seen, (a, b), double / 2, facing)


def residuals(shade, light, weight):
    """The shading term of a frame, ``weight`` times the mean over the area seen of c^2 log(1 + r^2
    / c^2) with r = frame - t (l_0 + l . n + g . x), where (l_0, l, g) is what explains this frame
    best after those before, ``light``; what that departs from theirs costs too.

    Returns its energy, the residuals r (F,), the factors h (F,) of r^2 / 2 in its quadratic model,
    and the derivatives (F, 3, 3) of r by the corners [1/m]. The light follows the surface; at its
    best, the energy has no slope along it.
    """
    fit, scale = light.fit(shade), light.rules.light_scale
    weight = weight / max(shade.seen.sum(), 1)
    over = (fit.residual / scale) ** 2
    energy = weight * (scale**2 * float((fit.area * np.log1p(over)).sum()) + fit.departure)
    slope, gradient = fit.coefficients[1:4], fit.coefficients[4:]
    # n = (a x b) / |a x b|, whose length does not change: dr = across . d(a x b), and a x b changes
    # with the corners
    a, b = shade.edges
    across = (slope - shade.normal * (shade.normal @ slope)[:, None]) * (
        -shade.texture * shade.facing / (2 * shade.area)
    )[:, None]
    second, third = cross(b, across), cross(across, a)
    by_corner = (
        np.stack([-second - third, second, third], 1)
        - (shade.texture / (3 * shade.unit))[:, None, None] * gradient
    )
    return energy, fit.residual, 2 * weight * fit.area / (1 + over), by_corner


def _exposure(value, lit):
    """By how much a frame is brighter than the light makes it: cameras choose their exposure as
    they go. 1 where nothing tells.
    """
    known = (value > 0) & (lit > 0)
    return float(np.median(value[known] / lit[known])) if known.any() else 1.0
