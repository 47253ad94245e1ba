"""The jet that fits points best, in NumPy: least squares (Cazals & Pouget 2003) in products of
Chebyshev polynomials in the points' box. :mod:`polyfit.jets.batches` fits batches, in torch.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .chebyshev import DETERMINED_RMS, Box, determined_order, values
from .monomials import exponents, size_of


@dataclass(frozen=True)
class JetFit:
    """``alpha`` (..., A): the coefficients, zero beyond the order fitted. ``order`` (...,) int64:
    the order that the points determine, at most the one asked for; 0 is a constant."""

    alpha: Any
    order: Any


def fit_points(points: np.ndarray, order: int, ridge: float = 0.0) -> JetFit:
    """The jet of ``order``, or of the highest order that they determine, through ``points`` (P, 3)
    of a chart; ``ridge``, of the points' mean square, holds its coefficients in the basis.
    """
    x, (a, b) = points.T, exponents(order).T
    box = Box.of(x[:2])
    tu, tv = values(box.normalised(x[:2]), order).swapaxes(0, 1)
    basis = (tu[a] * tv[b]).T / np.sqrt(len(points))
    kept = np.zeros(len(a))
    diagonal = np.abs(np.diagonal(np.linalg.qr(basis, mode="r")))
    kept[: len(diagonal)] = diagonal
    fitted = int(determined_order(kept < DETERMINED_RMS, order))
    size = size_of(fitted)
    rows = np.concatenate([basis[:, :size], np.sqrt(ridge) * np.eye(size)[: size if ridge else 0]])
    right = np.zeros(len(rows))
    right[: len(points)] = x[2] / np.sqrt(len(points))
    solution = np.zeros(len(a))
    solution[:size] = np.linalg.lstsq(rows, right, rcond=None)[0]
    return JetFit(box.to_monomials(solution, order), fitted)
