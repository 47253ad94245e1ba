"""The linear algebra of a step: sparse blocks of the vertices' unknowns are eliminated, the small
dense rest is solved. In: normal equations. Out: a step, or variances. NumPy, SciPy and LAPACK.
"""

from .reduced import Reduced
from .tridiagonal import Blocks, Elimination

__all__ = ["Blocks", "Elimination", "Reduced"]
