"""What other cameras see. Import only after a Mitsuba variant is set."""

from collections import OrderedDict
from dataclasses import replace

import mitsuba as mi

from .photometric import Photometric
from .silhouette import Silhouette
from .term import DeviceFrame, Term


class Cameras(Term):
    """The photometric and the silhouette term of each camera but the scene's own, with its weights,
    summed up, times k_cameras. A camera says nothing of a frame in which its mask is empty, or
    nearly: it does not see the surface.
    """

    name, setting = "cameras", "k_cameras"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._settings = inputs.settings
        #: what the terms of each camera are made of
        self.views = [
            replace(
                inputs,
                placed=inputs.placed.seen_by(camera.sensor()),
                sequence=camera.sequence,
                _targets=OrderedDict(),
            )
            for camera in inputs.sequence.cameras
        ]
        kinds = [kind for kind in (Photometric, Silhouette) if kind.is_used(inputs.settings)]
        self._terms = [[kind(view) for kind in kinds] for view in self.views]

    @classmethod
    def is_used(cls, settings):
        return bool(settings.cameras) and super().is_used(settings)

    def looks(self, vertices, stage):
        """Of each camera, how a sheet with ``vertices`` looks at a stage; see
        :meth:`polysft_mi.images.data_term.DataTerm.appearance`.
        """
        return tuple(view.data.appearance(vertices, stage.blur) for view in self.views)

    def energy(self, at):
        total = mi.Float(0)
        for k, view in self._seeing(at.context.frame):
            look = lambda k=k: at.appearance and at.appearance.others[k]
            frame = DeviceFrame(view, at.unknowns, at.context, at.stage, look, at.seed + k + 1)
            total += sum(term.energy(frame) for term in self._terms[k])
        return self.weight * total

    def rows(self, at):
        s, energy = self._settings, 0.0
        for k, view in self._seeing(at.context.frame):
            found = view.data.evaluate(
                at.surface.vertices,
                at.context.frame,
                at.stage.blur,
                at.context.memory.scale(at.stage, s.rgb_scale),
                at.appearance and at.appearance.others[k],
                self.weight * s.k_rgb,
                self.weight * s.k_silhouette,
            )
            at.images.append((found.images, view.data.gather.camera))
            energy += found.photometric + found.silhouette
        at.energies[self.name] = energy

    def add(self, at):
        return at.energies[self.name]

    def _seeing(self, frame):
        """The numbers and the views of the cameras that see the surface in a frame."""
        return [(k, v) for k, v in enumerate(self.views) if frame not in v.sequence.unmasked]
