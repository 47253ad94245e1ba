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
from polysft_mi.render import Pinhole, PlacedMesh
from polysft_mi.scene import Rules, check_depth, check_seen, check_tracks
from polysft_mi.surface import Atlas, JetAtlas, Unknowns

if TYPE_CHECKING:
    from polysft_mi.scene import Experiment, Sequence


_INSIDE = 0.99  # alpha, and mask, of a pixel that the template fills
_FEW_PIXELS = 100  # that say nothing of a camera


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
        vertices, path = self.atlas.surface(self.atlas.start).vertices, self.experiment.path
        world = "world_to_camera lead from the scene's world, in metres?"
        of_body = f"; are body and template in metres, and does {world}"
        hint = of_body if self.sequence.carrier is not None else ""
        nearest = self._seen_by(self.camera, vertices, f"{path}: ", self.sequence, hint)
        check_tracks(f"{path}: tracks = {self.settings.tracks}", self.sequence.tracks, nearest > 0)
        check_depth(self.sequence, nearest)
        for other in self.sequence.cameras:
            where = f"{path}: camera {other.name}: "
            own = Pinhole(other.sensor())
            self._seen_by(own, vertices, where, other.sequence, f"; does its {world}")

    def _seen_by(self, camera, vertices, where, sequence, hint):
        position, depth = camera.project(vertices)[0], camera.to_camera(vertices)[:, 2]
        return check_seen(where, position, depth, self.template.faces, sequence, hint)
