"""The jets bend as little as the images allow. Import only after a Mitsuba variant is set."""

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse as sp

from ..operators import DeviceOperator
from .term import Term


class Bending(Term):
    """k_bend times the sum over jets of the mean squared second derivatives of what the jet adds to
    the template's, over the unit disc of its chart; more where no pixel sees it.
    """

    name, setting = "bending", "k_bend"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._atlas, self._inputs = inputs.atlas, inputs
        # the form is singular: planes do not bend
        values, vectors = np.linalg.eigh(self._atlas.bending)
        root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
        size, count = len(values), len(self._atlas)
        root = root @ np.linalg.inv(self._atlas.to_monomials)
        self._root = DeviceOperator(sp.kron(sp.eye(count), root))
        self._size = size

    def energy(self, at):
        bent = dr.square(self._root(mi.Float64(at.unknowns.delta_alpha)))
        factors = mi.Float64(np.repeat(self._factors(at.context), self._size))
        return mi.Float(self.weight * dr.sum(factors * bent))

    def add(self, at):
        alpha, form, normal = at.state.alpha, self._atlas.bending, at.normal
        factors = self._factors(at.context)
        size = alpha.shape[1]
        for k, factor in enumerate(factors):
            bend = 2 * self.weight * factor * form
            jet = slice(k * (size + 6), k * (size + 6) + size)
            normal.gradient[jet] += bend @ alpha[k]
            normal.glob[jet, jet] += bend
        return self.weight * float(factors @ ((alpha @ form) * alpha).sum(1))

    def _factors(self, context):
        visibility = context.visibility
        return np.ones(len(self._atlas)) if visibility is None else visibility.patches
