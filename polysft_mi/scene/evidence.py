"""What a user knows of a video beside its images: tracks of points, and depth images. Read and
checked once at the start. Needs no Mitsuba.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from polyfit.backend import cores
from polyfit.files import NOT_NPZ
from polysft_mi.camera import LARGEST
from polysft_mi.errors import InputError

from .images import EXTENSIONS, checked_size, list_images, read_pixels

#: names of the arrays in files of tracks, as CoTracker, TAPIR and AllTracker are used to write them
_POSITIONS = ("tracks", "pred_tracks", "trajs", "trajs_e", "points", "coords")
_VISIBLE = ("visible", "visibility", "pred_visibility", "visibles", "vis", "visibs", "visconfs_e")
_HIDDEN = ("occluded", "occlusion", "pred_occluded", "occlusions")
_QUERIES = ("queries", "query_points")
_POINTS_FIRST = ("occluded", "visibles")  # as TAPIR calls them, whose arrays have points first
# of a visibility that is no yes or no; of one beyond 0 to 1 by more than so much, the logarithm of
# its odds
_SURE, _LOGIT, _BEYOND = 0.5, 0.0, 0.01
# tracks whose motion foretells that of one amid them, rounds of their robust fit, and how many
# times the usual distance from there (at least so many pixels) is not the surface's motion
_AROUND, _ROUNDS, _LEAST, _STRANGE = 8, 3, 0.3, 8.0


@dataclass(frozen=True)
class Tracks:
    """Tracks of P points of the surface over the T frames that are used.

    ``positions`` (T, P, 2) [pixels, (0.5, 0.5) is the centre of the first one]; ``visible`` (T, P);
    ``query`` (P,): the frame from which on a track says which point it follows, counted in the
    selection (T for none).
    """

    positions: np.ndarray
    visible: np.ndarray
    query: np.ndarray

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        count: int,
        selected: list[int],
        centre: float = 0.5,
    ) -> Tracks:
        """The tracks of an ``.npz`` or ``.npy`` file.

        Positions (T, P, 2), (P, T, 2) or (1, T, P, 2), of all ``count`` images or of those that are
        ``selected``; visibilities likewise, true or above 0.5, or above 0 where they are logits (or
        occlusions, the reverse); queries (P, 3), or (1, P, 3): the frame, and the place in it.
        Where T and P are alike, the queries say which is which, or names that TAPIR gives; else
        frames come first. Without visibilities a finite position is one that is seen; without
        queries a track begins where it is first seen. One that is not finite, or over 1e9, never
        is. ``centre``: the coordinate that the file gives the centre of the first pixel. From where
        a track moves otherwise than its neighbours it is not visible. Raises InputError.
        """
        arrays = _arrays(path)
        name, positions = _first(arrays, _POSITIONS)
        if positions is None:
            raise InputError(
                f"{path}: no tracks; an array 'tracks' (T, P, 2) of pixels is needed, and the file"
                f" has {', '.join(sorted(arrays)) or 'nothing'}"
            )
        positions, points_first = _by_frame(path, name, arrays, _Frames(count, selected))
        visible = _visibility(path, arrays, positions, points_first)
        if not visible.any():
            raise InputError(
                f"{path}: no point is seen in any frame; a position that is NaN, or over"
                f" {LARGEST:g} pixels away, or that the visibility denies, is not seen"
            )
        query = _queries(path, arrays, positions.shape)
        if len(positions) != len(selected) or count == len(selected):
            # a query in a frame that is left out counts from the next one that is used
            positions, visible = positions[selected], visible[selected]
            query = np.searchsorted(selected, query)
        visible &= ~_left_their_neighbours(positions, visible)
        used = (np.arange(len(selected))[:, None] >= query) & visible
        first = np.where(used.any(0), used.argmax(0), len(selected))
        positions = np.where(visible[..., None], positions + (0.5 - centre), 0.0)
        return cls(positions, visible, first)


@dataclass(frozen=True)
class DepthImages:
    """Depth images, one a frame: ``files``, and the metres that one of their units is;
    ``known_to``: metric, affine or disparity, as the setting ``depth_known_to``.
    """

    files: list[str]
    unit: float
    known_to: str = "metric"

    @classmethod
    def open(
        cls, folder: str, count: int, selected: list[int], unit: float, known_to: str = "metric"
    ) -> DepthImages:
        """Those in a folder, or of a pattern, sorted like frames: one for each of the ``count``
        images, or of those that are ``selected``, which are read here once. ``unit`` [m]: of whole
        numbers; those with a fraction (EXR, TIFF, CSV) are metres. Raises InputError.
        """
        paths = list_images(folder, "depth images", (*EXTENSIONS, ".csv"))
        frames = _Frames(count, selected)
        if len(paths) not in frames:
            raise InputError(
                f"{folder}: {len(paths)} depth images for {frames} frames; one a frame is needed"
            )
        if len(paths) != len(selected):
            paths = [paths[k] for k in selected]
        images = cls(paths, unit, known_to)
        with ThreadPoolExecutor(min(8, cores())) as pool:
            found = list(pool.map(images._checked, range(len(paths))))
        for path, (shape, _) in zip(paths, found, strict=True):
            if shape != found[0][0]:
                (h, w), (height, width) = shape, found[0][0]
                raise InputError(
                    f"{path}: {w}x{h} pixels; {paths[0]} has {width}x{height}, and all depth images"
                    " must be of one size"
                )
        if not any(has_depth for _, has_depth in found):
            raise InputError(
                f"{folder}: no depth in its images; every pixel is 0 or below, or none, of which"
                " nothing is known"
            )
        return images

    def _checked(self, i):
        """((H, W), whether anything is known) of image i, which must be whole."""
        if not self.files[i].lower().endswith((".csv", ".exr")):
            checked_size(self.files[i])
        depth = self.read(i)
        return depth.shape, bool((depth > 0).any())

    def numbers(self, i: int) -> np.ndarray:
        """The numbers of image i as its file has them, (H, W), uint16 or float32."""
        path = self.files[i]
        image = _table(path) if path.lower().endswith(".csv") else read_pixels(path, depth=True)
        if image.dtype == np.uint8:
            needed = (
                "depth is needed as 16 bit PNG in millimetres, or as EXR in metres"
                if self.known_to == "metric"
                else "they are too coarse: a network's numbers are needed as 16 bit PNG, or EXR"
            )
            raise InputError(f"{path}: 8 bits; {needed}")
        if image.ndim == 2:
            return image
        if any(not np.array_equal(x, image[..., 0], True) for x in np.moveaxis(image, 2, 0)[1:3]):
            raise InputError(
                f"{path}: its channels differ, as colours do; depth in one channel is needed, which"
                " an EXR calls Z or depth"
            )
        return image[..., 0]

    def is_whole(self, i: int) -> bool:
        """Whether the numbers of image i are whole, so that the unit is theirs."""
        return self.numbers(i).dtype.kind != "f"

    def read(self, i: int) -> np.ndarray:
        """Depth i along the camera's axis, (H, W) float32 [m], 0 where nothing is known. Numbers
        with a fraction that are known up to a shift are shifted to be above 0.
        """
        image = self.numbers(i)
        if image.dtype.kind != "f":
            return image.astype(np.float32) * np.float32(self.unit)
        known = np.isfinite(image)
        if self.known_to != "metric" and known.any():
            low, high = image[known].min(), image[known].max()
            image = image - low + np.float32(1e-3 * (high - low) or 1)
        return np.maximum(np.where(known, image, 0), 0).astype(np.float32)

    def like_frames(self, i: int, size: tuple[int, int]) -> np.ndarray:
        """Depth i, (H, W) float32 [m], with as many pixels as frames of ``size`` (W, H): the
        nearest of each. Raises InputError where it is of another shape.
        """
        depth, (width, height) = self.read(i), size
        h, w = depth.shape
        if abs(w * height - h * width) > 0.02 * w * height:
            raise InputError(
                f"{self.files[i]}: {w}x{h} pixels are not of the shape of the frames,"
                f" {width}x{height}; depth as the camera of the frames sees it is needed"
            )
        rows = ((np.arange(height) + 0.5) * h / height).astype(int)
        columns = ((np.arange(width) + 0.5) * w / width).astype(int)
        return depth[rows[:, None], columns]


def _table(path):
    """Numbers (H, W) float32, a line a row, with commas between."""
    try:
        return np.loadtxt(path, dtype=np.float32, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a table of depth in metres ({error})") from None


def _left_their_neighbours(positions: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(T, P): from the first frame on in which a track moves otherwise than those around it.

    A frame's motion is compared with the affine one of the ``_AROUND`` nearest tracks that both
    frames see; tracks of which too few are near are believed.
    """
    wrong = np.zeros(visible.shape, dtype=bool)
    apart = np.full(visible.shape, np.nan)
    for t in range(1, len(positions)):
        both = np.flatnonzero(visible[t - 1] & visible[t])
        if len(both) > _AROUND:
            apart[t, both] = _from_affine(positions[t - 1, both], positions[t, both])
    known = apart[np.isfinite(apart)]
    if len(known):
        usual = max(float(np.median(known)), _LEAST)
        wrong = np.logical_or.accumulate(apart > _STRANGE * usual, axis=0)
    return wrong


