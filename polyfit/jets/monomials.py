"""The monomials of an n-jet and their order (paper, section "PolyFit"). NumPy only."""

from functools import lru_cache

import numpy as np

from polyfit.errors import InputError, as_number


@lru_cache
def exponents(order: int) -> np.ndarray:
    """Exponents (of u, of v) of the coefficients, shape (A, 2); the same array each time, not to be
    written to.
    """
    return np.array([(i - j, j) for i in range(order + 1) for j in range(i + 1)], dtype=np.int64)


def size_of(order: int) -> int:
    """Number of coefficients A of a jet of ``order``."""
    return (order + 1) * (order + 2) // 2


def check_order(order: int) -> int:
    """The ``order`` of a jet. Raises InputError where none of it is fitted: 1 to 10 are."""
    if not (1 <= as_number(order) <= 10 and as_number(order) % 1 == 0):
        raise InputError(f"order = {order!r}; the order of a jet is 1 to 10")
    return int(order)


def order_of(size: int) -> int:
    """Order n of a jet with ``size`` coefficients. Raises InputError where there is none."""
    order = int((np.sqrt(8 * size + 1) - 3) / 2 + 0.5)
    if size_of(order) != size:
        raise InputError(f"{size} is not the number of coefficients of a jet")
    return order
