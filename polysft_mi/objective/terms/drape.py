"""What a garment looks like on the body that it is worn on, where nothing else says it. Import only
after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device

from ..quadratic import RestForms
from .term import Term

_ERROR = 0.02  # standard deviation of the drape [m] from the cloth, both at the body's rest
_ALIKE = 0.05  # share of the vertices that err alike, and count as one


class Drape(Term):
    """k_drape e / 2 times the sum over vertices of d^2 / (m s^2): d the distance [m] of the surface
    from OneFit's drape, both at the body's rest, s = 2 cm, e what one unit of log-likelihood costs
    (:meth:`polysft_mi.objective.terms.term.Inputs.nat`). A drape errs as a whole: m vertices, a
    twentieth of all, count as one.

    What pixels see they say better; what they do not see lies where the drape has it, on the body
    as its pose is corrected.
    """

    name, setting = "drape", "k_drape"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs = inputs
        count = len(inputs.template.vertices)
        self._unit = 1 / (_ERROR**2 * _ALIKE * count)

    @classmethod
    def is_used(cls, settings):
        return bool(settings.body) and super().is_used(settings)

    def energy(self, at):
        rest = mi.Point3d(self._inputs.surface.at_rest(at.unknowns))
        away = rest - mi.Point3d(
            *(on_device(x, mi.Float64) for x in self._inputs.template.vertices.T)
        )
        return mi.Float(self._factor(at.context) / 2 * dr.sum(dr.squared_norm(away)))

    def rows(self, at):
        away = at.surface.at_rest - self._inputs.template.vertices
        factor = self._factor(at.context)
        at.at_rest = RestForms(factor * away, np.full(len(away), factor))
        at.energies[self.name] = factor / 2 * float((away**2).sum())

    def add(self, at):
        return at.energies[self.name]

    def _factor(self, context):
        """Weight of d^2 / 2 [1/m^2]."""
        return self.weight * self._inputs.nat(context) * self._unit
