"""Routines of LAPACK and BLAS, SciPy's own, called without Python's lock, so that two threads can
work at once; SciPy's usual wrappers hold it. All work in place on float32 or float64 arrays in
Fortran order, whose columns may lie further apart than they are long.
"""

import ctypes
from functools import lru_cache

from scipy.linalg import LinAlgError, cython_blas, cython_lapack

_name = ctypes.pythonapi.PyCapsule_GetName
_name.restype, _name.argtypes = ctypes.c_char_p, [ctypes.py_object]
_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


@lru_cache(None)
def _routine(module, name, dtype, arguments):
    """The routine of this name for this type of numbers, taking so many pointers, and the type's
    own one in ctypes.
    """
    letter, number = {"f": ("s", ctypes.c_float), "d": ("d", ctypes.c_double)}[dtype.char]
    capsule = module.__pyx_capi__[letter + name]
    return (
        ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(_pointer(capsule, _name(capsule))),
        number,
    )


def _matrix(a):
    """(address, distance of the columns) of a Fortran-ordered array."""
    down, across = a.strides
    if down != a.itemsize:
        raise ValueError("the array is not in Fortran order")
    return a.__array_interface__["data"][0], _int(across // down)


@lru_cache(1000)
def _int(n):
    return ctypes.byref(ctypes.c_int(n))


def cholesky(a):
    """The lower triangle of a (n, n) becomes L, L L^T = a; what is above it stays. Raises
    LinAlgError where a is not positive definite.
    """
    if not _lower("potrf", a):
        raise LinAlgError("the matrix is not positive definite")


def inverse(a):
    """The lower triangle of a (n, n), holding L, becomes that of (L L^T)^-1. Raises LinAlgError
    where L is singular.
    """
    if not _lower("potri", a):
        raise LinAlgError("the factor is singular")


def _lower(name, a):
    """Run a routine of LAPACK on the lower triangle of a (n, n); whether it could."""
    routine, _ = _routine(cython_lapack, name, a.dtype, 5)
    bad, (address, apart) = ctypes.c_int(0), _matrix(a)
    routine(b"L", _int(len(a)), address, apart, ctypes.byref(bad))
    return not bad.value


def solve(factor, b, transposed=False, right=False):
    """b (n, m) becomes L^-1 b or, ``transposed``, L^-T b; with ``right``, b (m, n) becomes b L^-1
    or b L^-T. ``factor`` (n, n) holds L in its lower triangle."""
    trsm, number = _routine(cython_blas, "trsm", b.dtype, 11)
    (a, apart), (address, between) = _matrix(factor), _matrix(b)
    how = b"R" if right else b"L", b"L", b"T" if transposed else b"N", b"N"
    sizes = _int(b.shape[0]), _int(b.shape[1])
    trsm(*how, *sizes, ctypes.byref(number(1)), a, apart, address, between)


def subtract_square(c, w):
    """The lower triangle of c (n, n) becomes that of c - w^T w; w (m, n)."""
    syrk, number = _routine(cython_blas, "syrk", c.dtype, 10)
    (a, apart), (address, between) = _matrix(w), _matrix(c)
    minus, plus = (ctypes.byref(number(k)) for k in (-1, 1))
    syrk(b"L", b"T", _int(len(c)), _int(len(w)), minus, a, apart, plus, address, between)
