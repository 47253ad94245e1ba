"""What is given: a scene, a template in it, a video, settings. Import only after a Mitsuba variant
is set.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.optimize import nnls

from polyfit.colours import LUMINANCE, srgb
from polysft_mi.errors import InputError
from polysft_mi.render import Pinhole, PlacedMesh
from polysft_mi.scene import Rules, inverted
from polysft_mi.surface import Atlas, JetAtlas, Unknowns

if TYPE_CHECKING:
    from polysft_mi.scene import Experiment, Sequence


_INSIDE = 0.99  # alpha, and mask, of a pixel that the template fills
_FEW_PIXELS = 100  # that say nothing of a camera
_FEW_TRACKS = 0.1  # share of them on the template by which they are not of it
# range of the depth images' numbers by the template's depth where it stands in its true place, and
# where a body with an estimated pose carries it
_ALIKE, _ALIKE_ON_A_BODY = (0.8, 1.25), (0.5, 2.0)


class Problem:
    """Shape from template on one video.

    ``template``; ``patch``: its jets on the device, ``atlas``: on the host; ``placed``: its mesh in
    the scene; ``camera``; ``sequence``: the frames; ``settings``, with what they leave open decided
    for this template; ``rules``; ``bleached``: whether the texture's colours were taken away, for
    the frames have none. Raises InputError where the sensor does not suit.
    """

    def __init__(
        self, experiment: Experiment, sequence: Sequence, rules: Rules | None = None
    ) -> None:
        self.experiment, self.sequence = experiment, sequence
        self.template = experiment.template
        self.settings = experiment.settings.for_patches(len(self.template))
        self.rules = (rules or Rules()).for_patches(len(self.template))
        carrier = sequence.carrier
        self.patch, self.atlas = JetAtlas(self.template, carrier), Atlas(self.template, carrier)
        e = experiment
        rendered = e.scene, e.sensor, e.renderer, e.mesh, e.corner
        self.placed = PlacedMesh(*rendered, self.settings.sppi, e.path)
        self.camera = self.placed.camera
        self.width, self.height = experiment.size
        self.bleached = sequence.grey and self.placed.make_grey(*self._response())

    def _response(self):
        """``(weights, is_coded)`` of :func:`polyfit.colours.grey`, as the first frame says what a
        grey camera makes of the texture's colours; where it says nothing, the luminance.
        """
        import cv2

        vertices = self.atlas.surface(self.atlas.start).vertices
        with dr.suspend_grad():
            image = self.placed.image(mi.Point3f(vertices.T.astype(np.float32)))
        colour, alpha = (np.array(x) for x in image)
        inside, mask = alpha[..., 0] > _INSIDE, self.sequence.mask(0)
        inside &= True if mask is None else mask > _INSIDE
        if inside.sum() < _FEW_PIXELS:
            return LUMINANCE, False
        frame, found = self.sequence.frame(0)[..., 0], []
        for is_coded in (False, True):
            known, wanted = (srgb(x) if is_coded else x for x in (colour, frame))
            smooth = lambda x: cv2.GaussianBlur(np.ascontiguousarray(x), (0, 0), 1)[inside]
            rows = [smooth(known[..., k]) for k in range(3)]
            rows, wanted = np.stack([*rows, np.ones_like(rows[0])], 1), smooth(wanted)  # haze, too
            weights, left = nnls(rows, wanted)
            found.append((left / max(wanted.std(), 1e-9), weights[:3], is_coded))
        _, weights, is_coded = min(found, key=lambda x: x[0])
        return (weights / weights.sum(), is_coded) if weights.sum() > 0 else (LUMINANCE, False)

    def surface(self, unknowns: Unknowns) -> np.ndarray:
        """Vertices (N, 3) [m, world] as float32 NumPy."""
        with dr.suspend_grad():
            return np.array(self.patch.vertices(unknowns)).T.astype(np.float32).copy()

    def visible_share(self, vertices: np.ndarray) -> float:
        """Share of the ``vertices`` (N, 3) [m, world] that are before the camera and inside the
        image.
        """
        position, inside = self.camera.project(vertices)
        inside &= (position >= 0).all(1) & (position <= (self.width, self.height)).all(1)
        return float(inside.mean())

    def check_start(self) -> None:
        """Raise InputError where the template, as the scene places it, cannot be seen in the first
        frame of each camera, or tracks and depth are not of it.
        """
        vertices = self.atlas.surface(self.atlas.start).vertices
        nearest = self._start_seen_by(self.camera, vertices, self.sequence)
        self._check_tracks(nearest > 0)
        self._check_depth(nearest)
        for other in self.sequence.cameras:
            self._start_seen_by(Pinhole(other.sensor()), vertices, other.sequence, other.name)

    def _start_seen_by(self, camera, vertices, sequence, name=""):
        """Depth (H, W) [m] at which a camera sees the template, its ``vertices`` (N, 3) [m, world],
        0 beside it. Raises InputError where it does not see it, or where its ``sequence`` has masks
        that it does not meet. ``name``: of a further camera.
        """
        import cv2

        size = width, height = camera.width, camera.height
        position, before = camera.project(vertices)
        where = f"{self.experiment.path}: {f'camera {name}: ' if name else ''}the template"
        hint = "; does its world_to_camera lead from the scene's world, in metres?" if name else ""
        if not before.all():
            hint = hint or "; it must stand in its pose of the first frame"
            raise InputError(
                f"{where} has {int((~before).sum())} of {len(before)} vertices behind the"
                f" camera{hint}"
            )
        low, high = position.min(0).round(), position.max(0).round()
        place = f"it projects to x {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g}"
        if not _inside(position, size).any():
            raise InputError(
                f"{where} is out of view in the first frame: {place} of an image of"
                f" {width}x{height} pixels{hint}"
            )
        far = 10 * max(size)
        faces, z = self.template.faces, camera.to_camera(vertices)[:, 2]
        corners, depth = (
            np.round(position.clip(-far, far)).astype(np.int32)[faces],
            z[faces].mean(1),
        )
        nearest = np.zeros((height, width), np.float32)
        for k in np.argsort(-depth):  # one by one: where two overlap, both together cut a hole
            cv2.fillConvexPoly(nearest, corners[k], float(depth[k]))
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

    def _check_tracks(self, covered):
        """Raise InputError where all tracks lie outside the image, or few of those that begin in
        the first frame begin on the template, ``covered`` (H, W).
        """
        tracks = self.sequence.tracks
        if tracks is None:
            return
        where, size = (
            f"{self.experiment.path}: tracks = {self.settings.tracks}",
            covered.shape[::-1],
        )
        needed = f"pixels of {self.width}x{self.height} are needed"
        inside = tracks.visible & _inside(tracks.positions, size)
        if tracks.visible.any() and not inside.any():
            raise InputError(f"{where}: all of them lie outside the image; {needed}")
        first = tracks.query == 0
        x, y = np.floor(tracks.positions[0, first & inside[0]]).astype(int).T
        begin = int(covered[y, x].sum())
        # a grid over the image has as few on a template that is small there
        if begin < min(_FEW_TRACKS, covered.mean() / 2) * first.sum():
            raise InputError(
                f"{where}: {begin} of the {first.sum()} that begin in the first frame begin on the"
                f" template; {needed}, of points of the surface"
            )

    def _check_depth(self, nearest):
        """Raise InputError where the depth images are of another shape than the frames, or the
        first one, where it knows anything, of another unit than the template, which is seen at the
        depth ``nearest`` (H, W) [m].
        """
        images = self.sequence.depth
        if images is None:
            return
        known, mask = images.like_frames(0, (self.width, self.height)), self.sequence.mask(0)
        both = (known > 0) & (nearest > 0) & (True if mask is None else mask > 0.5)
        if images.known_to != "metric" or not both.any():
            return
        low, high = _ALIKE if self.sequence.carrier is None else _ALIKE_ON_A_BODY
        told, own = np.median(known[both]), np.median(nearest[both])
        if not low < np.median(known[both] / nearest[both]) < high:
            unit = f"depth_unit = {images.unit:g} m must be wrong ({images.unit * own / told:.2g}"
            unit = f"{unit} would fit)" if images.is_whole(0) else "metres are needed"
            raise InputError(
                f"{images.files[0]}: {told:.3g} m where the template lies, whose distance is"
                f" {own:.3g} m; {unit}; depth_known_to = affine takes depth of any scale"
            )


def _inside(position, size):
    """Whether pixels (..., 2) lie in an image of a size (width, height)."""
    return ((position >= 0) & (position < size)).all(-1)
