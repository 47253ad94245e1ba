"""The part of an image that matters. Import only after a Mitsuba variant is set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

_STEP = 64  # pixels: sizes are multiples of it, for kernels are made for a size


@dataclass(frozen=True)
class Crop:
    """The pixels (x, y) to (x + width, y + height), exclusive, of an image. Some may lie beyond the
    image, where there is nothing: zeros.
    """

    x: int
    y: int
    width: int
    height: int

    @classmethod
    def around(
        cls,
        boxes: Sequence[tuple[float, float, float, float]],
        margin: int,
        size: tuple[int, int],
        grid: int = 1,
    ) -> Crop:
        """What holds all ``boxes`` (x, y, x, y) [pixels] and a ``margin`` around them, as far as
        they lie in an image of ``size`` (width, height); it begins at a multiple of ``grid``.
        """
        low, high = np.min(boxes, axis=0)[:2] - margin, np.max(boxes, axis=0)[2:] + margin
        x, width = _span(low[0], high[0], size[0], grid)
        y, height = _span(low[1], high[1], size[1], grid)
        return cls(x, y, width, height)

    def cut(self, image: mi.TensorXf, first: int = 0, last: int | None = None) -> mi.TensorXf:
        """The part (height, width, C) of an image (H, W, C'), attached to it, of its channels
        ``first`` to ``last``, exclusive.
        """
        rows, columns, channels = image.shape
        count = (channels if last is None else last) - first
        index = dr.arange(mi.UInt32, self.width * self.height * count)
        pixel = index // count
        row = pixel // self.width
        # opaque: a crop that moves needs no other kernel
        x = mi.Int32(pixel - row * self.width) + dr.opaque(mi.Int32, self.x)
        y = mi.Int32(row) + dr.opaque(mi.Int32, self.y)
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        at = mi.UInt32(y * columns + x) * channels + first + (index - pixel * count)
        values = dr.gather(mi.Float, image.array, at, inside, mode=dr.ReduceMode.Permute)
        return mi.TensorXf(values, (self.height, self.width, count))


def _span(low, high, size, grid):
    """(begin, length) along an axis of the image, ``size`` pixels long."""
    low, high = max(low, 0), min(high, size)
    begin = grid * math.floor(min(low, size) / grid)
    length = _STEP * max(1, math.ceil((high - begin) / _STEP))
    return (begin, length) if length < size else (0, size)
