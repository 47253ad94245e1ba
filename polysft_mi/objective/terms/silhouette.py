"""The silhouette term: the rendering's alpha against the frame's mask (paper, section "PolySfT",
Losses). Frames without masks have none. Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from .term import Term


class Silhouette(Term):
    """k_silhouette / area times the sum over pixels of (alpha - mask)^2; the mask's area."""

    name, setting = "silhouette", "k_silhouette"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._sequence = inputs.sequence

    def energy(self, at):
        mask = self._sequence.mask(at.context.frame)
        if mask is None:
            return mi.Float(0)
        area = max(1.0, float(mask.sum()))
        wanted = mi.Float(np.ascontiguousarray(mask, dtype=np.float32).ravel())
        return self.weight * dr.sum(dr.square(at.image[1] - wanted)) / area

    def add(self, at):
        return at.evaluation.silhouette
