"""The video's frames as the tracker compares them: read ahead, level by level, kept while needed.

Import only after a Mitsuba variant is set.
"""

import math
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.errors import BadFrame

from . import pixels
from .pyramid import level_image
from .texture import packed_image

_CACHED = 4  # frames a level


@dataclass
class Frame:
    """A frame at a level, on the device.

    ``image``: its colours, with the pixels' weights in the fourth channel. Where it has a mask:
    ``mask``, the ``distance`` to its contour, its ``area`` [pixels of the grid], and the sum of its
    ``squares``.
    """

    image: pixels.Image
    mask: pixels.Image | None = None
    distance: mi.Float | None = None
    area: float | None = None
    squares: float | None = None

    @classmethod
    def of(cls, level_image):
        """From a :class:`polysft_mi.images.pyramid.LevelImage`."""
        shape, corner, mask = level_image.inside.shape, level_image.corner, level_image.mask
        packed = packed_image(level_image.colour, level_image.inside)
        frame = cls(pixels.Image.of(packed, shape, corner))
        if mask is not None:
            frame.mask = pixels.Image.of(on_device(mask, mi.Float), shape, corner)
            frame.distance = on_device(level_image.distance, mi.Float)
            frame.area = max(1.0, float(mask.sum()))
            frame.squares = float((mask.astype(np.float64) ** 2).sum())
        return frame


class Frames:
    """Frames of a :class:`polysft_mi.scene.sequence.Sequence`, decoded by a second thread before
    they are asked for.
    """

    def __init__(self, sequence, normalise):
        self._count, self._normalise = len(sequence), normalise
        self._reader, self._kept = ThreadPoolExecutor(1), OrderedDict()
        # all levels are made of one decoding
        self._decoded = lru_cache(2)(lambda frame: (sequence.frame(frame), sequence.mask(frame)))

    def prefetch(self, frames, levels, triangles=None):
        """Read ``frames`` ahead at ``levels`` and, with
        :class:`polysft_mi.images.triangles.TriangleColours`, as these want them.
        """
        jobs = [(level, self._level_image, (level,)) for level in levels]
        if triangles is not None:
            jobs.append(("colours", self._colours, (triangles,)))
        for frame in frames:
            for key, read, arguments in jobs:
                if frame < self._count and (frame, key) not in self._kept:
                    self._kept[frame, key] = self._reader.submit(read, frame, *arguments)
        while len(self._kept) > _CACHED * max(1, len(jobs)):
            self._kept.popitem(last=False)

    def mask(self, frame):
        """The mask (H, W) of a frame, or None."""
        return self._decoded(frame)[1]

    def _level_image(self, frame, level):
        return level_image(*self._decoded(frame), level, self._normalise)

    def _colours(self, frame, triangles):
        return triangles.of_frame(*self._decoded(frame))

    def colours(self, frame, triangles):
        """What :meth:`polysft_mi.images.triangles.TriangleColours.of_frame` makes of a frame."""
        if (frame, "colours") not in self._kept:
            self.prefetch([frame], [], triangles)
        return self._kept[frame, "colours"].result()

    def level(self, frame, level):
        """A :class:`Frame` at a level. Raises BadFrame where it is not finite."""
        if (frame, level) not in self._kept:
            self.prefetch([frame], [level])
        entry = self._kept[frame, level]
        if not isinstance(entry, Frame):
            image = entry.result()
            if not np.isfinite(image.colour).all():
                raise BadFrame(frame, math.nan)
            entry = self._kept[frame, level] = Frame.of(image)
        return entry
