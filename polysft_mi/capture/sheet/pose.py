"""The rigid pose of the sheet in a frame: by the features that its photo shares with the frame, or
by its corners.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from polysft_mi.errors import InputError
from polysft_mi.poses import FeatureRules, detected, pairs


@dataclass(frozen=True)
class MatchRules:
    """What counts as a match, and as a pose.

    - ``min_matches``: matches that must agree (four fix a plane's pose, and some agree by chance).
    - ``features``: what is a feature, and a pair; ``photo_side`` [pixels]: the longer side to which
      a photo is shrunk before.
    - ``tolerance``: how far a rigid pose may miss a match, as a share of the frame's diagonal (the
      sheet may be bent).
    - ``robust_scale`` [pixels]: residuals above it count less.
    - ``min_area``: share of the frame that a sheet must cover.
    """

    min_matches: int = 10
    features: FeatureRules = field(default_factory=FeatureRules)
    photo_side: int = 2000
    tolerance: float = 0.012
    robust_scale: float = 1.5
    min_area: float = 2e-4


@dataclass(frozen=True)
class Matches:
    """Features found in both: ``photo`` (K, 2) uv on the photo (v up), ``frame`` (K, 2) pixels,
    ``agree`` (K,) bool: those that one motion explains."""

    photo: np.ndarray
    frame: np.ndarray
    agree: np.ndarray


@dataclass(frozen=True)
class Pose:
    """p -> ``rotation`` p + ``translation`` [m] from the template's frame to the camera's;
    ``residual`` (K,): pixels by which it misses what it was found by."""

    rotation: np.ndarray
    translation: np.ndarray
    residual: np.ndarray

    def __call__(self, points):
        """Points (N, 3) of the template in the camera frame [m]."""
        return points @ self.rotation.T + self.translation


def match(photo, frame, rules=None):
    """:class:`Matches` of the SIFT features of two images (H, W, 3) uint8: pairs of which each is
    the other's best. None of them agrees yet.
    """
    rules = rules or MatchRules()
    shrink = min(1.0, rules.photo_side / max(photo.shape[:2]))
    if shrink < 1:
        photo = cv2.resize(photo, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    of_photo, of_frame = (
        detected(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY), rules.features) for x in (photo, frame)
    )
    a, b = pairs(of_photo, of_frame, rules.features).T
    uv = of_photo.places[a] / (photo.shape[1], photo.shape[0])
    uv[:, 1] = 1 - uv[:, 1]
    return Matches(uv, of_frame.places[b], np.zeros(len(a), bool))


def from_matches(matches, sheet, camera, rules=None):
    """(:class:`Pose` or None, the matches with those that agree) of a
    :class:`polysft_mi.capture.sheet.Sheet`.

    A plane is found by a RANSAC homography and the two poses that it allows, other templates by
    RANSAC over poses; then robust least squares over the matches that agree.
    """
    rules = rules or MatchRules()
    points = sheet.at(matches.photo)
    on = np.isfinite(points).all(axis=1)
    tolerance = rules.tolerance * np.hypot(camera.width, camera.height)
    agree = np.zeros(len(on), bool)
    if on.sum() >= 4:
        starts, inliers = _starts(
            points[on], matches.photo[on], matches.frame[on], sheet.flat, camera, tolerance
        )
        agree[np.flatnonzero(on)[inliers]] = True
    matches = Matches(matches.photo, matches.frame, agree)
    if agree.sum() < rules.min_matches or not starts:
        return None, matches
    pose = _refined(starts, points[agree], matches.frame[agree], camera, rules)
    pose = pose if pose is not None and _plausible(pose, sheet, camera, rules) else None
    return pose, matches


def from_corners(corners, sheet, camera):
    """The :class:`Pose` by the pixels (4, 2) of the template's corners: top left, top right, bottom
    right, bottom left of its photo. Raises InputError."""
    corners = np.asarray(corners, dtype=np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    turns = (
        sides[:, 0] * np.roll(sides, -1, axis=0)[:, 1]
        - sides[:, 1] * np.roll(sides, -1, axis=0)[:, 0]
    )
    if (turns < 0).all():
        raise InputError(
            "--corners: the order is anticlockwise; top left, top right, bottom right, bottom left"
            " of the print are needed"
        )
    if not (turns > 0).all():
        raise InputError(
            "--corners: not a convex quadrangle; top left, top right, bottom right, bottom"
            " left of the print are needed"
        )
    points = sheet.corners()
    starts, _ = _starts(points, None, corners, sheet.flat, camera, np.inf)
    pose = _refined(starts, points, corners, camera, MatchRules()) if starts else None
    if pose is None:
        raise InputError(
            "--corners: no pose of the sheet in front of the camera fits them; check their order,"
            " --size and the camera"
        )
    return pose


def _starts(points, photo, pixels, flat, camera, tolerance):
    """Poses (R, t) to start from, and which of the K pairs agree with one motion (indices);
    ``photo`` (K, 2): their uv, where ``tolerance`` [pixels] is finite."""
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if not flat:
        if len(points) < 6:
            found, turn, shift = cv2.solvePnP(
                points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
            )
            return ([(turn, shift)] if found else []), np.arange(len(points))
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            rays,
            np.eye(3),
            None,
            reprojectionError=min(tolerance, 1e4) / camera.fx,
            iterationsCount=2000,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_EPNP,
        )
        return (
            ([(turn, shift)], inliers.ravel())
            if found and inliers is not None
            else ([], np.empty(0, int))
        )
    origin, axes = _plane(points)
    plane = (points - origin) @ axes.T  # x, y, 0
    inliers = np.arange(len(points))
    if np.isfinite(tolerance):
        cv2.setRNGSeed(0)
        if (
            _cross(*(np.linalg.lstsq(plane[:, :2], photo - photo.mean(0), rcond=None)[0][:, None]))[
                0
            ]
            > 0
        ):  # RANSAC takes no mirror images: v goes up, y down
            axes = axes * np.array([[1.0], [-1.0], [-1.0]])
            plane = (points - origin) @ axes.T
        unit = camera.width / max(
            np.ptp(plane[:, :2], axis=0).max(), 1e-12
        )  # RANSAC's checks are for coordinates of the size of pixels
        H, mask = cv2.findHomography(
            unit * plane[:, :2],
            pixels,
            cv2.USAC_MAGSAC,
            tolerance,
            maxIters=10000,
            confidence=0.9999,
        )
        if H is None or not mask.any():
            return [], np.empty(0, int)
        inliers = np.flatnonzero(mask.ravel())
    if len(inliers) < 4:
        return [], inliers
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            plane[inliers][:, None],
            rays[inliers][:, None],
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_IPPE,
        )
    except cv2.error:  # points on a line
        return [], inliers
    starts = []
    for turn, shift in zip(turns, shifts):
        R = cv2.Rodrigues(turn)[0] @ axes
        starts.append((cv2.Rodrigues(R)[0], shift - (R @ origin)[:, None]))
    return starts, inliers


def _plane(points):
    """(origin (3,), axes (3, 3), rows) of a frame in which flat points have z = 0."""
    origin = points.mean(0)
    axes = np.linalg.svd(points - origin, full_matrices=True)[2]
    return origin, axes * np.array([[1.0], [1.0], [np.linalg.det(axes)]])


def _refined(starts, points, pixels, camera, rules):
    """The best :class:`Pose` by robust least squares over the pixels, from each start; None where
    none is before the camera.
    """

    def missed(x):
        return (camera.project(Rotation.from_rotvec(x[:3]).apply(points) + x[3:]) - pixels).ravel()

    found = []
    for turn, shift in starts:
        x = np.concatenate([turn.ravel(), shift.ravel()])
        if (Rotation.from_rotvec(x[:3]).apply(points) + x[3:])[:, 2].min() <= 0:
            continue
        found.append(
            least_squares(missed, x, loss="soft_l1", f_scale=rules.robust_scale, x_scale="jac")
        )
    if not found:
        return None
    x = min(found, key=lambda f: f.cost).x
    return Pose(
        Rotation.from_rotvec(x[:3]).as_matrix(),
        x[3:],
        np.linalg.norm(missed(x).reshape(-1, 2), axis=1),
    )


def _plausible(pose, sheet, camera, rules):
    """Whether the sheet lies before the camera, shows its front, and covers some pixels. A pose by
    chance seldom does.
    """
    placed = pose(sheet.vertices)
    if placed[:, 2].min() <= 0:
        return False
    x = camera.project(placed)
    faces = sheet.in_view(placed, camera)
    a, b, c = (x[faces[:, k]] for k in range(3))
    uv = [sheet.uv[faces[:, k]] for k in range(3)]
    area = _cross(b - a, c - a)
    facing = -_cross(uv[1] - uv[0], uv[2] - uv[0])  # v goes up, y down
    return (np.sign(area) == np.sign(facing)).mean() > 0.7 and 0.5 * np.abs(
        area
    ).sum() > rules.min_area * camera.width * camera.height


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
