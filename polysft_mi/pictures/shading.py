"""Pictures of a surface in NumPy alone: shaded, from a viewpoint of one's choice; or its depth and
values at its vertices, as the camera sees them.
"""

import colorsys
import functools
from dataclasses import dataclass, replace

import numpy as np

from polysft_mi.results import vertex_normals


@dataclass(frozen=True)
class ShadingLook:
    """How a surface is shaded. Colours are linear RGB.

    ``background``: grey; ``front``, ``back``: albedo of the two sides; ``key``, ``fill``: towards
    the two lights, in the view's frame; ``supersample``: samples a pixel and axis.
    """

    background: float = 0.90
    front: tuple = (0.80, 0.56, 0.33)
    back: tuple = (0.30, 0.47, 0.66)
    key: tuple = (-0.80, -0.50, -0.45)
    fill: tuple = (0.60, -0.20, -0.80)
    supersample: int = 2


def srgb(linear):
    """Linear values (...) as sRGB in [0, 1] (IEC 61966-2-1); not a number is 0."""
    x = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


@functools.cache
def _srgb_codes(steps=4096):
    """The sRGB codes (``steps``,) uint8 of linear values from 0 to 1."""
    return np.round(255 * srgb(np.linspace(0, 1, steps))).astype(np.uint8)


@dataclass(frozen=True)
class View:
    """An orthographic view: rows of ``rotation`` (3, 3) are the picture's right, down and forward
    in the camera frame.

    ``centre`` (3,) [m] lies in the middle of the picture and ``radius`` [m] reaches from it to the
    nearer pair of borders.
    """

    rotation: np.ndarray
    centre: np.ndarray
    radius: float

    @classmethod
    def around(cls, points, azimuth=40.0, elevation=25.0):
        """The view of points (..., 3) [m] after the camera went round them by ``azimuth`` to its
        right and ``elevation`` up [degrees].

        Give the points of all frames to see all frames from one place.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        a, e = np.radians([azimuth, elevation])
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        tilt = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
        rotation = tilt @ turn
        seen = points @ rotation.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        return cls(rotation, (low + high) / 2 @ rotation, 0.55 * float(np.max((high - low)[:2])))

    def wider(self, factor):
        """The same view with ``factor`` times as much in it."""
        return replace(self, radius=factor * self.radius)

    def holds(self, points):
        """Whether points (..., 3) [m] all lie in the picture, whatever its form."""
        seen = (np.asarray(points, dtype=np.float64).reshape(-1, 3) - self.centre) @ self.rotation.T
        return bool((np.abs(seen[:, :2]) <= self.radius).all())


def shade_surface(vertices, faces, view=None, uv=None, size=(480, 480), look=None):
    """A matte picture (height, width, 3) uint8 sRGB of a mesh: vertices (N, 3) [m], faces (F, 3),
    ``size`` = (width, height).

    Lambert shading with smooth normals under a key light from the left and a weak fill, warm on the
    side from which the triangles' normals point to the viewer, cool on the other. With ``uv`` (F,
    3, 2), of the faces' corners, a thin grid of ten by ten cells is drawn. ``look``:
    :class:`ShadingLook`.
    """
    look = look or ShadingLook()
    times, codes = look.supersample, _srgb_codes()
    V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    view = View.around(V) if view is None else view
    width, height = (s * times for s in size)
    seen = (V - view.centre) @ view.rotation.T
    scale = 0.5 * min(width, height) / view.radius
    corners = (seen[:, :2] * scale + (width / 2, height / 2))[F]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    away = area > 0  # the triangle's own normal points away from the viewer
    normals = vertex_normals(V, F) @ view.rotation.T
    values = [
        seen[:, 2][F],
        np.where(away[:, None], _light(-normals, look)[F], _light(normals, look)[F]),
    ]
    if uv is not None:
        uv = np.asarray(uv, dtype=np.float64)
        low, extent = uv.min(axis=(0, 1)), np.ptp(uv, axis=(0, 1))
        values += [*np.moveaxis((uv - low) / np.maximum(extent, 1e-12) * 10, 2, 0)]

    triangle, x, y = _covered_pixels(corners, width, height)
    # values are affine in a triangle, because the view is orthographic: its constant, and slopes to
    # the right and down
    with np.errstate(divide="ignore", invalid="ignore"):  # triangles seen edge-on cover nothing
        affine = []
        for value in values:
            d1, d2 = value[:, 1] - value[:, 0], value[:, 2] - value[:, 0]
            slopes = (
                (d1 * edge2[:, 1] - d2 * edge1[:, 1]) / area,
                (d2 * edge1[:, 0] - d1 * edge2[:, 0]) / area,
            )
            at_origin = (
                value[:, 0]
                - slopes[0] * (corners[:, 0, 0] - 0.5)
                - slopes[1] * (corners[:, 0, 1] - 0.5)
            )  # the origin's pixel
            affine.append((at_origin, *slopes))

    def inside(value, t, x, y):
        return value[0].take(t) + value[1].take(t) * x + value[2].take(t) * y

    pixel, depth = y * width + x, inside(affine[0], triangle, x, y)
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, pixel, depth)
    front = np.flatnonzero(depth == nearest[pixel])
    triangle, x, y = triangle[front], x[front], y[front]
    light = np.clip(inside(affine[1], triangle, x, y), 0, 2)
    for value in affine[2:]:
        at = inside(value, triangle, x, y)
        light *= 1 - 0.17 * np.clip(2 - np.abs(at - np.round(at)) / 0.03, 0, 1)

    # a pixel is the mean of its samples: of either side's light, and of the background
    at, back = y // times * size[0] + x // times, away[triangle]
    shares = [
        np.bincount(at, weights, size[0] * size[1]) / times**2
        for weights in (light * back, light * ~back, None)
    ]
    covered = np.flatnonzero(shares[2])
    of_back, of_front, sheet = (share[covered, None] for share in shares)
    colour = np.clip(
        of_back * look.back + of_front * look.front + (1 - sheet) * look.background, 0, 1
    )
    image = np.full((size[0] * size[1], 3), codes[int(look.background * (len(codes) - 1))])
    image[covered] = codes[(colour * (len(codes) - 1)).astype(np.int64)]
    return image.reshape(size[1], size[0], 3)


def seen(vertices, faces, camera, values=()):
    """What a camera sees of a mesh: depth (H, W) [m], NaN beyond the mesh, and an image (H, W) of
    each of ``values`` (N,), given at the vertices.

    ``vertices`` (N, 3) [m, camera frame]; ``camera``: :class:`polysft_mi.camera.Intrinsics`.
    Interpolation is perspective, at the pixels' centres; triangles that reach behind the camera are
    left out.
    """
    V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    F = F[(V[F, 2] > 1e-9).all(axis=1)]
    corners, near = (
        camera.project(np.where(V[:, 2:] > 1e-9, V, 1.0))[F],
        1 / np.where(V[:, 2] > 1e-9, V[:, 2], 1.0),
    )
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    triangle, x, y = _covered_pixels(corners, camera.width, camera.height)
    right, down = x + 0.5 - corners[triangle, 0, 0], y + 0.5 - corners[triangle, 0, 1]
    area = (edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0])[triangle]
    with np.errstate(divide="ignore", invalid="ignore"):
        b1 = (right * edge2[triangle, 1] - down * edge2[triangle, 0]) / area
        b2 = (down * edge1[triangle, 0] - right * edge1[triangle, 1]) / area
    weights = (
        np.stack([1 - b1 - b2, b1, b2], axis=1) * near[F][triangle]
    )  # those of the surface, times 1/z
    inverse = weights.sum(axis=1)
    pixel = y * camera.width + x
    nearest = np.zeros(camera.height * camera.width)
    np.maximum.at(nearest, pixel, inverse)
    front = np.flatnonzero(inverse == nearest[pixel])
    images = np.full((1 + len(values), len(nearest)), np.nan)
    images[0, pixel[front]] = 1 / inverse[front]
    for image, value in zip(images[1:], values):
        image[pixel[front]] = (
            weights[front] * np.asarray(value, dtype=np.float64)[F][triangle[front]]
        ).sum(axis=1) / inverse[front]
    return tuple(images.reshape(-1, camera.height, camera.width))


def patch_colours(patch, weight):
    """Colours (N, 3) uint8 of vertices by the patches that hold them, ``patch`` (N, M), in the
    shares ``weight`` (N, M): a hue for each patch, blended where they overlap.
    """
    hue = np.arange(patch.max() + 1) * 0.618034 + 0.58  # far apart, however many there are
    own = np.array([colorsys.hsv_to_rgb(h % 1, 0.55, 0.88) for h in hue])
    return np.round(255 * np.einsum("nm,nmc->nc", weight, own[patch])).astype(np.uint8)


def range_of(values, signed=False):
    """(low, high) of a scale of colours for values (...), those that are not finite left out: from
    0 to what 99 % of them stay below; with ``signed`` as far to the other side, too.
    """
    known = np.isfinite(values)
    top = float(np.quantile(np.abs(values[known]), 0.99) if known.any() else 1) or 1.0
    return (-top if signed else 0.0), top


def _light(normals, look):
    """Light on unit normals (N, 3) of the view's frame: (N,)."""
    key, fill = (np.asarray(d) / np.linalg.norm(d) for d in (look.key, look.fill))
    return 0.10 + 0.95 * np.maximum(normals @ key, 0) + 0.20 * np.maximum(normals @ fill, 0)


