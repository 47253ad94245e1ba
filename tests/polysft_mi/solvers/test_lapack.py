"""LAPACK without Python's lock, against NumPy."""

import threading

import numpy as np
import pytest
from scipy.linalg import LinAlgError

from polysft_mi.solvers.linear import lapack

RNG = np.random.default_rng(8)
TOLERANCE = {np.float32: 1e-4, np.float64: 1e-11}


def positive(n, dtype, room=0):
    """(a view (n, n) in Fortran order whose columns lie n + room apart, the same as an ordinary
    array in float64).
    """
    a = RNG.normal(size=(n, 2 * n))
    a = a @ a.T / n
    held = np.full((n + room, n + room), np.nan, dtype, order="F")
    held[:n, :n] = a
    return held[:n, :n], a.astype(dtype).astype(np.float64)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("room", [0, 3])
def test_factor_solve_inverse_and_square(dtype, room):
    a, whole = positive(7, dtype, room)
    above = np.triu(a, 1).copy()
    lapack.cholesky(a)
    low, close = np.linalg.cholesky(whole), dict(atol=TOLERANCE[dtype], rtol=0)
    assert np.allclose(np.tril(a), low, **close) and np.array_equal(np.triu(a, 1), above)
    for transposed in (False, True):
        left = low.T if transposed else low
        b = np.asfortranarray(RNG.normal(size=(7, 4)).astype(dtype))
        expected = np.linalg.solve(left, b.astype(np.float64))
        lapack.solve(a, b, transposed=transposed)
        assert np.allclose(b, expected, **close)
        b = np.asfortranarray(RNG.normal(size=(4, 7)).astype(dtype))
        expected = b.astype(np.float64) @ np.linalg.inv(left)
        lapack.solve(a, b, transposed=transposed, right=True)
        assert np.allclose(b, expected, **close)
    w, (c, before) = (
        np.asfortranarray(RNG.normal(size=(5, 7)).astype(dtype)),
        positive(7, dtype, room),
    )
    lapack.subtract_square(c, w)
    assert np.allclose(np.tril(c), np.tril(before - w.T.astype(np.float64) @ w), **close)
    lapack.inverse(a)
    assert np.allclose(np.tril(a), np.tril(np.linalg.inv(whole)), atol=100 * TOLERANCE[dtype])


def test_what_cannot_be_factorised_is_refused():
    with pytest.raises(LinAlgError, match="not positive definite"):
        lapack.cholesky(np.asfortranarray(-np.eye(3)))
    with pytest.raises(LinAlgError, match="singular"):
        lapack.inverse(np.zeros((3, 3), order="F"))
    with pytest.raises(ValueError, match="Fortran order"):
        lapack.cholesky(np.ones((3, 3))[:, ::2])


def test_python_goes_on_meanwhile():
    """The lock is free during a call: another thread counts while a large matrix is factorised."""
    a, counted, done = positive(1500, np.float64)[0], [0], threading.Event()

    def count():
        while not done.is_set():
            counted[0] += 1

    other = threading.Thread(target=count)
    other.start()
    before = counted[0]
    lapack.cholesky(a)
    within = counted[0] - before
    done.set()
    other.join()
    assert within > 1000