def _from_affine(before, after):
    """How far (P,) each point is from where the affine motion of those around takes it."""
    _, near = cKDTree(before).query(before, _AROUND + 1)
    moved = after - before
    near = near[:, 1:]
    a = np.concatenate([before[near] - before[:, None], np.ones((*near.shape, 1))], 2)
    b, weight = moved[near], np.ones(near.shape)
    for _ in range(_ROUNDS):
        heavy = a * weight[..., None]
        form = np.einsum("pki,pkj->pij", heavy, a) + 1e-6 * np.eye(3)
        found = np.linalg.solve(form, np.einsum("pki,pkc->pic", heavy, b))
        size = np.linalg.norm(b - a @ found, axis=2)
        weight = 1 / (1 + np.square(size / np.maximum(np.median(size, 1), 0.1)[:, None]))
    return np.linalg.norm(moved - found[:, 2], axis=1)


def _arrays(path):
    """Name to array of a file of tracks."""
    try:
        found = np.load(path, allow_pickle=False)
        if isinstance(found, np.ndarray):
            return {"tracks": found}
        with found:
            arrays = {name: found[name] for name in found.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file of tracks") from None
    except NOT_NPZ:
        raise InputError(
            f"{path}: not a file of tracks; .npz with 'tracks' (T, P, 2) and 'visible' (T, P) is"
            " needed"
        ) from None
    if any(name.endswith("data.pkl") for name in arrays):
        raise InputError(
            f"{path}: a file of torch; save it as .npz, by numpy.savez(file, tracks=...,"
            " visible=...)"
        )
    return arrays


@dataclass(frozen=True)
class _Frames:
    """How many frames a file may be of: those of the whole video, or those that are used."""

    count: int
    selected: list[int]

    def __contains__(self, size):
        return size in (self.count, len(self.selected))

    def __str__(self):
        used = len(self.selected)
        return f"{self.count}" if used == self.count else f"{self.count} or {used}"


def _first(arrays, names):
    return next(((name, arrays[name]) for name in names if name in arrays), (None, None))


def _by_frame(path, name, arrays, frames):
    """Positions (T, P, 2) float64, and whether the file has points first."""
    positions = _one_batch(arrays[name], 3)
    if positions.ndim != 3 or positions.dtype.kind not in "fiu":
        fits = []
    else:
        fits = [axis for axis in (0, 1) if positions.shape[axis] in frames]
    if not fits:
        raise InputError(
            f"{path}: {name} is {positions.shape}; {frames} frames, the video's, by points are"
            " needed"
        )
    if positions.shape[-1] != 2 or not positions.size:
        raise InputError(
            f"{path}: {name} is {positions.shape}; x and y of at least one point are needed"
        )
    points_first = fits == [1]
    if len(fits) == 2:
        queries = _one_batch(_first(arrays, _QUERIES)[1], 2)
        if queries is not None and positions.shape[0] != positions.shape[1]:
            points_first = len(queries) == positions.shape[0]
        else:
            points_first = any(name in arrays for name in _POINTS_FIRST)
    positions = positions.swapaxes(0, 1) if points_first else positions
    return positions.astype(np.float64), points_first


def _one_batch(array, dimensions):
    """An array without the axis of a batch of one."""
    is_batch = array is not None and array.ndim == dimensions + 1 and len(array) == 1
    return array[0] if is_batch else array


def _visibility(path, arrays, positions, points_first):
    """Which positions are seen, (T, P)."""
    known = (np.abs(positions) <= LARGEST).all(-1)
    name, seen = _first(arrays, _VISIBLE)
    hidden_name, hidden = _first(arrays, _HIDDEN)
    if seen is None and hidden is None:
        return known
    name, found = (name, seen) if seen is not None else (hidden_name, hidden)
    forms = [found, *([found[0]] if found.ndim > 2 and len(found) == 1 else [])]
    # of two, the second is how sure it is
    forms += [x[..., 0] for x in forms if x.ndim > 2 and x.shape[-1] in (1, 2)]
    forms = [x.T if points_first else x for x in forms if x.ndim == 2]
    turned = [y for x in forms for y in (x, x.T) if y.shape == positions.shape[:2]]
    if not turned or found.dtype.kind not in "fiub":
        raise InputError(
            f"{path}: {name} is {found.shape}; it must be of the frames and points of the tracks,"
            f" {positions.shape[:2]}, in numbers, or yes and no"
        )
    found = turned[0].astype(np.float64)
    likely = _LOGIT if (np.abs(found - 0.5) > 0.5 + _BEYOND).any() else _SURE
    return known & ((found > likely) if seen is not None else (found < likely))


def _queries(path, arrays, shape):
    """The frame (P,) of all images from which on each track counts."""
    name, queries = _first(arrays, _QUERIES)
    if queries is None:
        return np.zeros(shape[1], dtype=np.int64)
    if queries.ndim == 3 and len(queries) == 1:
        queries = queries[0]
    if queries.shape != (shape[1], 3):
        raise InputError(
            f"{path}: {name} is {queries.shape}; frame, x and y of each of {shape[1]} points are"
            " needed"
        )
    frames = np.asarray(queries[:, 0], dtype=np.float64)
    if not ((frames >= 0) & (frames < shape[0]) & (frames == np.round(frames))).all():
        raise InputError(
            f"{path}: {name} names frames that are not among 0 to {shape[0] - 1}; its columns are"
            " frame, x, y"
        )
    return frames.astype(np.int64)
