"""Where the photo lies in each frame, as a smooth map from places of the photo to pixels.

Colours alone do not tell where a sheet ends whose print has the background's colour there. But the
print inside tells where its border must be. The map is a polynomial; in every frame it is carried
along by the optical flow, then corrected by the flow between the photo and the frame as the map
unrolls it. Nothing drifts, because the photo stays the reference.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial import chebyshev


@dataclass(frozen=True)
class RegistrationSettings:
    """How the photo is registered.

    - ``order`` of the polynomial; ``passes`` of correction in a frame.
    - ``side`` [pixels]: the photo's longer side at most. It is shrunk to the size at which it is
      seen.
    - ``window`` [pixels]: standard deviation of the window of local means.
    - ``prior_weight``: of the map's deviation, against a pixel of the photo.
    - ``cell`` [pixels]: side of the photo's cells that are compared with the frame.
    - ``max_colour_difference``: largest difference of a cell's colour (0 to 1).
    - ``min_correlation``: least correlation of photo and frame at which the map is used.
    """

    order: int = 6
    passes: int = 2
    side: int = 320
    window: float = 5.0
    prior_weight: float = 1e-3
    cell: int = 4
    max_colour_difference: float = 0.08
    min_correlation: float = 0.6


class Registration:
    """The map for one sheet; ``first(image)``, then ``next(image)`` for each frame, tell which part
    of the frame shows the sheet.
    """

    def __init__(self, photo, uv, faces, pixels, settings=None):
        """``photo`` (H, W, 3) uint8; ``uv`` (N, 2) of the template's vertices, v up; ``faces``
        (F, 3); ``pixels`` (N, 2): where the vertices are seen in the first frame.
        """
        from .grabcut import silhouette

        s = self._settings = settings or RegistrationSettings()
        at = np.column_stack([uv[:, 0], 1 - uv[:, 1]])  # y down, as in images
        self._low, self._extent = at.min(0), np.ptp(at, axis=0)
        seen = np.ptp(pixels, axis=0).max() / max(self._extent.max(), 1e-9)  # pixels a unit of uv
        scale = np.clip(seen, 8 * s.cell, s.side) / max(photo.shape[:2])
        width, height = (
            max(2 * s.cell, round(n * scale / s.cell) * s.cell) for n in photo.shape[1::-1]
        )
        self._photo = cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)
        self._plain = _plain(self._photo, s.window)
        self._powers = np.array([(i, n - i) for n in range(s.order + 1) for i in range(n + 1)])
        size, count = np.array([width, height]), np.array([width, height]) // s.cell
        # of x and of y: at the middle of each pixel, at the middle of each cell, between cells
        self._pixels, self._middles, self._corners = (
            [self._axis((k + shift) / n, axis) for axis, (k, n) in enumerate(zip(places, total))]
            for places, shift, total in (
                ([np.arange(n) for n in size], 0.5, size),
                ([np.arange(n) for n in count], 0.5, count),
                ([np.arange(n + 1) for n in count], 0.0, count),
            )
        )
        i, j = self._powers.T
        a, b = self._middles
        self._basis = (b[:, None, j] * a[None, :, i]).reshape(-1, len(i))
        covered = silhouette(at * (width, height), faces, (width, height)) > 0
        self._covered = covered
        self._whole = _cells(covered.astype(np.float32), s.cell) > 0.99
        vertices = self._axis(at[:, 0], 0)[:, i] * self._axis(at[:, 1], 1)[:, j]
        self._map = np.linalg.lstsq(vertices, pixels, rcond=None)[0]  # (K, 2)
        self._flow = cv2.DISOpticalFlow_create(cv2.DISOpticalFlow_PRESET_MEDIUM)
        self._between = cv2.DISOpticalFlow_create(cv2.DISOpticalFlow_PRESET_FAST)
        self._grey = None

    def first(self, image):
        """The part of the first frame (H, W, 3) uint8 that shows the sheet as the photo has it:
        (H, W) bool; None where the map is not believed.
        """
        self._grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return self._corrected(image)

    def next(self, image):
        """Likewise for each frame after it."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        flow = self._between.calc(self._grey, grey, None)
        self._grey = grey
        x = self._places()
        moved, inside = _sampled(flow, x), _inside(x, image)
        self._fit(moved, self._covered & inside)
        return self._corrected(image)

    def _corrected(self, image):
        s = self._settings
        for k in range(s.passes + 1):
            x = self._places()
            unrolled = _sampled(image, x)
            plain = _plain(unrolled, s.window)
            flow = self._flow.calc(self._plain, plain, None)
            alike = _correlation(self._plain, _sampled(plain, _grid(flow) + flow), s.window)
            weight = np.clip(alike, 0, 1) ** 2 * (self._covered & _inside(x, image))
            if k < s.passes:
                by_x, by_y = np.gradient(x, axis=1), np.gradient(x, axis=0)
                self._fit(by_x * flow[..., :1] + by_y * flow[..., 1:], weight)
        used = self._covered & _inside(x, image)
        if not used.any() or alike[used].mean() < s.min_correlation:
            return None
        return self._shown(unrolled, used & (alike > 0.5), image.shape[:2])

    def _shown(self, unrolled, sure, size):
        """The cells whose colour is the photo's, drawn where the map has them."""
        s = self._settings
        photo, seen = (_cells(a.astype(np.float32) / 255, s.cell) for a in (self._photo, unrolled))
        kept = _cells(sure.astype(np.float32), s.cell) > 0.5
        if not kept.any():
            return None
        gain = (photo * seen)[kept].sum(0) / np.maximum((photo**2)[kept].sum(0), 1e-9)
        same = np.abs(seen - gain * photo).mean(-1) < s.max_colour_difference
        x = self._places(self._corners)
        quads = np.stack([x[:-1, :-1], x[:-1, 1:], x[1:, 1:], x[1:, :-1]], axis=2)
        a, b = quads[..., 2, :] - quads[..., 0, :], quads[..., 3, :] - quads[..., 1, :]
        turn = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        facing = np.sign(turn) == np.sign(np.median(turn))
        # drawn finer: OpenCV fills every pixel that a polygon touches
        fine, shift = 4, 4  # and the binary places of its fixed point
        mask = np.zeros((fine * size[0], fine * size[1]), np.uint8)
        corners = (fine * np.clip(quads, -1e3, 1e4) - 0.5) * 2**shift
        for quad in np.round(corners).astype(np.int32)[same & facing & self._whole]:
            cv2.fillConvexPoly(mask, quad, 255, cv2.LINE_8, shift)
        return cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA) > 127

    def _places(self, axes=None):
        """The pixels (h, w, 2) of the frame where the photo's pixels are, or a grid of others."""
        a, b = axes or self._pixels
        order = self._settings.order
        table = np.zeros((order + 1, order + 1, 2))
        table[tuple(self._powers.T)] = self._map
        return np.stack([b @ (a @ table[..., k]).T for k in (0, 1)], axis=-1)

    def _fit(self, change, weight):
        """Change the map by (h, w, 2) [pixels], as well as a polynomial can, by weights (h, w)."""
        weight = weight.astype(np.float64)
        w = _cells(weight, self._settings.cell).ravel()
        if w.sum() < 1:
            return
        mean = _cells(weight[..., None] * change, self._settings.cell).reshape(-1, 2)
        held = self._settings.prior_weight * w.sum() * np.diag(1.0 + self._powers.sum(1) ** 2)
        normal = self._basis.T @ (w[:, None] * self._basis)
        self._map += np.linalg.solve(normal + held, self._basis.T @ mean)

    def _axis(self, at, axis):
        """Chebyshev polynomials (M, order + 1) of one coordinate of places (M,), y down."""
        x = 2 * (at - self._low[axis]) / max(self._extent[axis], 1e-9) - 1
        return chebyshev.chebvander(x, self._settings.order)


def _plain(image, window):
    """Grey (h, w) uint8 without local mean and contrast."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.GaussianBlur(grey, (0, 0), window)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(grey**2, (0, 0), window) - mean**2, 0) + 16)
    return np.clip(128 + 48 * (grey - mean) / spread, 0, 255).astype(np.uint8)


def _correlation(a, b, window):
    """Local correlation (h, w) of two grey images whose local means are gone."""
    a, b = (x.astype(np.float32) - 128 for x in (a, b))
    power = lambda x, y: cv2.GaussianBlur(x * y, (0, 0), window)
    return power(a, b) / np.sqrt(np.maximum(power(a, a) * power(b, b), 1.0))


def _grid(flow):
    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]]
    return np.stack([x, y], -1) + 0.5


def _sampled(image, x):
    """An image at pixels (h, w, 2), the border repeated beyond it."""
    x = np.float32(x - 0.5)
    return cv2.remap(image, x[..., 0], x[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _inside(x, image):
    return ((x > 0) & (x < image.shape[1::-1])).all(axis=-1)


def _cells(image, side):
    """Means over cells of side x side pixels."""
    size = image.shape[1] // side, image.shape[0] // side
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
