"""A shaded picture of a surface from a viewpoint of one's choice, in NumPy alone."""

from dataclasses import dataclass

import numpy as np

from .metrics import vertex_normals

_BACKGROUND = 0.90  # linear
_FRONT, _BACK = (0.80, 0.56, 0.33), (0.30, 0.47, 0.66)  # linear albedo of the two sides
_KEY, _FILL = (-0.80, -0.50, -0.45), (0.60, -0.20, -0.80)  # towards the lights, in the view's frame
_SUPERSAMPLE = 2


@dataclass(frozen=True)
class View:
    """An orthographic view: rows of ``rotation`` (3, 3) are the picture's right, down and forward in the camera frame.

    ``centre`` (3,) [m] lies in the middle of the picture and ``radius`` [m] reaches from it to the nearer pair of borders.
    """

    rotation: np.ndarray
    centre: np.ndarray
    radius: float

    @classmethod
    def around(cls, points, azimuth=40.0, elevation=25.0):
        """The view of points (..., 3) [m] after the camera went round them by ``azimuth`` to its right and ``elevation`` up [degrees].

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


def shade_surface(vertices, faces, view=None, uv=None, size=(480, 480)):
    """A matte picture (height, width, 3) uint8 sRGB of a mesh: vertices (N, 3) [m], faces (F, 3), ``size`` = (width, height).

    Lambert shading with smooth normals under a key light from the left and a weak fill, warm on the side from which the
    triangles' normals point to the viewer, cool on the other. With ``uv`` (N, 2) a thin grid of ten by ten cells is drawn.
    """
    V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    view = View.around(V) if view is None else view
    width, height = (s * _SUPERSAMPLE for s in size)
    seen = (V - view.centre) @ view.rotation.T
    scale = 0.5 * min(width, height) / view.radius
    xy = seen[:, :2] * scale + (width / 2, height / 2)
    pixel, triangle, weight = _cover(xy[F], seen[F][:, :, 2], width, height)
    image = np.full((height * width, 3), _BACKGROUND)
    corners = F[triangle]
    normal = np.einsum("pk,pkj->pj", weight, (vertex_normals(V, F) @ view.rotation.T)[corners])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    flat = np.cross(seen[F[:, 1]] - seen[F[:, 0]], seen[F[:, 2]] - seen[F[:, 0]])[triangle]
    away = flat[:, 2] > 0  # the triangle's own normal points away from the viewer
    normal[away] *= -1
    albedo = np.where(away[:, None], _BACK, _FRONT)
    if uv is not None:
        albedo = albedo * _grid(np.asarray(uv, dtype=np.float64), F, triangle, weight)[:, None]
    light = 0.10 + 0.95 * _lambert(normal, _KEY) + 0.20 * _lambert(normal, _FILL)
    image[pixel] = albedo * light[:, None]
    image = image.reshape(size[1], _SUPERSAMPLE, size[0], _SUPERSAMPLE, 3).mean(axis=(1, 3))
    return (255 * _srgb(image) + 0.5).astype(np.uint8)


def _lambert(normal, direction):
    direction = np.asarray(direction) / np.linalg.norm(direction)
    return np.maximum(normal @ direction, 0)


def _grid(uv, F, triangle, weight):
    """1 in the cells of a 10 x 10 grid, darker on its lines: (P,)."""
    span = np.maximum(np.ptp(uv, axis=0), 1e-12)
    at = np.einsum("pk,pkj->pj", weight, ((uv - uv.min(axis=0)) / span * 10)[F[triangle]])
    distance = np.abs(at - np.round(at)).min(axis=1)
    return 1 - 0.3 * np.clip(2 - distance / 0.03, 0, 1)


def _srgb(x):
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def _cover(corners, depth, width, height):
    """The nearest triangle at each covered pixel: (pixel (P,), triangle (P,), barycentric weights (P, 3)).

    ``corners`` (F, 3, 2) [pixels], ``depth`` (F, 3). All pixels of all bounding boxes are tried at once.
    """
    low = np.clip(np.ceil(corners.min(axis=1) - 0.5), 0, (width, height)).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) - 0.5) + 1, 0, (width, height)).astype(np.int64)
    columns, rows = np.maximum(high - low, 0).T
    count = columns * rows
    triangle = np.repeat(np.arange(len(corners)), count)
    rank = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    x = low[triangle, 0] + rank % columns[triangle]
    y = low[triangle, 1] + rank // columns[triangle]
    a, b, c = (corners[triangle, k] for k in range(3))
    area = _cross(b - a, c - a)
    point = np.stack([x, y], axis=1) + 0.5
    with np.errstate(divide="ignore", invalid="ignore"):
        w1, w2 = _cross(point - a, c - a) / area, _cross(b - a, point - a) / area
    weight = np.stack([1 - w1 - w2, w1, w2], axis=1)
    keep = np.flatnonzero((weight >= -1e-9).all(axis=1))  # False for NaN, the triangles seen edge-on
    triangle, weight, pixel = triangle[keep], weight[keep], (y * width + x)[keep]
    order = np.lexsort((np.sum(weight * depth[triangle], axis=1), pixel))
    nearest = order[np.concatenate([[True], np.diff(pixel[order]) > 0])] if len(order) else order
    return pixel[nearest], triangle[nearest], weight[nearest]


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
