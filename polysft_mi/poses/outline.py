"""Where a template's outline lies in an image. A pose given by hand misses by some pixels; the edge
of a print, or of a sheet, tells it better. NumPy, OpenCV and SciPy only.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from polyfit.mesh import loops, signed_areas


@dataclass(frozen=True)
class OutlineSettings:
    """How an outline is searched for. Lengths in pixels are for an outline as large as a square of
    ``size`` pixels, and grow with it.

    - ``reach``: how far from where it is given an outline is looked for; ``blur``: standard
      deviation of the image's blur; ``blurs``: that of the edges' strength across the outline,
      in the rounds of the search.
    - ``spacing`` of points along the outline, ``step`` of samples across it; ``line``: width up to
      which two opposite edges are those of a drawn line.
    - ``straight``: how far an outline may leave the polygon that is tried in its place, as a share
      of its size.
    - ``turn`` [rad], ``shift`` [of the distance]: how wrong a pose that is given may be, where
      edges do not tell; ``prior_weight``: weight of this prior's square.
    - ``starts`` of the search, and ``start_shift``: how far they shift the outline [pixels, RMS].
    - ``min_contrast``, ``min_part_contrast``: least ratio of the edges' strength along the
      outline to that around it, for all of it and for each of ``parts`` parts.
    """

    size: float = 225.0
    reach: float = 8.0
    blur: float = 0.4
    blurs: tuple = (2.5, 1.25, 0.6)
    spacing: float = 2.0
    step: float = 0.25
    line: float = 4.0
    straight: float = 0.01
    turn: float = 0.1
    shift: float = 0.05
    prior_weight: float = 0.005
    starts: int = 12
    start_shift: float = 1.0
    min_contrast: float = 1.7
    min_part_contrast: float = 1.4
    parts: int = 8


@dataclass(frozen=True)
class Fit:
    """A rigid motion p -> ``rotation`` p + ``translation`` [m, camera frame]; how far it moves the
    outline, ``moved`` [pixels, RMS]; how many times as strong edges are along it as around it,
    ``clear``; and whether it is ``sure`` that these are the outline's: pictures are full of edges,
    but seldom of one that runs all along an outline."""

    rotation: np.ndarray
    translation: np.ndarray
    moved: float
    clear: float
    sure: bool

    def __call__(self, points):
        """Points (N, 3) [m], moved."""
        return points @ self.rotation.T + self.translation


def fitted(vertices, faces, camera, image, settings=None):
    """The :class:`Fit` that takes a mesh's outline to the edges in an image that are near it; None
    where it has none before the camera.

    ``vertices`` (N, 3) [m, camera frame], ``faces`` (F, 3), ``image`` (H, W, 3) uint8 sRGB,
    ``camera``: :class:`polysft_mi.camera.Intrinsics`. The outline is the mesh's boundary, or the
    polygon that it nearly is (digitised templates are not quite straight). An edge is as strong as
    the derivative of the image's brightness across the outline, saturated; where the outline is
    taken for a line that is drawn, dark or bright, two opposite ones close together count as both,
    in its middle. The motion is that under which edges are strongest on average along the outline,
    where a drift from the given pose costs a little. What is tried, either outline with edges
    alone, dark or bright lines, is judged by how clear it is.
    """
    s = settings or OutlineSettings()
    vertices = np.asarray(vertices, dtype=np.float64)
    around = loops(np.asarray(faces))
    if not around or vertices[:, 2].min() <= 0:
        return None
    position = camera.project(vertices)
    size = math.sqrt(np.abs(signed_areas(position, faces)).sum())
    unit = max(1.0, size / s.size)
    grey = cv2.GaussianBlur(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255, (0, 0), s.blur * unit
    )
    found = []
    for corners in (around, [_straight(loop, position, s.straight * size) for loop in around]):
        ends = np.concatenate(
            [np.stack([vertices[loop], vertices[np.roll(loop, -1)]], 1) for loop in corners]
        )
        found += [
            OutlineSearch(ends, camera, grey, unit, line, s).fit()
            for line in (None, "dark", "bright")
        ]
    return max(found, key=lambda fit: fit.clear)


def _straight(loop, position, tolerance):
    """Those of a loop's vertices that a polygon within ``tolerance`` [pixels] of it goes
    through.
    """
    polygon = cv2.approxPolyDP(np.float32(position[loop])[:, None], tolerance, True)[:, 0]
    kept = loop[np.isin(np.float32(position[loop]) @ [1, 1j], polygon @ [1, 1j])]
    return kept if len(kept) > 2 else loop


class OutlineSearch:
    """An outline with the edges (E, 2, 3) [m, camera frame] in a blurred image ``grey`` (H, W); its
    lengths there are in ``unit`` [pixels]. ``line``: "dark" or "bright" where it is taken for a
    line, else None."""

    def __init__(self, ends, camera, grey, unit, line=None, settings=None):
        s = self.settings = settings or OutlineSettings()
        self.camera, self.grey, self.unit, self.line = camera, grey, unit, line
        length = np.linalg.norm(camera.project(ends[:, 1]) - camera.project(ends[:, 0]), axis=1)
        count = np.maximum(1, np.round(length / (s.spacing * unit))).astype(int)
        edge = np.repeat(np.arange(len(ends)), count)
        at = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[edge]
        step = ends[edge, 1] - ends[edge, 0]
        self.points = ends[edge, 0] + at[:, None] * step
        self.beside = self.points + 1e-3 * step  # a little further along
        self.centre = self.points.mean(0)
        self.sd = np.repeat([s.turn, s.shift * self.centre[2]], 3)
        self.across = unit * np.arange(-s.reach, s.reach + s.step / 2, s.step)

    def fit(self):
        """The :class:`Fit`, from coarse to fine."""
        s = self.settings
        turn, shift = Rotation.identity(), np.zeros(3)
        for sigma in s.blurs:
            spread = s.start_shift * self.unit if sigma == s.blurs[0] else 0.0
            cost, to_motion = self.costs(turn, shift, sigma)
            starts = (
                spread * np.random.default_rng(0).normal(size=(s.starts, 6))
                if spread
                else np.zeros((1, 6))
            )
            starts[0] = 0
            change = (
                to_motion
                @ min(
                    (minimize(cost, q, jac=True, method="BFGS") for q in starts),
                    key=lambda f: f.fun,
                ).x
            )
            turn, shift = Rotation.from_rotvec(change[:3]) * turn, shift + change[3:]
        position, normal, _ = self._projected(turn, shift)
        strength = self._blurred(self._strength(position, normal), s.blurs[-1])
        parts = np.array_split(np.argsort(np.arctan2(*(position - position.mean(0)).T)), s.parts)
        clear, *clear_parts = (
            float(s[:, len(self.across) // 2].mean() / max(s.mean(), 1e-12))
            for s in (strength, *(strength[k] for k in parts))
        )
        moved = np.sqrt(((position - self.camera.project(self.points)) ** 2).sum(1).mean())
        sure = (
            clear > s.min_contrast
            and min(clear_parts) > s.min_part_contrast
            and moved <= s.reach * self.unit
        )
        rotation = turn.as_matrix()
        return Fit(
            rotation, self.centre + shift - rotation @ self.centre, float(moved), clear, bool(sure)
        )

    def _projected(self, turn, shift):
        """The outline's points after a motion: projections (K, 2), unit normals (K, 2) there, and
        places (K, 3).
        """
        points, beside = (
            turn.apply(x - self.centre) + self.centre + shift for x in (self.points, self.beside)
        )
        position = self.camera.project(points)
        x, y = (self.camera.project(beside) - position).T
        return position, np.stack([-y, x], 1) / np.maximum(np.hypot(x, y), 1e-12)[:, None], points

    def _strength(self, position, normal):
        """How strong edges are across each point, (K, D): 0 to 1, and twice that of a line."""
        x, y = (
            np.float32(position[:, k, None] + self.across * normal[:, k, None] - 0.5)
            for k in (0, 1)
        )  # OpenCV's pixels are whole at their centres
        slope = np.gradient(
            cv2.remap(self.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), axis=1
        )
        strength = np.abs(slope)
        strength, slope = (
            a / np.maximum(strength + 0.5 * np.median(strength.max(1)), 1e-12)
            for a in (strength, slope)
        )
        if self.line is None:
            return strength
        before, after = (
            np.maximum(sign * slope, 0) for sign in ((-1, 1) if self.line == "dark" else (1, -1))
        )
        last = len(self.across)
        for half in range(1, int(self.settings.line / self.settings.step / 2) + 1):
            line = strength[:, half : last - half]
            np.maximum(
                line, 2 * np.minimum(before[:, : last - 2 * half], after[:, 2 * half :]), out=line
            )
        return strength

    def costs(self, turn, shift, sigma):
        """What a change after a motion costs, less where edges are stronger along the outline: a
        function of q (6,) that returns the cost and its gradient (6,), and the matrix (6, 6) that
        makes of q the rotation [rad] and shift [m]; q is in pixels.
        """
        position, normal, points = self._projected(turn, shift)
        smooth = self._blurred(self._strength(position, normal), sigma)
        scaled = normal * (self.camera.fx, self.camera.fy)
        inwards = ((position - (self.camera.cx, self.camera.cy)) * normal).sum(1)
        by_point = (
            np.column_stack([scaled, -inwards]) / points[:, 2:]
        )  # of the place across the outline
        motion_jacobian = np.column_stack(
            [np.cross(points - self.centre - shift, by_point), by_point]
        )
        # in units in which all ways to move it shift the outline alike, as far as the prior does
        # not hold them
        values, vectors = np.linalg.eigh(
            motion_jacobian.T @ motion_jacobian / len(motion_jacobian) + np.diag(self.sd**-2.0)
        )
        to_motion = vectors / np.sqrt(values)
        by_unit, step = motion_jacobian @ to_motion, self.across[1] - self.across[0]
        before = np.concatenate([turn.as_rotvec(), shift]) / self.sd
        held = to_motion / self.sd[:, None]
        rows, last = np.arange(len(smooth)), smooth.shape[1] - 2
        weight = self.settings.prior_weight

        def cost(q):
            at = (by_unit @ q - self.across[0]) / step
            k = np.clip(at.astype(int), 0, last)
            low, high = smooth[rows, k], smooth[rows, k + 1]
            slope = np.where((at > 0) & (at < last + 1), high - low, 0) / step
            drift = before + held @ q
            value = -(low + np.clip(at - k, 0, 1) * (high - low)).mean() + weight * float(
                drift @ drift
            )
            return value, -slope @ by_unit / len(smooth) + 2 * weight * drift @ held

        return cost, to_motion

    def _blurred(self, strength, sigma):
        """Strengths (K, D), blurred by ``sigma`` [pixels of an outline of the settings' size]."""
        return cv2.GaussianBlur(strength, (0, 0), sigmaX=sigma / self.settings.step, sigmaY=1e-6)
