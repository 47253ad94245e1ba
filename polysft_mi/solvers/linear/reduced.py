"""Normal equations with the unknowns of the vertices eliminated: what is left is small and dense,
and gives the step. NumPy and SciPy only.
"""

from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from .tridiagonal import Blocks

_blocks = lru_cache(8)(Blocks)  # their ordering is made once for a pattern


class Reduced:
    """Normal equations with the local block eliminated under Levenberg-Marquardt's ``damping``:
    ``schur`` (G, G) and ``right`` (G,) remain.

    The elimination is in ``dtype``: single precision will do for a step, which is tried and then
    kept or not, in half the time. Raises LinAlgError where the damped local block is not positive
    definite.
    """

    @classmethod
    def of(cls, patterns, normal, damping, dtype=np.float64):
        """From ``patterns``: number of local unknowns to the pattern of their blocks."""
        d = normal.local.shape[-1]
        return cls(_blocks(patterns[d], d), normal, damping, dtype)

    def __init__(self, blocks, normal, damping, dtype=np.float64):
        self.blocks = blocks
        diagonal = blocks.pattern.diagonal
        local = normal.local.copy()
        for k in range(blocks.d):
            main = local[diagonal, k, k]
            local[diagonal, k, k] = main * (1 + damping) + 1e-9 * main.mean()
        self.elimination = blocks.eliminate(
            local, np.column_stack([normal.cross, normal.local_gradient.ravel()]), dtype
        )
        y = self.elimination.columns
        whole = (y.T @ y).astype(np.float64)
        main = np.diag(normal.glob)
        self.schur = normal.glob + np.diag(damping * main + 1e-9 * main.mean()) - whole[:-1, :-1]
        self.right = normal.gradient - whole[:-1, -1]

    def step(self):
        """The step (global (G,), local (N, d)), and the decrease that the model promises. Raises
        LinAlgError where what remains is not positive definite.
        """
        g = self._minimum()
        return (g, self.following(g)), self.promised(g)

    def _minimum(self):
        return -cho_solve(
            cho_factor(self.schur, check_finite=False), self.right, check_finite=False
        )

    def promised(self, g):
        """The decrease that the model promises of the step to its minimum, whose global unknowns
        are ``g`` (G,).
        """
        y = self.elimination.columns[:, -1]
        return 0.5 * float(y @ y - g @ self.right)

    def following(self, g):
        """The step (N, d) of the local unknowns that goes with a step (G,) of the global ones."""
        y = self.elimination.columns
        return -self.elimination.back(y[:, -1] + y[:, :-1] @ g).reshape(-1, self.blocks.d)

    def slide(self):
        """The step (N, d) of the local unknowns alone."""
        return -self.elimination.back(self.elimination.columns[:, -1]).reshape(-1, self.blocks.d)

    def variance(self, by_local, by_global):
        """The diagonal of J H^-1 J^T (N,), where row i of J has the derivatives ``by_local`` (N, d)
        by the vertex's own unknowns and ``by_global`` (N, G).
        """
        solved = self.elimination.back(self.elimination.columns[:, :-1]).reshape(
            *by_local.shape, -1
        )
        rows = by_global - np.einsum("na,nag->ng", by_local, solved)
        half = solve_triangular(
            np.linalg.cholesky(self.schur), rows.T, lower=True, check_finite=False
        )
        return (half * half).sum(0) + np.einsum(
            "na,nab,nb->n", by_local, self.elimination.inverse_diagonal(), by_local
        )
