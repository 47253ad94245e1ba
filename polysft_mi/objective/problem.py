"""What is given: a scene, a template in it, a video, settings. Import only after a Mitsuba variant
is set.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from polysft_mi.errors import InputError
from polysft_mi.render import PlacedMesh
from polysft_mi.scene import Rules
from polysft_mi.surface import Atlas, JetAtlas, Unknowns

if TYPE_CHECKING:
    from polysft_mi.scene import Experiment, Sequence


class Problem:
    """Shape from template on one video.

    ``template``; ``patch``: its jets on the device, ``atlas``: on the host; ``placed``: its mesh in
    the scene; ``camera``; ``sequence``: the frames; ``settings``, with what they leave open decided
    for this template; ``rules``. Raises InputError where the sensor does not suit.
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
        frame.
        """
        vertices = self.atlas.surface(self.atlas.start).vertices
        position, before = self.camera.project(vertices)
        where = f"{self.experiment.path}: the template"
        if not before.all():
            raise InputError(
                f"{where} has {int((~before).sum())} of {len(before)} vertices behind the camera;"
                " it must stand in its pose of the first frame"
            )
        low, high = position.min(0).round(), position.max(0).round()
        if self.visible_share(vertices) == 0:
            raise InputError(
                f"{where} is out of view in the first frame: it projects to x"
                f" {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g} of an image of"
                f" {self.width}x{self.height} pixels"
            )
        import cv2

        far = 10 * max(self.width, self.height)
        corners = np.round(position.clip(-far, far)).astype(np.int32)[self.template.faces]
        covered = np.zeros((self.height, self.width), np.uint8)
        for triangle in corners:  # one by one: where two overlap, both together cut a hole
            cv2.fillConvexPoly(covered, triangle, 1)
        mask = self.sequence.mask(0)
        if mask is not None:
            sheet, masked = covered > 0, mask > 0.5
            both = int((sheet & masked).sum())
            # what passes before the sheet may hide most of it, but not be in the mask
            if 2 * both < min(sheet.sum(), masked.sum()):
                inverted = (sheet & ~masked).sum() > both and masked[~sheet].mean() > 0.5
                hint = "; is it inverted? White is the sheet" if inverted else ""
                raise InputError(
                    f"{where} does not meet the mask of the first frame, {both} of whose"
                    f" {int(masked.sum())} pixels it covers{hint}: it projects to x"
                    f" {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g}"
                )
        self._check_tracks(covered > 0)
        self._check_depth(covered > 0, vertices)

    def _check_tracks(self, covered):
        """Raise InputError where tracks begin in the first frame, but none of them on the template,
        ``covered`` (H, W).
        """
        tracks = self.sequence.tracks
        if tracks is None or not (tracks.query == 0).any():
            return
        x, y = np.floor(tracks.positions[0, tracks.query == 0]).astype(int).T
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        if not covered[y[inside], x[inside]].any():
            raise InputError(
                f"{self.experiment.path}: tracks: none of the {len(x)} that begin in the first"
                f" frame begins on the template; pixels of {self.width}x{self.height} are needed"
            )

    def _check_depth(self, covered, vertices):
        """Raise InputError where the first depth image is of another shape than the frames, or of
        another unit than the template.
        """
        images = self.sequence.depth
        if images is None:
            return
        known = images.like_frames(0, (self.width, self.height))[covered]
        known = known[known > 0]
        if self.settings.depth_known_to == "metric" and len(known):
            told, own = np.median(known), np.median(self.camera.to_camera(vertices)[:, 2])
            if not 0.5 < told / own < 2:
                raise InputError(
                    f"{images.files[0]}: {told:.3g} m where the template lies, whose"
                    f" distance is {own:.3g} m; depth_unit = {images.unit:g} m must be wrong"
                )
