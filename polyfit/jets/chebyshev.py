"""What fits of jets share: the box of the points, Chebyshev polynomials in it, their change to
monomials, and which order points determine. Of arrays of NumPy or torch, float64.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.special import binom

from . import jet
from .backends import namespace
from .monomials import exponents

# A coefficient counts as determined where its basis function, over the weighted points, keeps this
# RMS after those before it are projected out.
DETERMINED_RMS = 1e-5
# The box of the points is at least this wide, as a share of its longer side: rounding across a
# straight line is not stretched into a patch.
_MIN_BOX_RATIO = 1e-2


@dataclass(frozen=True)
class Box:
    """Centre and half extent (..., 2) of the points' u and v."""

    centre: Any
    half: Any

    @classmethod
    def of(cls, uv: Any) -> "Box":
        """Of coordinates (2, ..., P)."""
        m = namespace(uv).module
        low, high = m.amin(uv, -1), m.amax(uv, -1)
        half = ((high - low) / 2).T
        half = m.maximum(half, _MIN_BOX_RATIO * m.amax(half, -1)[..., None])
        return cls(((low + high) / 2).T, m.where(half > 0, half, 1))

    def normalised(self, uv: Any) -> Any:
        """The coordinates (2, ..., P) in the box, from -1 to 1."""
        return (uv - self.centre.T[..., None]) * (1 / self.half.T[..., None])

    def to_monomials(self, coefficients: Any, order: int) -> Any:
        """Coefficients (..., A) of T_a(x) T_b(y) turned into those of u^a v^b."""
        U, V = self._axes(order)
        return jet.from_matrix(U.mT @ jet.matrix(coefficients) @ V)

    def to_monomials_transposed(self, coefficients: Any, order: int) -> Any:
        """The transposed map of :meth:`to_monomials`, for gradients."""
        U, V = self._axes(order)
        return jet.from_matrix(U @ jet.matrix(coefficients) @ V.mT)

    def _axes(self, order: int) -> Any:
        """For u and for v (..., n+1, n+1): row a holds T_a((u - centre) / half) in powers of u."""
        xp = namespace(self.centre)
        chebyshev, binomial, power = _chebyshev_in_powers(order, xp, self.centre.device)
        shifted = jet.powers(-self.centre.T, order)[..., power] * binomial
        return chebyshev @ (shifted * jet.powers(1 / self.half.T, order)[..., None])


@lru_cache
def _chebyshev_in_powers(order: int, xp: Any, device: Any) -> tuple[Any, ...]:
    """Chebyshev polynomials in powers of x; and of (x - c)^m, for each power x^i, the binomial
    coefficient and the power of -c: (n+1, n+1) each."""
    rows = np.zeros((order + 1, order + 1))
    for k in range(order + 1):
        rows[k, : k + 1] = chebyshev.cheb2poly(np.eye(order + 1)[k])[: k + 1]
    m, i = np.indices(rows.shape)
    return tuple(xp.constant(x, device) for x in (rows, binom(m, i), np.maximum(m - i, 0)))


def values(x: Any, order: int) -> Any:
    """T_0 .. T_n of x (...), n at least 1: (n+1, ...)."""
    m = namespace(x).module
    out = m.empty((order + 1, *x.shape), dtype=x.dtype, device=x.device)
    out[0], out[1] = 1, x
    twice = 2 * x
    for k in range(2, order + 1):
        row = m.multiply(twice, out[k - 1], out=out[k])
        row -= out[k - 2]
    return out


def determined_order(short: Any, order: int) -> Any:
    """The highest order (...,) below which none of the coefficients of jets of ``order`` is
    ``short`` (..., A) of points.
    """
    xp = namespace(short)
    degree = xp.constant(exponents(order).sum(1), short.device)
    return xp.module.amin(xp.module.where(short, degree, order + 1), -1) - 1
