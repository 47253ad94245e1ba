"""Points that are followed through the video, by a point tracker or by hand. Import only after a
Mitsuba variant is set.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device

from ..quadratic import TriangleForms
from .term import Term

_TOLERANCE = 2.5  # standard deviations from which on a track pulls no harder
_FIRST, _BOUNDS = 1.0, (0.3, 3.0)  # standard deviation [pixels]: before it is known, and its range
_MEDIAN = math.sqrt(2 * math.log(2))  # of the length of a residual of two normal coordinates
_FEWEST = 16  # tracks that tell a noise


class Tracks(Term):
    """k_tracks e / 2 times the sum over tracks of 2 c^2 ((1 + r^2 / c^2)^1/2 - 1) / s^2: r the
    distance [pixels] of a point's projection from its track, s the standard deviation of either
    coordinate, e what one unit of log-likelihood costs
    (:meth:`polysft_mi.objective.terms.term.Inputs.nat`).

    A track starts in the frame of its query: what the pixel shows of the surface that was found
    there is the point that it follows. s is that of the residuals in the frame before. The norm
    (Charbonnier's) turns robust at c, 2.5 s and as far as images are blurred. What jumps is left
    out before (:mod:`polysft_mi.scene.evidence`), so that a track which is far off still pulls: a
    surface that slipped comes back.
    """

    name, setting, is_noise = "tracks", "k_tracks", True

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs, self._camera = inputs, inputs.placed.camera
        self._tracks, self._faces = inputs.sequence.tracks, inputs.placed.faces
        count = len(self._tracks.query)
        #: of each track, the triangle that its point is in, -1 where it is not known yet
        self.face = np.full(count, -1)
        #: (P, 3): barycentric coordinates of the points
        self.weights = np.zeros((count, 3))

    @classmethod
    def is_used(cls, settings):
        return bool(settings.tracks) and super().is_used(settings)

    def observe(self, frame, vertices):
        """Find the points of the tracks that start here, or that started in a frame that was
        lost.
        """
        tracks = self._tracks
        start = (self.face < 0) & (tracks.query <= frame) & tracks.visible[frame]
        at = np.flatnonzero(start)
        if not len(at):
            return
        found, weights = self._inputs.data.at_pixels(vertices, tracks.positions[frame, at])
        hit = found >= 0
        self.face[at[hit]], self.weights[at[hit]] = found[hit], weights[hit]

    def matches(self, frame, vertices):
        chosen = self._chosen(frame)
        return self._points(vertices, chosen), self._tracks.positions[frame, chosen]

    def noise(self, context, vertices, stage):
        residual, _, _ = self._residuals(context.frame, vertices)
        found = self._noise(context)
        if len(residual) >= _FEWEST:
            found = float(np.median(np.linalg.norm(residual, axis=1)) / _MEDIAN)
        return {self.name: float(np.clip(found, *_BOUNDS))}

    def fit(self, surfaces, stage):
        """``used`` of ``given`` tracks, those that begin on the surface; ``noise_px``, the standard
        deviation of either coordinate after that, by the median.
        """
        apart = [np.zeros(0)]
        for frame, vertices in enumerate(surfaces):
            residual, _, chosen = self._residuals(frame, vertices)
            apart.append(np.linalg.norm(residual[self._tracks.query[chosen] < frame], axis=1))
        apart = np.concatenate(apart)
        noise = float(np.median(apart)) / _MEDIAN if len(apart) else math.nan
        used = int((self.face >= 0).sum())
        return {"used": used, "given": len(self.face), "noise_px": noise}

    def energy(self, at):
        frame = at.context.frame
        chosen = self._chosen(frame)
        if not len(chosen):
            return mi.Float(0)
        flat = mi.Float64(dr.ravel(at.vertices))
        point = mi.Point3d(0)
        for corner in range(3):
            index = on_device(self._faces[self.face[chosen], corner], mi.UInt32)
            weight = on_device(self.weights[chosen, corner], mi.Float64)
            point += weight * dr.gather(mi.Point3d, flat, index)
        target = mi.Vector2d(self._tracks.positions[frame, chosen].T)
        squared = dr.squared_norm(self._camera.attached(point) - target)
        factor, scale = self._factor(at.context), self._scale(at.context, at.stage)
        rho = float(2 * factor * scale**2) * (dr.sqrt(1 + squared / float(scale**2)) - 1)
        return mi.Float(dr.sum(rho))

    def rows(self, at):
        chosen = self._chosen(at.context.frame)
        if not len(chosen):
            return
        residual, by_point, chosen = self._residuals(at.context.frame, at.surface.vertices)
        factor, scale = self._factor(at.context), self._scale(at.context, at.stage)
        root = np.sqrt(1 + (residual**2).sum(1) / scale**2)
        energy = 2 * factor * scale**2 * float((root - 1).sum())
        heavy = 2 * factor / root
        weights = self.weights[chosen]
        pull = np.einsum("p,pc,pck->pk", heavy, residual, by_point)
        form = np.einsum("p,pck,pcm->pkm", heavy, by_point, by_point)
        gradient = np.zeros((len(self._faces), 3, 3))
        curvature = np.zeros((len(self._faces), 3, 3, 3, 3))
        np.add.at(gradient, self.face[chosen], weights[:, :, None] * pull[:, None])
        pairs = weights[:, :, None] * weights[:, None]
        np.add.at(curvature, self.face[chosen], pairs[..., None, None] * form[:, None, None, :, :])
        at.add_to_triangles(self.name, energy, TriangleForms(gradient, curvature))

    def add(self, at):
        return at.energies.get(self.name, 0.0)

    def _chosen(self, frame):
        """The tracks that say something in a frame."""
        return np.flatnonzero((self.face >= 0) & self._tracks.visible[frame])

    def _residuals(self, frame, vertices):
        """(residuals (P, 2) [pixels], their derivatives (P, 2, 3) [pixels/m] by the points, the
        tracks (P,)) of those that say something in a frame.
        """
        chosen = self._chosen(frame)
        point = self._points(vertices, chosen)
        projected, _ = self._camera.project(point)
        away = projected - self._tracks.positions[frame, chosen]
        return away, self._camera.derivatives(point), chosen

    def _points(self, vertices, chosen):
        """Where the points of the ``chosen`` tracks are on a surface (N, 3) [m], (P, 3) [m]."""
        corners = vertices[self._faces[self.face[chosen]]]
        return np.einsum("pa,pak->pk", self.weights[chosen], corners)

    def _noise(self, context):
        return context.memory.noises.get(self.name, _FIRST)

    def _factor(self, context):
        """Weight of r^2 near 0 [1/pixel^2]."""
        return self.weight * self._inputs.nat(context) / (2 * self._noise(context) ** 2)

    def _scale(self, context, stage):
        """Where the norm turns robust [pixels]."""
        return math.hypot(_TOLERANCE * self._noise(context), self._inputs.blur(stage))
