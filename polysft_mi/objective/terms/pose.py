"""How far a body's pose may be from what is known of it. Import only after a Mitsuba variant is
set.
"""

import mitsuba as mi
import numpy as np

from .term import Term

# standard deviations of what is known: of a joint [rad], of the root's place [m]; and of how much
# the error changes from a frame to the next
_KNOWN = np.radians(2.5), 0.015
_CHANGE = np.radians(0.6), 0.005


class Pose(Term):
    """k_pose e / 2 times the sum over the numbers of a pose's correction c of c^2 / s^2 + (c -
    c')^2 / t^2: s = 2.5 degrees and 1.5 cm, c' that of the frame before, t = 0.6 degrees and 5 mm,
    e what one unit of log-likelihood costs (:meth:`polysft_mi.objective.terms.term.Inputs.nat`).

    Pose estimators err slowly: what they have wrong in a frame, they have wrong in the next one.
    """

    name, setting = "pose", "k_pose"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs, self._carrier = inputs, inputs.atlas.carrier
        turns = 3 * len(self._carrier.free)
        self._known, self._change = (
            1 / np.concatenate([np.full(turns, a), np.full(3, b)]) ** 2
            for a, b in (_KNOWN, _CHANGE)
        )

    @classmethod
    def is_used(cls, settings):
        return bool(settings.body) and super().is_used(settings)

    def energy(self, at):
        numbers = np.array(at.unknowns.pose, dtype=np.float64)
        return mi.Float(self._value(at.context, self._carrier.pose(numbers))[0])

    def add(self, at):
        energy, gradient, curvature = self._value(at.context, at.state.pose)
        where = slice(len(at.normal.gradient) - len(gradient), None)
        at.normal.gradient[where] += gradient
        at.normal.glob[where, where] += np.diag(curvature)
        return energy

    def _value(self, context, pose):
        """(energy, gradient (P,), curvature (P,)). Rotation vectors are small, and their sums those
        of the rotations.
        """
        factor, anchor = self.weight * self._inputs.nat(context), context.anchor
        correction, curvature = self._carrier.correction(pose), self._known.copy()
        pull, energy = self._known * correction, float(self._known @ correction**2)
        if anchor is not None and anchor.pose is not None and anchor.pose.frame != pose.frame:
            change = correction - self._carrier.correction(anchor.pose)
            pull, curvature = pull + self._change * change, curvature + self._change
            energy += float(self._change @ change**2)
        return factor / 2 * energy, factor * pull, factor * curvature