def _covered_pixels(corners, width, height):
    """All pixels whose centres lie in the triangles ``corners`` (F, 3, 2) [pixels]: triangle, x, y,
    each (P,).

    Row by row: the two edges that cross a row's centre line bound the triangle's pixels in that
    row.
    """
    low, high = corners[:, :, 1].min(axis=1), corners[:, :, 1].max(axis=1)
    triangle, y = _ranges(np.ceil(low - 0.5), np.ceil(high - 0.5), height)
    left, right = np.full(len(triangle), np.inf), np.full(len(triangle), -np.inf)
    for k in range(3):
        a, b = corners[triangle, k], corners[triangle, (k + 1) % 3]
        swap = (a[:, 1] > b[:, 1])[
            :, None
        ]  # so that two triangles find the same crossing of a common edge
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        crosses = (a[:, 1] <= y + 0.5) & (y + 0.5 < b[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = a[:, 0] + (y + 0.5 - a[:, 1]) * ((b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1]))
        left, right = (
            np.where(crosses, np.minimum(left, x), left),
            np.where(crosses, np.maximum(right, x), right),
        )
    row, x = _ranges(np.ceil(left - 0.5), np.ceil(right - 0.5), width)
    return triangle[row], x, y[row]


def _ranges(start, stop, limit):
    """The whole numbers from start to stop - 1, within 0 to limit - 1, for each pair: (index of the
    pair, number).
    """
    start = np.clip(start, 0, limit).astype(
        np.int32
    )  # half the memory of what NumPy would take, and so half the time
    count = np.maximum(np.clip(stop, 0, limit).astype(np.int32) - start, 0)
    index = np.repeat(np.arange(len(count), dtype=np.int32), count)
    return index, np.arange(len(index), dtype=np.int32) - np.repeat(
        np.cumsum(count, dtype=np.int32) - count - start, count
    )
