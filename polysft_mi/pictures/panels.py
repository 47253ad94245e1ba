"""The picture of a frame in a run's comparison video: its columns, what it is cropped to, and how
it is read back.
"""

import os
from typing import NamedTuple

import numpy as np

from polyfit.pictures import read_video
from polysft_mi.errors import InputError

COLUMNS = ("target", "render", "error", "residual", "surface")
# the value that is white in the pictures of a run: error in linear colour, residual in local
# standard deviations (of images that have nothing to do with each other it is 1.4 on average)
PEAKS = {"error": 0.25, "residual": 1.5}


class Box(NamedTuple):
    """A part of an image [pixels]: columns ``left`` to ``right`` - 1, rows ``top`` to
    ``bottom`` - 1.
    """

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def around(cls, points, margin, size):
        """The box of points (N, 2) [pixels], wider on each side by ``margin`` times its longer
        side, within an image of ``size`` (width, height); the whole image where none lies in it.
        """
        size = np.asarray(size)
        low, high = points.min(0), points.max(0)
        room = margin * max(high - low)
        low = np.clip(np.floor(low - room), 0, size).astype(int)
        high = np.clip(np.ceil(high + room), 0, size).astype(int)
        if (high <= low).any():
            return cls(0, 0, *map(int, size))
        return cls(*low.tolist(), *high.tolist())

    def union(self, other):
        """The smallest box that holds both."""
        return Box(*map(min, self[:2], other[:2]), *map(max, self[2:], other[2:]))

    def holds(self, other):
        return self.union(other) == self

    @property
    def size(self):
        """Width and height."""
        return self.right - self.left, self.bottom - self.top

    @property
    def slices(self):
        """What it takes of an array (H, W)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


def evenly_spaced(count, limit):
    """At most ``limit`` of ``count`` indices, spread evenly, first and last among them."""
    if limit >= count:
        return list(range(count))
    if limit <= 0:
        return []
    return sorted(set(np.linspace(0, count - 1, limit).round().astype(int).tolist()))


def heat(values, peak):
    """Values (H, W) in [0, peak] as a picture (H, W, 3) uint8: from black (0) through red and
    yellow to white (``peak``). The sum of the channels is proportional to the value.
    """
    x = np.clip(np.nan_to_num(values) / peak, 0, 1)[..., None]
    return np.round(255 * np.clip(x * 3 - np.array([0, 1, 2]), 0, 1)).astype(np.uint8)


def heat_values(picture, peak):
    """The values (H, W) float32 that :func:`heat` drew."""
    red, green, blue = (picture[..., c].astype(np.float32) for c in range(3))
    return (red + green + blue) * (peak / 765)  # a fifth of the time of a sum over the axis


def box_of(run):
    """The :class:`Box` that the pictures of a :class:`~polysft_mi.results.run.Run` show of the
    video. Raises InputError where its metrics.json does not tell.
    """
    try:
        return Box(*map(int, run.metrics["pictures"]["box"]))
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{run.path('metrics.json')}: holds no pictures.box, since an older version wrote it;"
            " run the scene again"
        ) from None


def panels(run):
    """For each frame of a :class:`~polysft_mi.results.run.Run` in turn the pictures of the
    comparison video but the last, each (h, w, 3) uint8 RGB, by their names in :data:`COLUMNS`.

    They show :func:`box_of` the frame. ``error`` and ``residual`` are pictures of :func:`heat`,
    white at :data:`PEAKS`. Raises InputError where the pictures are not there, or not as many as
    the frames.
    """
    count, box = 0, box_of(run)
    for picture in _pictures(run):
        width = picture.shape[1] // len(COLUMNS)
        picture = picture[: round(box.size[1] * width / box.size[0])]  # without the codec's padding
        parts = (picture[:, k * width : (k + 1) * width].copy() for k in range(len(COLUMNS) - 1))
        yield dict(zip(COLUMNS[:-1], parts, strict=True))
        count += 1
    if count != len(run.frames):
        raise InputError(
            f"{run.path('comparison.mp4')}: shows {count} frames; the run has {len(run.frames)}"
        )


def at_vertices(camera, vertices, values, box):
    """The values (N,) where each vertex is seen, in a picture (h, w) of what ``box`` shows of the
    image (a mean over 3x3 of its pixels); NaN outside it.
    """
    import cv2

    values = cv2.blur(values, (3, 3))
    before = vertices[:, 2] > 0
    x, y = ((camera.project(vertices) - box[:2]) * (values.shape[1] / box.size[0])).T
    inside = before & (x >= 0) & (y >= 0) & (x < values.shape[1]) & (y < values.shape[0])
    out = np.full(len(vertices), np.nan, np.float32)
    out[inside] = values[y[inside].astype(int), x[inside].astype(int)]
    return out


def residual_at_vertices(run):
    """The residual (T, N) where each vertex of a run is seen, NaN where it is not, from its
    pictures. Raises InputError where they, or the camera, are not there.
    """
    box, out = box_of(run), []
    for vertices, pictures in zip(run.vertices, panels(run)):
        values = heat_values(pictures["residual"], PEAKS["residual"])
        out.append(at_vertices(run.camera, vertices, values, box))
    return np.stack(out)


def _pictures(run):
    path = run.path("comparison.mp4")
    if os.path.isfile(path):
        yield from read_video(path)
        return
    names = [run.path("comparison", f"{k:03d}.png") for k in range(len(run.frames))]
    if not os.path.isfile(names[0]):
        raise InputError(
            f"{path}: no such file, nor numbered PNGs in {run.path('comparison')}; the run's"
            " pictures are needed"
        )
    import cv2

    for name in names:
        image = cv2.imread(name)
        if image is None:
            raise InputError(f"{name}: not a readable image")
        yield image[..., ::-1]
