"""Shading as a cue: the triangles' brightness under a light that is learned along with the video
(:mod:`polysft_mi.images.light`). Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.images.light import residuals

from ..quadratic import TriangleForms
from .term import Term


class Shading(Term):
    """k_shading times the mean over the area seen of c^2 log(1 + r^2 / c^2), r = luminance - t (l_0
    + l . n + g . x) of a triangle with texture t, normal n and centre x, under the light (l_0, l,
    g) that explains this frame best after those before; and what that departs from theirs.

    It counts at the last stage alone: before, lengths are soft, and shading would bend what they
    should. What the image shows of a triangle is taken from where it lies now: that has no
    gradient, and at its best the light has none.
    """

    name, setting = "shading", "k_shading"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs, self._rules = inputs, inputs.rules

    def energy(self, at):
        light = at.context.light(self._rules)
        if not self._counts(at.stage, light):
            return mi.Float(0)
        data, vertices = self._inputs.data, np.array(dr.detach(at.vertices), dtype=np.float64).T
        seen = data.evaluate(vertices, at.context.frame, at.stage.blur, 1.0, k_silhouette=0.0).seen
        shade = data.shade(vertices, at.context.frame, seen, at.appearance)
        fit, scale = light.fit(shade), light.rules.light_scale
        slope, gradient = fit.coefficients[1:4], fit.coefficients[4:]
        lit = shade.normal @ slope + shade.centre @ gradient
        shown = fit.residual + shade.texture * lit  # but for the light that is the same everywhere

        a, b, c = (
            dr.gather(mi.Vector3d, mi.Float64(dr.ravel(at.vertices)), on_device(k, mi.UInt32))
            for k in data.faces.T
        )
        normal = dr.normalize(dr.cross(b - a, c - a)) * mi.Float64(shade.facing)
        middle = ((a + b + c) / 3 - mi.Vector3d(data.brightness.centre)) / shade.unit
        model = dr.dot(mi.Vector3d(slope), normal) + dr.dot(mi.Vector3d(gradient), middle)
        residual = mi.Float64(shown) - mi.Float64(shade.texture) * model
        rho = scale**2 * dr.log(1 + dr.square(residual / scale))
        total = dr.sum(mi.Float64(fit.area) * rho) + fit.departure
        return mi.Float(self.weight / max(int(shade.seen.sum()), 1) * total)

    def rows(self, at):
        light = at.context.light(self._rules)
        if not self._counts(at.stage, light):
            return
        shade = self._inputs.data.shade(
            at.surface.vertices, at.context.frame, at.evaluation.seen, at.appearance
        )
        energy, *rows = residuals(shade, light, self.weight)
        at.add_to_triangles(self.name, energy, TriangleForms.of_residuals(*rows))

    def add(self, at):
        return at.energies.get(self.name, 0.0)

    @staticmethod
    def _counts(stage, light):
        return stage.last and light.is_known
