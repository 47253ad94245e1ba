"""The deforming atlas (paper, section "PolySfT", there with one patch), of arrays of NumPy, torch
or Dr.Jit.

    p_ik(d) = O_k( R_k (phi_k((u, v) + d_uv; alpha_k + Δalpha_k) + (0, 0, r + d_w)) + T_k )
    x_i     = sum_k w_ik p_ik(0) + p_ii(d_i) - p_ii(0)

with O_k(x) = s_k R x + T; w_ik is the share of patch k in vertex i, r what the jet leaves of the
template, p_ii the vertex in its own patch, and d_i its displacement (Δu, Δv, Δw) there. With one
patch x_i is p_ii(d_i). The paper has no Δw; it is zero but for the second-order solver.

Vectors are three arrays of N numbers each.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from polyfit import jets
from polyfit.jets import namespace


class Deformation:
    """The template's jets, and their deformations by unknowns: an object with the fields of
    :class:`polysft_mi.surface.patch.Unknowns`, each an array of one axis.

    ``array`` makes the caller's arrays of NumPy's of one axis, of numbers or of indices.
    """

    def __init__(self, template, array):
        self.template, t = template, template
        self._alpha, self._size = array(t.alpha.ravel()), t.alpha.shape[1]
        self.scale = array(np.array([t.scale]))
        self._layers = [_Layer.of(t, m, array) for m in range(t.patch.shape[1])]
        self._xp = namespace(self._alpha)

    def vertices(self, unknowns):
        """The vertices [m, camera frame]."""
        own, *others = self._layers
        found = self._points(own, unknowns, displaced=True)
        if len(self.template) > 1:
            for layer, share in ((own, own.weight - 1), *((x, x.weight) for x in others)):
                at_rest = self._points(layer, unknowns, displaced=False)
                found = [x + share * p for x, p in zip(found, at_rest)]
        return found

    def tangents(self, unknowns):
        """Derivatives of the jets, without relief, along u and along v at the vertices [m per chart
        unit, camera frame], in their own patches.
        """
        own, (alpha, uv, _) = self._layers[0], self._in_chart(self._layers[0], unknowns)
        found = (self._xp.parts_of_each(x) for x in jets.tangents(alpha, uv))
        return [[own.radius * x for x in self._turned(own, t, unknowns)] for t in found]

    def normals(self, unknowns):
        """Unit normals of the jets, without relief, at the vertices [camera frame], in their own
        patches.
        """
        own, (alpha, uv, _) = self._layers[0], self._in_chart(self._layers[0], unknowns)
        return self._turned(own, self._xp.parts_of_each(jets.normal(alpha, uv)), unknowns)

    def metric(self, unknowns):
        """First fundamental form (E, F, G) of the jets, without relief, with respect to (u, v) at
        the vertices [m^2 per chart unit squared], in their own patches.
        """
        a, b = self.tangents(unknowns)
        return _dot(a, a), _dot(a, b), _dot(b, b)

    def _points(self, layer, unknowns, displaced):
        """The vertices as one patch of each has them [m, camera frame]; ``displaced``: with their
        own displacements, which the own patch alone has.
        """
        alpha, uv, height = self._in_chart(layer, unknowns, displaced)
        u, v, z = self._xp.parts_of_each(jets.point(alpha, uv))
        x = self._turned(layer, (u, v, z + height), unknowns)
        t = _times(layer.rotation, self._of_patches(unknowns.translation, layer, 3))
        return [
            origin + layer.radius * a + self.scale * b for origin, a, b in zip(layer.origin, x, t)
        ]

    def _in_chart(self, layer, unknowns, displaced=True):
        """(alpha, uv, height over the jet) of the vertices in one patch of each."""
        alpha = self._xp.take(self._alpha + unknowns.delta_alpha, layer.patch, self._size)
        u, v, height = layer.u, layer.v, layer.rest
        if displaced:
            d = unknowns.delta_u, unknowns.delta_v, unknowns.delta_w
            if layer.to_chart is not None:
                d = *_times(layer.to_chart, d), layer.lift * d[2]
            u, v, height = u + d[0], v + d[1], height + d[2]
        return alpha, self._xp.each([u, v]), height

    def _turned(self, layer, x, unknowns):
        """R Rot(q) x of vectors x of a chart."""
        turn = jets.rotation_rows(*self._of_patches(unknowns.rotation, layer, 4))
        return _times(layer.rotation, _times(turn, x))

    def _of_patches(self, numbers, layer, size):
        """``size`` numbers of the patch of each vertex."""
        return self._xp.parts(self._xp.take(numbers, layer.patch, size))


@dataclass
class _Layer:
    """One patch of each of the N vertices: ``patch``, ``weight``, the chart's ``u``, ``v`` and the
    ``rest`` over the jet, and its ``lift``; ``to_chart``: two rows that take displacements to the
    chart's u and v, None where they are the chart's own; ``radius``, ``rotation`` (rows) and
    ``origin``: the patch's."""

    patch: Any
    weight: Any
    u: Any
    v: Any
    rest: Any
    lift: Any
    to_chart: Any
    radius: Any
    rotation: Any
    origin: Any

    @classmethod
    def of(cls, t, m, array):
        k = t.patch[:, m]
        unit = t.scale / t.radius[k]
        rows = np.einsum("nji,njk->ikn", t.rotation[k], t.axes) * unit
        return cls(
            array(k),
            *map(array, (t.weight[:, m], *t.chart[:, m].T, t.rest[:, m], unit * t.lift)),
            None if len(t) == 1 else [list(map(array, row)) for row in rows[:2]],
            array(t.radius[k]),
            [list(map(array, row)) for row in t.rotation[k].transpose(1, 2, 0)],
            list(map(array, t.origin[k].T)),
        )


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def _times(rows, x):
    """The product of a matrix, by its rows, and a vector."""
    return [_dot(row, x) for row in rows]
