"""The shapes that ``simulate.py`` lets move: sheets, and surfaces that are no height graph.

All are in metres in the camera's frame (x right, y down, z forward), ``DEPTH`` away.
"""

from dataclasses import dataclass

import numpy as np

from polyfit.mesh import TexCoords

DEPTH = 0.62  # of the flat sheet [m]


@dataclass(frozen=True)
class Shape:
    """``vertices`` (N, 3) [m], ``faces`` (F, 3), ``uv``: (N, 2), v up, or a
    :class:`polyfit.mesh.TexCoords` where there is a seam; ``held`` (N,) bool: which vertices a hand
    moves; ``aspect``: width over height of the texture.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | TexCoords
    held: np.ndarray
    aspect: float


def _grid(nx, ny):
    """u, v (ny + 1, nx + 1), 0 to 1, v downwards, and two triangles (2 nx ny, 3) a cell, none of
    them with all its corners on the border.
    """
    v, u = np.meshgrid(np.linspace(0, 1, ny + 1), np.linspace(0, 1, nx + 1), indexing="ij")
    at = np.arange((nx + 1) * (ny + 1)).reshape(ny + 1, nx + 1)
    a, b, c, d = (x.ravel() for x in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    one, other = np.stack([a, c, b], 1), np.stack([b, c, d], 1)
    for k in (0, -1):  # the first and the last cell are cut along their other diagonal
        one[k], other[k] = (a[k], c[k], d[k]), (a[k], d[k], b[k])
    return u, v, np.concatenate([one, other])


def _sewn(points, faces, uv):
    """Points that coincide become one vertex: (vertices, faces, TexCoords)."""
    _, first, index = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    return points[first], index.ravel()[faces], TexCoords(uv, faces)


def skirt(cells=(48, 20), radii=(0.055, 0.095), height=0.16):
    """A cone that is open at both ends, with a seam along its back; its waist is held."""
    u, v, faces = _grid(*cells)
    radius, angle = radii[0] + (radii[1] - radii[0]) * v, 2 * np.pi * (u - 0.5)
    # u = 1/2 faces the camera
    points = np.stack(
        [radius * np.sin(angle), (v - 0.5) * height, DEPTH - radius * np.cos(angle)], -1
    )
    uv = np.stack([u, 1 - v], -1).reshape(-1, 2)
    vertices, faces, coordinates = _sewn(points.reshape(-1, 3), faces, uv)
    held = vertices[:, 1] < -0.5 * height + 1e-6
    return Shape(vertices, faces, coordinates, held, 2 * np.pi * np.mean(radii) / height)


def pillow(cells=(26, 20), size=(0.24, 0.18), thickness=0.07):
    """Two sheets that are sewn along their borders, closed; its left and right ends are held."""
    u, v, faces = _grid(*cells)
    x, y = (u - 0.5) * size[0], (v - 0.5) * size[1]
    # the fourth root: round borders, no edge
    bulge = (16 * u * (1 - u) * v * (1 - v)) ** 0.5 * thickness / 2
    points = np.concatenate([
        np.stack([x, y, DEPTH + side * bulge], -1).reshape(-1, 3) for side in (-1, 1)
    ])  # fmt: skip
    uv = np.concatenate([
        np.stack([u / 2, 1 - v], -1).reshape(-1, 2), np.stack([1 - u / 2, 1 - v], -1).reshape(-1, 2)
    ])  # fmt: skip
    faces = np.concatenate([faces, faces[:, ::-1] + u.size])
    vertices, faces, coordinates = _sewn(points, faces, uv)
    held = np.abs(vertices[:, 0]) > 0.5 * size[0] - 1e-6
    return Shape(vertices, faces, coordinates, held, 2 * size[0] / size[1])


def roll(cells=(40, 22), size=(0.32, 0.18), turn=4.4):
    """A sheet that is rolled by ``turn`` [rad] about an upright axis, its outside to the camera;
    a strip along its left edge is held.
    """
    u, v, faces = _grid(*cells)
    radius, angle = size[0] / turn, turn * (u - 0.5)
    points = np.stack(
        [radius * np.sin(angle), (v - 0.5) * size[1], DEPTH - radius * np.cos(angle)], -1
    )
    uv = np.stack([u, 1 - v], -1).reshape(-1, 2)
    return Shape(points.reshape(-1, 3), faces, uv, u.ravel() < 1.5 / cells[0], size[0] / size[1])


def tube(cells=(28, 36), radius=0.045, length=0.24):
    """A sleeve, open at both ends, which are held; its axis lies across, its seam behind."""
    u, v, faces = _grid(*cells)
    angle = 2 * np.pi * (v - 0.5)  # v = 1/2 faces the camera
    ring = radius * np.sin(angle), DEPTH - radius * np.cos(angle)
    points = np.stack([(u - 0.5) * length, *ring], -1).reshape(-1, 3)
    uv = np.stack([u, 1 - v], -1).reshape(-1, 2)
    vertices, faces, coordinates = _sewn(points, faces, uv)
    held = np.abs(vertices[:, 0]) > 0.5 * length - 1e-6
    return Shape(vertices, faces, coordinates, held, length / (2 * np.pi * radius))


ROUNDED = {"skirt": skirt, "pillow": pillow, "roll": roll, "tube": tube}
