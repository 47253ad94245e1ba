"""Temporal consistency: jets and displacements change little from frame to frame (paper, eq. tc).
Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse as sp

from ..operators import DeviceOperator
from .term import Term


class Temporal(Term):
    """k_tc times |δα|^2 + |δuv|^2, δ the difference to the frame before (eq. tc; the relief's
    counts like uv). ``tc_basis``: coefficients are those of the monomials, as in the paper, or of
    products of Legendre polynomials, in which a sheet is about as stiff along all of them.

    Where a frame is held to its anchor (``context.hold``), motions count too.
    """

    name, setting = "temporal", "k_tc"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._atlas = atlas = inputs.atlas
        from_monomials, each = np.linalg.inv(atlas.to_monomials), sp.eye(len(atlas))
        #: (A, A): the form of a jet's differences, as the host has them, that counts
        self.form, to_basis = np.eye(len(from_monomials)), from_monomials
        if inputs.settings.tc_basis == "monomial":
            self.form, to_basis = atlas.to_monomials.T @ atlas.to_monomials, self.form
        self._to_basis, self._to_legendre = (
            DeviceOperator(sp.kron(each, x)) for x in (to_basis, from_monomials)
        )

    @classmethod
    def is_used(cls, settings):
        return settings.k_tc > 0 or settings.smooth > 0

    def energy(self, at):
        if at.context.anchor is None:
            return mi.Float(0)
        from polysft_mi.surface import Unknowns

        anchor = Unknowns.from_numpy(self._atlas.arrays(at.context.anchor))
        value = at.context.tie * self.between(anchor, at.unknowns)
        if at.context.hold:
            value += at.context.hold * self._motion(anchor, at.unknowns)
        return value

    def between(self, a, b):
        """The weighted energy of two Unknowns, a Float of 1, attached."""
        jets = self._to_basis(mi.Float64(b.delta_alpha) - mi.Float64(a.delta_alpha))
        total = dr.sum(dr.square(jets))
        for name in ("delta_u", "delta_v", "delta_w"):
            moved = mi.Float64(getattr(b, name)) - mi.Float64(getattr(a, name))
            total += dr.sum(dr.square(moved))
        return mi.Float(self.weight * total)

    def _motion(self, a, b):
        """The squared difference of jets, rotations [rad] and translations."""
        jets = self._to_legendre(mi.Float64(b.delta_alpha) - mi.Float64(a.delta_alpha))
        moved = mi.Float64(b.translation) - mi.Float64(a.translation)
        at = 4 * dr.arange(mi.UInt32, dr.width(a.rotation) // 4)
        p, q = (
            [dr.gather(mi.Float64, mi.Float64(x.rotation), at + k) for k in range(4)]
            for x in (a, b)
        )
        # the vector part of q p^-1 is the axis times sin of half the angle
        real = sum(x * y for x, y in zip(p, q))
        axis = [
            p[3] * q[i] - q[3] * p[i] + p[j] * q[k] - p[k] * q[j]
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        ]
        sine = dr.sqrt(sum(dr.square(x) for x in axis) + 1e-30)
        angle = 2 * dr.atan2(sine, dr.abs(real))
        return mi.Float(
            dr.sum(dr.square(jets)) + dr.sum(dr.square(moved)) + dr.sum(dr.square(angle))
        )

    def add(self, at):
        anchor, state, normal = at.context.anchor, at.state, at.normal
        if anchor is None:
            return 0.0
        patches, size = state.alpha.shape
        moved = state.difference(anchor)  # (K, A + 6)
        form = at.context.hold * np.eye(size + 6)
        weight = self.weight * at.context.tie
        form[:size, :size] += weight * self.form
        pull = moved @ form
        jets = slice(0, moved.size)
        normal.glob[jets, jets] += np.kron(np.eye(patches), 2 * form)
        normal.gradient[jets] += 2 * pull.ravel()
        energy = float((pull * moved).sum())
        slid = state.offset - anchor.offset
        normal.local_gradient += 2 * weight * slid[:, : at.d]
        for k in range(at.d):
            normal.local[at.diagonal, k, k] += 2 * weight
        return energy + weight * float((slid**2).sum())
