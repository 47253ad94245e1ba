"""The picture of a frame in a run's comparison video: its columns, and how they are read back."""

import os

import numpy as np

from polysft_mi.errors import InputError

from .video import read_video

COLUMNS = ("target", "render", "error", "surface")
PEAK = 0.25  # the error that is white in the pictures of a run


def spread(count, limit):
    """At most ``limit`` of ``count`` indices, spread evenly, first and last among them."""
    if limit >= count:
        return list(range(count))
    if limit <= 0:
        return []
    return sorted(set(np.linspace(0, count - 1, limit).round().astype(int).tolist()))


def panels(run):
    """For each frame of a :class:`~polysft_mi.results.run.Run` in turn the pictures of the
    comparison video: target, rendering and error, each (h, w, 3) uint8 RGB.

    The error picture runs from black (0) through red and yellow to white (:data:`PEAK`); the sum of
    its channels is proportional to the error. Raises InputError where the pictures are not there,
    or not as many as the frames.
    """
    count = 0
    for picture in _pictures(run):
        width = picture.shape[1] // len(COLUMNS)
        yield tuple(picture[:, k * width : (k + 1) * width].copy() for k in range(3))
        count += 1
    if count != len(run.frames):
        raise InputError(
            f"{run.path('comparison.mp4')}: shows {count} frames; the run has {len(run.frames)}"
        )


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
