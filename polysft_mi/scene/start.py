"""Whether the template, as it stands in the first frame, can be what the video shows there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from polysft_mi.errors import InputError

from .sequence import inverted

if TYPE_CHECKING:
    from .evidence import Tracks
    from .sequence import Sequence

_FEW_TRACKS = 0.1  # share of them on the template by which they are not of it
# range of the depth images' numbers by the template's depth where it stands in its true place, and
# where a body with an estimated pose carries it
_ALIKE, _ALIKE_ON_A_BODY = (0.8, 1.25), (0.5, 2.0)


def check_seen(
    where: str,
    position: np.ndarray,
    depth: np.ndarray,
    faces: np.ndarray,
    sequence: Sequence,
    hint: str = "",
) -> np.ndarray:
    """Depth (H, W) [m] at which a camera sees the template in the first frame of its ``sequence``,
    0 beside it. Its vertices are seen at ``position`` (N, 2) [pixels] and ``depth`` (N,) [m];
    ``faces`` (F, 3). Raises InputError, which begins with ``where``, where it is not in view, or
    where it does not meet the mask; ``hint`` then says what may be wrong.
    """
    import cv2

    size = width, height = sequence.size
    where, behind = f"{where}the template", int((depth <= 0).sum())
    if behind:
        hint = hint or "; it must stand in its pose of the first frame"
        raise InputError(f"{where} has {behind} of {len(depth)} vertices behind the camera{hint}")
    low, high = position.min(0).round(), position.max(0).round()
    place = f"it projects to x {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g}"
    if not inside(position, size).any():
        raise InputError(
            f"{where} is out of view in the first frame: {place} of an image of"
            f" {width}x{height} pixels{hint}"
        )
    far = 10 * max(size)
    corners = np.round(position.clip(-far, far)).astype(np.int32)[faces]
    of_faces = depth[faces].mean(1)
    nearest = np.zeros((height, width), np.float32)
    for k in np.argsort(-of_faces):  # one by one: where two overlap, both together cut a hole
        cv2.fillConvexPoly(nearest, corners[k], float(of_faces[k]))
    mask = sequence.mask(0)
    if mask is not None:
        sheet, masked = nearest > 0, mask > 0.5
        both = int((sheet & masked).sum())
        # what passes before the sheet may hide most of it, but not be in the mask
        if 2 * both < min(sheet.sum(), masked.sum()):
            hint = "; is it inverted? White is the sheet" if inverted(masked, sheet) else hint
            raise InputError(
                f"{where} does not meet the mask of the first frame, {both} of whose"
                f" {int(masked.sum())} pixels it covers: {place}{hint}"
            )
    return nearest


def check_tracks(where: str, tracks: Tracks | None, covered: np.ndarray) -> None:
    """Raise InputError, which begins with ``where``, where all tracks lie outside the image, or few
    of those that begin in the first frame begin on the template, ``covered`` (H, W).
    """
    if tracks is None:
        return
    size = covered.shape[::-1]
    needed = f"pixels of {size[0]}x{size[1]} are needed"
    seen = tracks.visible & inside(tracks.positions, size)
    if tracks.visible.any() and not seen.any():
        raise InputError(f"{where}: all of them lie outside the image; {needed}")
    first = tracks.query == 0
    x, y = np.floor(tracks.positions[0, first & seen[0]]).astype(int).T
    begin = int(covered[y, x].sum())
    # a grid over the image has as few on a template that is small there
    if begin < min(_FEW_TRACKS, covered.mean() / 2) * first.sum():
        raise InputError(
            f"{where}: {begin} of the {first.sum()} that begin in the first frame begin on the"
            f" template; {needed}, of points of the surface"
        )


def check_depth(sequence: Sequence, nearest: np.ndarray) -> None:
    """Raise InputError where the depth images are of another shape than the frames, or the first
    one, where it knows anything, of another unit than the template, which is seen at the depth
    ``nearest`` (H, W) [m].
    """
    images = sequence.depth
    if images is None:
        return
    known, mask = images.like_frames(0, nearest.shape[::-1]), sequence.mask(0)
    both = (known > 0) & (nearest > 0) & (True if mask is None else mask > 0.5)
    if images.known_to != "metric" or not both.any():
        return
    low, high = _ALIKE if sequence.carrier is None else _ALIKE_ON_A_BODY
    told, own = np.median(known[both]), np.median(nearest[both])
    if not low < np.median(known[both] / nearest[both]) < high:
        unit = f"depth_unit = {images.unit:g} m must be wrong ({images.unit * own / told:.2g}"
        unit = f"{unit} would fit)" if images.is_whole(0) else "metres are needed"
        raise InputError(
            f"{images.files[0]}: {told:.3g} m where the template lies, whose distance is"
            f" {own:.3g} m; {unit}; depth_known_to = affine takes depth of any scale"
        )


def inside(position: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Whether pixels (..., 2) lie in an image of a size (width, height)."""
    return np.asarray(((position >= 0) & (position < size)).all(-1))
