"""Levels of an image: blurred, freed from lighting by local normalisation, on a coarser grid; of
the video's frames and of the template's texture alike. NumPy and OpenCV only."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

POOL = 4  # local statistics are taken on an image this many times smaller
MAX_CONTOUR_DISTANCE = 30.0  # pixels of the grid beyond which a silhouette is pulled no harder
#: linear, of 1; added to the local deviation, as squares: no flat area is blown up to the rest
FLOOR = 0.02


@dataclass(frozen=True)
class Level:
    """How images are compared: blurred by ``sigma``, freed from lighting under a window of
    ``window`` (standard deviations, pixels of the video), on a grid of every ``stride``-th pixel;
    what deviates from its surroundings by less than :data:`FLOOR` says little."""

    sigma: float
    stride: int = 1
    window: float = 8.0


@dataclass
class LevelImage:
    """A frame at a level: ``colour`` (h, w, 3) float32; ``inside`` (h, w), 1 where the sheet may be
    compared; with a mask, ``mask`` (h, w) in [0, 1], and ``distance`` (h, w), pixels of this grid
    from the mask's contour, of either side. ``corner`` (x, y) [pixels of this grid]: where these
    arrays begin; with a mask they end where it does, and everything that it takes part in: what
    lies beyond is not of the sheet, and farther than ``MAX_CONTOUR_DISTANCE`` from the contour."""

    colour: np.ndarray
    inside: np.ndarray
    mask: np.ndarray | None = None
    distance: np.ndarray | None = None
    corner: tuple = (0, 0)


def level_image(image, mask, level, normalise=True):
    """A frame (H, W, 3), linear, with its mask (H, W) or None, at a :class:`Level`."""
    (y, x), near = _slices_around(mask, level)
    image, mask = image[near], mask[near] if mask is not None else None
    colour = compared(image, mask, level.sigma, level.window, normalise)
    inside = (
        np.ones(image.shape[:2], np.float32) if mask is None else (mask > 0.5).astype(np.float32)
    )
    if level.stride > 1:
        colour, inside = shrink(colour, level.stride), shrink(inside, level.stride)
        inside = (inside > 0.5).astype(np.float32)
    if mask is None:
        return LevelImage(colour, inside)
    small = shrink(mask, level.stride)
    on = (small > 0.5).astype(np.uint8)
    distance = sum(cv2.distanceTransform(x, cv2.DIST_L2, 3) for x in (on, 1 - on))
    return LevelImage(colour, inside, small, distance, (x // level.stride, y // level.stride))


def _slices_around(mask, level):
    """(y, x) where the part of an image begins that a mask (H, W) has a say in at a level, and its
    slices: everything without a mask.
    """
    rows, columns = (
        (np.flatnonzero(mask.any(axis=k)) for k in (1, 0)) if mask is not None else ((), ())
    )
    if len(rows) == 0:
        return (0, 0), (slice(None), slice(None))
    margin = int(max((MAX_CONTOUR_DISTANCE + 2) * level.stride, 4 * level.sigma, 4 * level.window))
    step = math.lcm(level.stride, POOL)  # so that the grids of the part are those of the whole
    at = [
        (max(0, int(x[0]) - margin) // step * step, (int(x[-1]) + margin) // step * step + step)
        for x in (rows, columns)
    ]
    return (at[0][0], at[1][0]), tuple(slice(*x) for x in at)


def compared(image, weight, sigma, window, normalise):
    """The image as it is compared: blurred by ``sigma`` and, with ``normalise``, freed from
    lighting under ``window`` [pixels]; only what is inside ``weight`` (H, W) counts."""
    image = blur(image, sigma, weight)
    return normalised(image, window, weight) if normalise else image


def blur(image, sigma, weight=None):
    """Gaussian blur of (H, W, C) or (H, W), standard deviation ``sigma`` [pixels]; with ``weight``
    (H, W), only of what is inside.
    """
    if sigma <= 0:
        return image
    if weight is None:
        return _gaussian(image, sigma)
    across = (...,) + (None,) * (image.ndim - 2)  # the channels, where there are any
    return (
        _gaussian(image * weight[across], sigma)
        / np.maximum(_gaussian(weight, sigma), 1e-3)[across]
    )


def normalised(image, sigma, weight=None):
    """(H, W, C) less its local mean, over its local standard deviation (one for all channels) and
    :data:`FLOOR`, under a window of ``sigma`` [pixels].
    """
    height, width = image.shape[:2]
    mean, variance = _local(image, sigma, weight)
    scale = 1 / np.sqrt(variance + FLOOR**2)
    both = cv2.resize(
        np.concatenate([mean * scale[..., None], scale[..., None]], -1),
        (width, height),
        interpolation=cv2.INTER_LINEAR,
    )
    return image * both[..., 3:] - both[..., :3]


def _local(image, sigma, weight):
    """Mean (h, w, C) and variance (h, w), one for all channels, under a window of ``sigma``
    [pixels] of an image (H, W, C), on a smaller grid.
    """
    pool = int(min(POOL, max(1, sigma // 2)))
    height, width = image.shape[:2]
    small = (max(1, width // pool), max(1, height // pool))

    def local(x):
        return _gaussian(cv2.resize(x, small, interpolation=cv2.INTER_AREA), sigma / pool)

    w = np.ones((height, width), np.float32) if weight is None else weight
    share = np.maximum(local(w), 1e-3)
    weighted = image if weight is None else image * w[..., None]
    mean = local(weighted) / share[..., None]
    power = local(np.einsum("hwc,hwc->hw", weighted, image) / image.shape[2]) / share
    return mean, np.maximum(power - (mean * mean).mean(-1), 0)


def _gaussian(image, sigma):
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)


def shrink(image, stride):
    """Means of blocks of stride x stride pixels; what is left over at the right and below is
    dropped.
    """
    if stride == 1:
        return image
    height, width = image.shape[0] // stride, image.shape[1] // stride
    return cv2.resize(
        image[: height * stride, : width * stride], (width, height), interpolation=cv2.INTER_AREA
    )
