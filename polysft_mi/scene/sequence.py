"""The video: images, silhouettes where there are any, and what else is known of it, checked once at
the start and read one frame at a time.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from polyfit.backend import cores
from polyfit.colours import grey, linear
from polysft_mi.body import Carrier
from polysft_mi.errors import InputError

from .evidence import DepthImages, Tracks
from .images import check_upright, checked_size, finite, list_images, read_mask, read_pixels

_LEAST_AREA = 0.01  # of the first mask's area; what is smaller is no mask
# of the largest value: the most that a grey image's channels differ by, in 99 % of its pixels, as
# coding leaves it
_LEAST_COLOUR = 0.01


class Sequence:
    """The selected frames of a video; ``frame(i)`` and ``mask(i)`` count from 0 in the selection,
    ``len()`` is its length.

    ``files``, ``mask_files``: paths (``mask_files`` is None without masks); ``indices``: for each
    selected frame its index in the sorted list of all images; ``size``: (width, height) [pixels];
    ``tracks``, ``depth``: what is known beside the images, or None; ``cameras``: others than the
    scene's own (:class:`polysft_mi.scene.cameras.OtherCamera`); ``count``: of all images;
    ``carrier``: what carries the template with a body
    (:class:`polysft_mi.body.carrier.Carrier`), or None; ``unmasked``: frames whose mask is empty,
    or nearly; ``grey``: whether frames are taken without their colours, which is so where the first
    one, or that of another camera, has none.
    """

    tracks: Tracks | None = None
    depth: DepthImages | None = None
    cameras: Iterable[Any] = ()
    carrier: Carrier | None = None
    count: int = 0
    unmasked: frozenset[int] = frozenset()
    grey: bool = False

    def __init__(
        self,
        files: list[str],
        mask_files: list[str] | None,
        indices: list[int],
        size: tuple[int, int],
        drop_stray: bool,
    ) -> None:
        self.files, self.mask_files, self.indices, self.size = files, mask_files, indices, size
        self._drop_stray = drop_stray

    @classmethod
    def open(
        cls,
        frames: str,
        masks: str = "",
        first: int = 0,
        last: int = -1,
        stride: int = 1,
        size: tuple[int, int] | None = None,
        drop_stray: bool = True,
        tracks: str = "",
        track_centre: float = 0.5,
        depth: str = "",
        depth_unit: float = 1e-3,
        depth_known_to: str = "metric",
    ) -> Sequence:
        """Find, select and check the images.

        ``frames``, ``masks``: a folder of images or a glob pattern, sorted by name, numbers in
        names by value; masks pair with images in that order, ``""`` is for none. ``first`` to
        ``last`` (inclusive, -1 for the end) in steps of ``stride`` are used. ``size``: the (width,
        height) that the frames must have, None for any. ``drop_stray``: see :meth:`mask`.
        ``tracks``, ``depth``: a file and a folder or pattern, ``""`` for none
        (:mod:`polysft_mi.scene.evidence`).

        Every selected file is read here once, so that a bad one is known before the work starts.
        Raises InputError.
        """
        paths = list_images(frames, "frames")
        if not 0 <= first < len(paths):
            raise InputError(f"first = {first}; {frames} holds {len(paths)} images, counted from 0")
        if last != -1 and not first <= last < len(paths):
            raise InputError(
                f"last = {last}; it must lie in [{first}, {len(paths) - 1}] ({frames} holds"
                f" {len(paths)} images), or be -1 for the end"
            )
        if stride < 1:
            raise InputError(f"stride = {stride}; at least 1 is needed")
        indices = list(range(first, len(paths) if last == -1 else last + 1, stride))
        files = [paths[k] for k in indices]
        mask_files = None
        if masks:
            mask_paths = list_images(masks, "masks")
            if len(mask_paths) != len(paths):
                raise InputError(
                    f"{masks}: {len(mask_paths)} masks for the {len(paths)} images of {frames}; one"
                    " mask an image is needed"
                )
            _check_numbers(paths, mask_paths)
            mask_files = [mask_paths[k] for k in indices]

        everything = files + (mask_files or [])
        with ThreadPoolExecutor(min(8, cores())) as pool:
            list(pool.map(check_upright, everything))
            sizes = dict(zip(everything, pool.map(checked_size, everything)))
        wanted, why = (
            ((size[0], size[1]), "the camera's film has")
            if size
            else (sizes[files[0]], f"{files[0]} has")
        )
        for path in everything:
            if sizes[path] != wanted:
                raise InputError(
                    f"{path}: {_text(sizes[path])} pixels; {why} {_text(wanted)}, and all images"
                    " must be of that size"
                )
        sequence = cls(files, mask_files, indices, wanted, drop_stray)
        sequence.count, sequence.grey = len(paths), _is_grey(read_pixels(files[0]))
        if tracks:
            sequence.tracks = Tracks.read(tracks, len(paths), indices, track_centre)
        if depth:
            sequence.depth = DepthImages.open(
                depth, len(paths), indices, depth_unit, depth_known_to
            )
        if mask_files:
            with ThreadPoolExecutor(min(8, cores())) as pool:
                areas = list(pool.map(sequence._mask_area, range(len(files))))
            if not areas[0]:
                raise InputError(
                    f"{mask_files[0]}: the mask is empty; the template must be seen in the first"
                    " frame"
                )
            least = _LEAST_AREA * areas[0]
            sequence.unmasked = frozenset(k for k, area in enumerate(areas) if area < least)
        return sequence

    def _mask_area(self, i):
        return float(self.mask(i).sum())

    def __len__(self) -> int:
        return len(self.files)

    def frame(self, i: int) -> np.ndarray:
        """Image i, (H, W, 3) float32, linear RGB in [0, 1]; without its colours where the sequence
        is ``grey``.

        8 and 16 bit images are taken as sRGB and decoded; float images (EXR, HDR, TIFF) as linear.
        Grey becomes RGB, alpha is ignored.
        """
        image = read_pixels(self.files[i])
        if image.ndim == 2:
            image = image[..., None]
        image = np.ascontiguousarray(
            image[..., 2::-1] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
        )  # OpenCV's order is BGR
        image = _linear(image, self.files[i])
        return grey(image) if self.grey else image

    def mask(self, i: int) -> np.ndarray | None:
        """Silhouette i, (H, W) float32 in [0, 1]; None without masks.

        As :func:`polysft_mi.scene.images.read_mask` has it. With ``drop_stray``, blobs away from
        the sheet are removed (:func:`drop_stray_components`).
        """
        if self.mask_files is None:
            return None
        mask = read_mask(self.mask_files[i])
        return drop_stray_components(mask) if self._drop_stray else mask


def _check_numbers(frames, masks):
    """Raise InputError where most masks have the last number in the name of their frame, but not
    all: one is missing, and another too many.
    """
    numbers = [
        [re.findall("[0-9]+", os.path.basename(p)) for p in paths] for paths in (frames, masks)
    ]
    alike = [bool(a and b) and int(a[-1]) == int(b[-1]) for a, b in zip(*numbers)]
    if all(alike) or 2 * sum(alike) < len(alike):
        return
    k = alike.index(False)
    raise InputError(
        f"{masks[k]}: pairs with {frames[k]}, by their order, but their numbers differ, and those"
        " of most do not; one mask for each image is needed, of the same number"
    )


def inverted(mask, sheet):
    """Whether a mask (H, W) bool is of the background rather than of the ``sheet`` (H, W) bool, as
    the template has it.
    """
    return 2 * (mask & sheet).sum() < sheet.sum() and 2 * (mask & ~sheet).sum() > (~sheet).sum()


def drop_stray_components(mask, share=0.1):
    """The mask (H, W) without its 8-connected components of less than ``share`` of the largest
    one's area. (Something before the sheet may split it into parts of some size.)
    """
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (mask > 0).astype(np.uint8), connectivity=8
    )
    if count <= 2:
        return mask
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return mask * (area >= share * area.max())[labels]


def _is_grey(image):
    if image.ndim == 2 or image.shape[2] < 3:
        return True
    largest, least = image[..., :3].max(2), image[..., :3].min(2)
    apart = np.quantile(largest.astype(float) - least, 0.99)
    return bool(apart <= _LEAST_COLOUR * max(largest.max(), 1e-9))


def _linear(image, path):
    if image.dtype.kind == "f":
        return np.clip(finite(image, path), 0, 1)
    table = _srgb_table(np.iinfo(image.dtype).max)
    if image.dtype == np.uint8:
        import cv2

        return cv2.LUT(image, table)  # the same in a third of the time
    return table[image]


@functools.lru_cache(maxsize=2)
def _srgb_table(largest):
    """Linear value of each sRGB code 0..largest (IEC 61966-2-1), float32."""
    return linear(np.arange(largest + 1) / largest).astype(np.float32)


def _text(size):
    return f"{size[0]}x{size[1]}"
