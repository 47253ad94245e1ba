"""Neighbouring vertices are displaced alike: along the jets (uv), and over them (the relief).
Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..operators import DeviceOperator
from .term import Term


class Sliding(Term):
    """k_uv times the sum over edges of the squared difference of the ends' (Δu, Δv), each in the
    axes of the first end; more where no pixel sees them.
    """

    name, setting = "sliding", "k_uv"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs, self._device = inputs, None

    def energy(self, at):
        if self._device is None:
            self._device = DeviceOperator(self._inputs.operators.slides)
        u, v = (mi.Float64(x) for x in (at.unknowns.delta_u, at.unknowns.delta_v))
        weight = np.repeat(_visibility(self._inputs, at.context).edges, 2)
        apart = self._device(_interleaved(u, v))
        return mi.Float(self.weight * dr.sum(mi.Float64(weight) * dr.square(apart)))

    def add(self, at):
        slides, normal = self._inputs.operators.slides, at.normal
        visibility = _visibility(self._inputs, at.context)
        weight = np.repeat(visibility.edges, 2)
        apart = slides @ at.state.offset[:, :2].ravel()
        pull = (slides.T @ (weight * apart)).reshape(-1, 2)
        normal.local_gradient[:, :2] += 2 * self.weight * pull
        normal.local[:, :2, :2] += 2 * self.weight * visibility.slide_blocks[at.d]
        return self.weight * float(weight @ apart**2)


class Relief(Term):
    """k_relief times the sum over edges of the squared difference of the ends' heights over the
    jets, more where no pixel sees them, and ``relief_bend`` times that of the bends at the inner
    edges; the weight grows with what of a misfit counts as noise.
    """

    name, setting = "relief", "k_relief"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs, self._rules, self._device = inputs, inputs.rules, None

    def energy(self, at):
        operators = self._inputs.operators
        if self._device is None:
            difference = operators.patterns[3].difference
            self._device = DeviceOperator(difference), DeviceOperator(operators.bends)
        height, weight = mi.Float64(at.unknowns.delta_w), self._weight(at.context)
        edges = mi.Float64(_visibility(self._inputs, at.context).edges)
        slopes, bends = (dr.square(operator(height)) for operator in self._device)
        bent = operators.relief_bend * dr.sum(bends)
        return mi.Float(weight * (dr.sum(edges * slopes) + bent))

    def add(self, at):
        operators, height, normal = self._inputs.operators, at.state.offset[:, 2], at.normal
        pattern, weight = operators.patterns[3], self._weight(at.context)
        bending = weight * operators.relief_bend
        visibility = _visibility(self._inputs, at.context)
        steps, bent = pattern.difference @ height, operators.bends @ height
        if at.d == 3:
            pull = weight * (pattern.to_ends @ (visibility.edges * steps))
            pull += bending * (operators.bends.T @ bent)
            normal.local_gradient[:, 2] += 2 * pull
            normal.local[:, 2, 2] += 2 * weight * visibility.relief_blocks
        return weight * float(visibility.edges @ steps**2) + bending * float(bent @ bent)

    def _weight(self, context):
        return self.weight * self._rules.caution(context.memory.distrust)


def _visibility(inputs, context):
    return context.visibility or inputs.operators.all_seen


def _interleaved(u, v):
    """u and v of N as one Float64 of 2N."""
    at = dr.arange(mi.UInt32, 2 * dr.width(u))
    even = (at & 1) == 0
    return dr.select(even, dr.gather(mi.Float64, u, at // 2), dr.gather(mi.Float64, v, at // 2))
