"""The silhouette term: the rendering's alpha against the frame's mask (paper, section "PolySfT",
Losses). Frames without masks have none. Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi

from .term import Term


class Silhouette(Term):
    """k_silhouette / area times the sum over pixels of (alpha - mask)^2; the mask's area."""

    name, setting = "silhouette", "k_silhouette"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs = inputs

    def energy(self, at):
        target = self._inputs.target(at.context.frame)
        if target.mask is None:
            return mi.Float(0)
        return self.weight * dr.sum(dr.square(at.image[1] - target.mask)) / target.area

    def add(self, at):
        return at.evaluation.silhouette
