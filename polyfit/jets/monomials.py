"""The monomials of an n-jet and their order (paper, section "PolyFit"). NumPy only:
:mod:`polyfit.jets` has the jets, in torch.
"""

from functools import lru_cache

import numpy as np

# Facts of the jets' least squares, here and for a tracker's template.
# A coefficient counts as determined where its basis function, over the weighted points, keeps this
# RMS after those before it are projected out.
DETERMINED_RMS = 1e-5
# The box of the points is at least this wide, as a share of its longer side: rounding across a
# straight line is not stretched into a patch.
MIN_BOX_RATIO = 1e-2


@lru_cache
def exponents(order: int) -> np.ndarray:
    """Exponents (of u, of v) of the coefficients, shape (A, 2); the same array each time, not to be
    written to.
    """
    return np.array([(i - j, j) for i in range(order + 1) for j in range(i + 1)], dtype=np.int64)


def size_of(order: int) -> int:
    """Number of coefficients A of a jet of ``order``."""
    return (order + 1) * (order + 2) // 2


def order_of(size: int) -> int:
    """Order n of a jet with ``size`` coefficients. Raises ValueError where there is none."""
    order = int((np.sqrt(8 * size + 1) - 3) / 2 + 0.5)
    if size_of(order) != size:
        raise ValueError(f"{size} is not the number of coefficients of a jet")
    return order
