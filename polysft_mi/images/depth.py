"""Depth images against a surface: sums over the pixels that see each triangle, in closed form.
Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.render import frozen

from . import pixels

_CACHED = 8
_ROUNDS = 10  # of the weighted fit of a scale and a shift
_FEWEST, _MOST = 100, 20000  # pixels that it is made of
_ALIKE = 0.5  # least correlation of a surface's depths with an image that is fitted to it


@dataclass(frozen=True)
class DepthNoise:
    """What a residual is weighed by, at the depth z [m]: its standard deviation, ``fixed`` [m] and
    ``share`` of z; and ``turn``, of the standard deviation, and ``spread`` of z, where the norm
    turns robust (both together, their squares added).
    """

    fixed: float
    share: float
    turn: float
    spread: float

    def sigma(self, z):
        """Standard deviation [m] at a depth [m]."""
        return self.fixed + self.share * z

    def squared_scale(self, z):
        """Where the norm turns robust [m], squared."""
        return (self.turn * self.sigma(z)) ** 2 + (self.spread * z) ** 2


class DepthData:
    """The depth images of a ``sequence`` (:class:`polysft_mi.scene.sequence.Sequence`) against
    surfaces that ``data`` (:class:`polysft_mi.images.data_term.DataTerm`) finds in the image.

    Vertices are (N, 3) [m, world]; a ``level`` (:class:`polysft_mi.images.pyramid.Level`) has the
    grid.
    """

    def __init__(self, data, sequence):
        self._data, self._sequence, self.known_to = data, sequence, sequence.depth.known_to
        self._sums = frozen(_sums)
        self._grids: OrderedDict = OrderedDict()

    def sums(self, vertices, frame, level, noise, fit=(1.0, 0.0)):
        """The sum over the video's pixels of c^2 / s^2 log(1 + r^2 / c^2), r the depth of the
        surface less that of the image under the scale and shift ``fit``; s and c by the
        :class:`DepthNoise` ``noise``. Its gradient (F, 3, 3) [1/m] by the corners, and
        Gauss-Newton's curvature (F, 3, 3, 3, 3) [1/m^2], corner by corner by axis by axis.
        """
        data = self._data
        with dr.suspend_grad():
            seen = data.view(vertices, level).seen()
            numbers = [*fit, noise.fixed, noise.share, noise.turn, noise.spread]
            is_inverse = float(self.known_to == "disparity")
            numbers = [dr.opaque(mi.Float, x) for x in (*numbers, is_inverse)]
            table, figures = self._sums(seen, data.sheet, self._image(frame, level), numbers)
        table = np.array(table, dtype=np.float64).reshape(-1, pixels.CURVATURES + pixels.SLOPES)
        energy = np.array(figures, dtype=np.float64).reshape(-1, pixels.FIGURES)[:, 0].sum()
        pixel = level.stride**2
        pairs = np.empty((len(table), 3, 3))
        for k, (a, b) in enumerate(pixels.CORNERS):
            pairs[:, a, b] = pairs[:, b, a] = table[:, 3 * k]
        normal = _normals(vertices, data.faces)
        form = normal[:, :, None] * normal[:, None]
        curvature = pixel * pairs[..., None, None] * form[:, None, None]
        gradient = pixel * table[:, pixels.CURVATURES :].reshape(-1, 3, 3)
        return pixel * float(energy), gradient, curvature

    def residuals(self, vertices, frame, level, fit=(1.0, 0.0)):
        """(residuals, depths of the surface) (h, w) [m] of the part of a grid where the surface is;
        NaN where nothing is compared.
        """
        z, known = self._depths(vertices, frame, level)
        return z - self._metric(known, fit), z

    def fitted(self, vertices, frame, level):
        """(scale, shift) by which the depth image comes closest to a surface, 1 and 0 of one in
        metres; None where it does not tell, for too few pixels are compared, or its numbers hardly
        go along with the surface's depths.

        The image is what errs: so its numbers are fitted by the surface's depths (or their
        inverses), robustly, and that is turned around.
        """
        if self.known_to == "metric":
            return 1.0, 0.0
        z, known = (x.ravel() for x in self._depths(vertices, frame, level))
        z, known = z[np.isfinite(z)], known[np.isfinite(z)]
        step = max(1, len(z) // _MOST)
        x, known = z[::step], known[::step]
        if len(x) < _FEWEST:
            return None
        x = 1 / x if self.known_to == "disparity" else x
        weight = np.ones(len(x))
        for _ in range(_ROUNDS):
            share = weight / weight.sum()
            mean_x, mean = share @ x, share @ known
            across, spread_x = share @ ((x - mean_x) * (known - mean)), share @ (x - mean_x) ** 2
            slope = across / max(spread_x, 1e-30)
            residual = known - mean - slope * (x - mean_x)
            usual = max(1.4826 * np.median(np.abs(residual)), 1e-12)
            weight = 1 / (1 + (residual / (2.5 * usual)) ** 2)
        alike = across / max(np.sqrt(spread_x * (share @ (known - mean) ** 2)), 1e-30)
        if alike < _ALIKE:
            return None
        return float(1 / slope), float(mean_x - mean / slope)

    def attached(self, points, vertices, frame, level, fit=(1.0, 0.0)):
        """Depths [m] of a surface and of the image, Float64 of P, the first attached, of the pixels
        that are compared; ``points`` (Point3f of N), attached, are the ``vertices``. Which triangle
        a pixel sees is detached.
        """
        view, data = self._data.view(vertices, level), self._data
        triangle = np.array(view.triangle)
        known = self._known(view, frame, level)
        chosen = np.flatnonzero((triangle >= 0) & (known > 0))
        flat = mi.Float64(dr.ravel(points))
        corners = (on_device(data.faces[triangle[chosen], k], mi.UInt32) for k in range(3))
        a, b, c = (dr.gather(mi.Point3d, flat, k) for k in corners)
        direction = self._directions(view, level)[chosen]
        d = mi.Vector3d(np.ascontiguousarray(direction.T))
        normal = dr.cross(b - a, c - a)
        z = dr.dot(normal, a - mi.Point3d(data.camera.origin)) / dr.dot(normal, d)
        return z, mi.Float64(self._metric(known[chosen], fit))

    def _depths(self, vertices, frame, level):
        """(depths of the surface [m], numbers of the image), (h, w) each; the first NaN where
        nothing is compared.
        """
        with dr.suspend_grad():
            view = self._data.view(vertices, level)
            triangle, z = np.array(view.triangle), np.array(view.depth, dtype=np.float64)
        known, shape = self._known(view, frame, level), view.size[::-1]
        z = np.where((triangle >= 0) & (known > 0), z, np.nan)
        return z.reshape(shape), known.reshape(shape)

    def _metric(self, known, fit):
        value = fit[0] * known + fit[1]
        return 1 / np.maximum(value, 1e-6) if self.known_to == "disparity" else value

    def _known(self, view, frame, level):
        """The image's numbers at the pixels of a view, (w h,), 0 where there is none."""
        (x, y), (w, h) = (int(view.region[k][0]) for k in (0, 1)), view.size
        return self._grid(frame, level)[y : y + h, x : x + w].ravel().astype(np.float64)

    def _directions(self, view, level):
        """(w h, 3): directions of the rays of a view's pixels, of depth 1."""
        (x, y), (w, h) = (int(view.region[k][0]) for k in (0, 1)), view.size
        px, py = np.meshgrid(np.arange(x, x + w) + 0.5, np.arange(y, y + h) + 0.5)
        at = np.stack([px.ravel(), py.ravel(), np.full(w * h, 1 / level.stride)], 1) * level.stride
        return at @ self._data.camera.basis.T

    def _grid(self, frame, level):
        """The image at the centres of a grid's pixels (h, w) float32, 0 where nothing is known or
        the mask has nothing.
        """
        return self._cached(frame, level)[0]

    def _image(self, frame, level):
        """The same on the device, a :class:`polysft_mi.images.pixels.Image`."""
        return self._cached(frame, level)[1]

    def _cached(self, frame, level):
        key = frame, level.stride
        if key not in self._grids:
            width, height = self._data.camera.width, self._data.camera.height
            x, y = (
                (np.arange(-(-size // level.stride)) + 0.5) * level.stride
                for size in (width, height)
            )
            depth = self._sequence.depth.like_frames(frame, (width, height))
            grid = _nearest(depth, x / width, y / height)
            mask = self._sequence.mask(frame)
            if mask is not None:
                grid = np.where(_nearest(mask, x / width, y / height) > 0.5, grid, 0)
            grid = np.ascontiguousarray(grid, dtype=np.float32)
            image = pixels.Image.of(on_device(grid, mi.Float), grid.shape)
            self._grids[key] = grid, image
            while len(self._grids) > _CACHED:
                self._grids.popitem(last=False)
        return self._grids[key]


def _nearest(image, x, y):
    """An image (H, W) at the places (x, y), shares of its width and height."""
    h, w = image.shape[:2]
    rows = np.minimum((y * h).astype(int), h - 1)
    columns = np.minimum((x * w).astype(int), w - 1)
    return image[rows[:, None], columns]


def _normals(vertices, faces):
    """Unit normals (F, 3), 0 of a triangle without area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def _sums(seen, sheet, depth, numbers):
    """Sums over the pixels that see each triangle, as
    :func:`polysft_mi.images.pixels.by_triangle` returns them: the curvature's share of each pair
    of corners, without the normal's outer product, in place of its xx; slopes in space; and the
    energy.

    ``depth``: an :class:`polysft_mi.images.pixels.Image`, 0 where nothing is known; ``numbers``,
    Float each: scale, shift, the four of :class:`DepthNoise`, and 1 where the image has inverses.
    """
    scale, shift, fixed, share, turn, spread, is_inverse = numbers
    hit, found = seen.hit, pixels.ray_hits(seen, sheet)
    _, length = seen.rays()
    x, y = pixels.pixel_coordinates(seen)
    pixel, inside = depth.at(x, y)
    number = dr.gather(mi.Float, depth.texels, pixel, hit & inside)
    value = scale * number + shift
    z = dr.select(is_inverse > 0, dr.rcp(dr.maximum(value, 1e-6)), value)
    known = hit & inside & (number > 0)
    sigma = fixed + share * seen.depth
    c2 = dr.square(turn * sigma) + dr.square(spread * seen.depth)
    residual = dr.select(known, seen.depth - z, 0)
    over = dr.square(residual) / c2
    heavy = dr.select(known, 2 / (dr.square(sigma) * (1 + over)), 0)
    normal = dr.normalize(dr.cross(found.e1, found.e2))
    by_normal = dr.rcp(dr.dot(normal, found.ray.d) * length)
    slope = heavy * residual * by_normal * normal
    energy = dr.select(known, c2 / dr.square(sigma) * dr.log(1 + over), 0)
    return pixels.by_triangle(
        seen,
        sheet,
        (
            mi.Vector4f(heavy * dr.square(by_normal), 0, 0, found.b1),
            mi.Vector4f(*slope, found.b2),
            mi.Vector4f(energy, dr.select(known, mi.Float(1), 0), 0, 0),
        ),
    )
