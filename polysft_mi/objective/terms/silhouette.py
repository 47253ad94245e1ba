"""The silhouette term: the rendering's alpha against the frame's mask (paper, section "PolySfT",
Losses). Frames without masks have none. Import only after a Mitsuba variant is set.
"""

import math

import drjit as dr
import mitsuba as mi

from polysft_mi.images import differentiable

from .term import Term


class Silhouette(Term):
    """k_silhouette / area times the sum over pixels of (alpha - mask)^2; the mask's area. Both may
    be blurred before; as in φ-SfT's program it is the mean of |alpha - mask| over the image.
    """

    name, setting = "silhouette", "k_silhouette"

    def __init__(self, inputs):
        super().__init__(inputs)
        s = inputs.settings
        self._norm, self._blur = s.silhouette_norm, s.mask_blur
        self._count = math.prod(inputs.placed.size)

    def energy(self, at):
        target = at.target
        if target.mask is None:
            return mi.Float(0)
        difference = differentiable.blur(at.image[1] - target.mask, self._blur).array
        if self._norm == "phi-sft":
            return self.weight * dr.sum(dr.abs(difference)) / self._count
        return self.weight * dr.sum(dr.square(difference)) / target.area

    def add(self, at):
        return at.evaluation.silhouette

    @property
    def without_block(self):
        if self._norm != "l2":
            return f"silhouette_norm = {self._norm}; l2 is needed"
        return f"mask_blur = {self._blur:g}; 0 is needed" if self._blur else None
