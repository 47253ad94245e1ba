"""The camera from a video, or images, of a chessboard or a ChArUco board that is moved before it:
focal lengths, principal point, distortion."""

import re
from dataclasses import dataclass

import cv2
import numpy as np

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError

from .. import pictures
from ..frames import read_frames
from .lens import Lens


@dataclass(frozen=True)
class CalibrationRules:
    """Which views are used, and which calibrations are refused.

    - ``max_frames`` of a video are searched; of the views that show the board, ``max_views`` are
      used, and ``min_views`` are needed.
    - ``noise`` [pixels]: how far a corner is off at best.
    - ``tilt`` [degrees]: the largest angle between two views must reach this.
    - ``max_focal_deviation``: largest standard deviation of the focal length, as a share of it.
    - ``max_residual`` [pixels, RMS]: largest distance of the corners.
    """

    max_frames: int = 60
    max_views: int = 25
    min_views: int = 4
    noise: float = 0.1
    tilt: float = 15.0
    max_focal_deviation: float = 0.02
    max_residual: float = 3.0


def _parse_board(text):
    """The board: ``9x6``, inner corners of a chessboard, or ``charuco:7x5:4X4_50:0.75``, squares,
    dictionary, and marker by square side.

    Returns a function of a grey image that gives (points (K, 3) in squares, pixels (K, 2)) or None.
    Raises InputError.
    """
    plain = re.fullmatch(r"(\d+)x(\d+)", text)
    if plain and min(map(int, plain.groups())) >= 3:
        return _Chessboard(*map(int, plain.groups()))
    board = re.fullmatch(r"charuco:(\d+)x(\d+):(\w+):(0?\.\d+)", text)
    dictionary = board and getattr(
        cv2.aruco, "DICT_" + board[3].upper().removeprefix("DICT_"), None
    )
    if not board or dictionary is None or min(int(board[1]), int(board[2])) < 3:
        raise InputError(
            f"--board {text}: give the inner corners of a chessboard, as in 9x6, or a ChArUco"
            " board, as in charuco:7x5:4X4_50:0.75 (squares, dictionary, marker by square)"
        )
    return _Charuco(int(board[1]), int(board[2]), dictionary, float(board[4]))


class _Chessboard:
    def __init__(self, columns, rows):
        self.name = f"a chessboard of {columns}x{rows} inner corners"
        self._size = columns, rows
        self._points = np.column_stack(
            [
                np.tile(np.arange(columns), rows),
                np.repeat(np.arange(rows), columns),
                np.zeros(columns * rows),
            ]
        )

    def __call__(self, grey):
        small = min(
            1.0, 800 / max(grey.shape)
        )  # whether it is there is seen sooner on a small image
        if small < 1 and not cv2.checkChessboard(
            cv2.resize(grey, None, fx=small, fy=small, interpolation=cv2.INTER_AREA), self._size
        ):
            return None
        found, corners = cv2.findChessboardCornersSB(
            grey, self._size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        return (self._points.astype(np.float32), corners.reshape(-1, 2)) if found else None


class _Charuco:
    def __init__(self, columns, rows, dictionary, ratio):
        self.name = f"a ChArUco board of {columns}x{rows} squares"
        self._board = cv2.aruco.CharucoBoard(
            (columns, rows), 1.0, ratio, cv2.aruco.getPredefinedDictionary(dictionary)
        )
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def __call__(self, grey):
        corners, names, _, _ = self._detector.detectBoard(grey)
        if names is None or len(names) < 8:
            return None
        points = np.asarray(self._board.getChessboardCorners(), dtype=np.float32)[np.ravel(names)]
        spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(0), compute_uv=False)
        return (
            (points, corners.reshape(-1, 2)) if spread[1] > 0.2 * spread[0] else None
        )  # those on a line say little


def calibrate(path, board="9x6", rules=None):
    """(:class:`Lens`, a picture of the boards that were found) from a
    video, a folder of images or a pattern.

    Four distortion coefficients (k1, k2, p1, p2; k3, which few views tell, is 0), by OpenCV's
    calibration over at most 25 views that differ. Raises InputError where the board is found in too
    few, or where the views do not tell the focal length.
    """
    rules = rules or CalibrationRules()
    detect = _parse_board(board)
    views, size = [], None
    count = sum(1 for _ in read_frames(path))
    for index, image in read_frames(path, stride=max(1, count // rules.max_frames)):
        size = image.shape[1::-1]
        found = detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        if found is not None:
            views.append((index, image if len(views) < 200 else None, *found))
    if len(views) < rules.min_views:
        hint = "; --board says which board it is" if not views else ""
        raise InputError(
            f"{path}: {detect.name} is found in {len(views)} frames; at least {rules.min_views},"
            f" from different sides, are needed{hint}"
        )
    views = _different(views, rules.max_views)
    start = np.array(
        [[max(size), 0, size[0] / 2 - 0.5], [0, max(size), size[1] / 2 - 0.5], [0, 0, 1]],
        dtype=np.float64,
    )
    try:
        missed, K, distortion, turns, _, deviations, _, _ = cv2.calibrateCameraExtended(
            [v[2] for v in views],
            [v[3] for v in views],
            size,
            start,
            np.zeros(5),
            flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
        )
    except cv2.error as error:
        raise InputError(
            f"{path}: the boards do not determine the camera ({error.err}); views from different"
            " sides are needed"
        ) from None
    f = float(K[0, 0])
    unsure = (
        float(np.max(np.ravel(deviations)[:2])) / f * max(1.0, rules.noise / missed)
    )  # corners that fit better than they are seen promise too much
    if not np.isfinite(K).all() or not np.isfinite(missed) or missed > rules.max_residual:
        raise InputError(
            f"{path}: the camera that fits best misses the board's corners by {missed:.2g} pixels;"
            " a flat board, sharp images and one zoom are needed"
        )
    normals = np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)).max()))
    if unsure > rules.max_focal_deviation or tilt < rules.tilt:
        raise InputError(
            f"{path}: the views do not determine the focal length: it is known to"
            f" {100 * unsure:.1f} %, and the board is tilted by {tilt:.0f} degrees between them;"
            " tilt the board by 30 degrees and more, to different sides"
        )
    camera = Intrinsics(f, float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5, *size)
    source = (
        f"{path}, {detect.name} in {len(views)} views, missed by {missed:.2f} pixels, focal length"
        f" ±{100 * unsure:.1f} %"
    )
    return Lens(camera, tuple(np.ravel(distortion)[:4].tolist()), source), _picture(views)


def _different(views, most):
    """At most ``most`` of the views, by farthest-point sampling of where their corners lie."""
    box = np.array(
        [[*pixels.min(0), *pixels.max(0), *pixels[0], *pixels[-1]] for _, _, _, pixels in views]
    )
    kept, distance = [0], np.linalg.norm(box - box[0], axis=1)
    while len(kept) < min(most, len(views)):
        kept.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(box - box[kept[-1]], axis=1))
    return [views[k] for k in sorted(kept)]


def _picture(views):
    cells = []
    for k in pictures.evenly_spaced(len(views)):
        index, image, _, pixels = views[k]
        shown = image.copy()
        for x in pixels:
            cv2.circle(
                shown, tuple(int(v) for v in x), max(3, image.shape[1] // 100), pictures.GREEN, -1
            )
        cells.append((f"frame {index}", shown))
    return pictures.contact_sheet(cells)
