"""Chromaticity as a cue: the triangles' colours but for their brightness, which light does not
change. Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.images import Images, colour_cast
from polysft_mi.images.gather import flat

from .term import Term


class Chroma(Term):
    """k_chroma times the mean over the area seen of c^2 log(1 + r^2 / c^2): r the part of a
    triangle's colour in the frame that is across its texture's, as linear RGB over the mean of the
    texture's luminance, both blurred to the size of a triangle.

    White light makes a colour brighter or darker, and no more: r knows neither shade nor shadow. So
    no local mean is taken off it, and slow changes of colour tell where the sheet is, which are
    lost to the photometric term. The texture's colours are those that the first frame shows: a
    camera's curve, and light that is not white, change them a little. A frame's white balance is
    its own.
    """

    name, setting, is_noise = "chroma", "k_chroma", True

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs, self._squared_scale = inputs, inputs.rules.chroma_scale**2
        self._first = None  # (frame, vertices) that was solved first
        self._cast = None  # (colours, what that frame makes of them)

    def observe(self, frame, vertices):
        if self._first is None:
            self._first = frame, vertices

    def energy(self, at):
        if not self._counts(at.context):
            return mi.Float(0)
        data = self._inputs.data
        vertices = np.array(dr.detach(at.vertices), dtype=np.float64).T
        seen = self._seen(vertices, at.context.frame, at.stage.blur)
        found = self._compared(vertices, at.context.frame, seen, at.appearance)
        where = mi.Float64(dr.ravel(at.vertices))
        moved = mi.Vector2d(0)
        for corner in data.faces.T:
            point = dr.gather(mi.Point3d, where, on_device(corner, mi.UInt32))
            place = self._inputs.placed.camera.attached(point)
            moved += (place - dr.detach(place)) / 3
        squared = mi.Float64(0)
        for k in range(2):
            slope = mi.Vector2d(found.slope[:, k].T)
            squared += dr.square(mi.Float64(found.residual[:, k]) + dr.dot(slope, moved))
        rho = self._squared_scale * dr.log(1 + squared / self._squared_scale)
        total = dr.sum(mi.Float64(found.area) * rho)
        return mi.Float(self._factor(found) * total)

    def rows(self, at):
        if not self._counts(at.context):
            return
        data, frame = self._inputs.data, at.context.frame
        found = self._compared(at.surface.vertices, frame, at.evaluation.seen, at.appearance)
        over = (found.residual**2).sum(1) / self._squared_scale
        factor = self._factor(found)
        energy = factor * self._squared_scale * float((found.area * np.log1p(over)).sum())
        each = 2 * factor * found.area / (1 + over)
        gradient, second = found.at_vertices(each, data.pattern)
        at.add_to_images(self.name, energy, Images(flat(gradient), flat(second)))

    def add(self, at):
        return at.energies.get(self.name, 0.0)

    def _counts(self, context):
        return self._first is not None and context.frame != self._first[0]

    def _seen(self, vertices, frame, blur):
        """Pixels (F,) of the triangles, as the images' evaluation counts them."""
        return self._inputs.data.evaluate(vertices, frame, blur, 1.0, k_silhouette=0.0).seen

    def _factor(self, found):
        return self.weight / max(int((found.area > 0).sum()), 1)

    def _compared(self, vertices, frame, seen, appearance):
        data = self._inputs.data
        if self._cast is None or self._cast[0] is not data.colours:  # the texture may have moved
            first, there = self._first
            seen_first = self._seen(there, first, self._inputs.rules.blurs[-1])
            shown = data.shown(there, first)
            self._cast = data.colours, colour_cast(data.colours, shown, seen_first)
        return data.chroma(vertices, frame, seen, self._cast[1], appearance)
