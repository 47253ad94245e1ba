"""NumPy, torch and Dr.Jit by the same few names, so that a formula is written once for all three.

A vector lies along the last axis of an array of NumPy or torch, a matrix along the last two. In
Dr.Jit a vector is a tuple of Floats (or one of Mitsuba's vectors), a matrix a tuple of rows. torch
and Dr.Jit are imported by who has arrays of theirs, not here.
"""

import contextlib
import sys
from functools import lru_cache
from typing import Any

import numpy as np


def namespace(x: Any) -> Any:
    """The operations on arrays like ``x``: an array, or a tuple of Dr.Jit's."""
    if isinstance(x, tuple):
        return namespace(x[0])
    if type(x).__module__.partition(".")[0] in ("drjit", "mitsuba"):
        return DrJit
    torch = sys.modules.get("torch")
    return _arrays_of(torch if torch and isinstance(x, torch.Tensor) else np)


class Arrays:
    """Of ``module``, NumPy or torch."""

    def __init__(self, module: Any) -> None:
        self.module, self.sqrt, self.full_like = module, module.sqrt, module.full_like

    def no_grad(self) -> Any:
        """A context without gradients."""
        return contextlib.nullcontext() if self.module is np else self.module.no_grad()

    def parts(self, x: Any) -> Any:
        """The components of vectors, each an array."""
        return [x[..., k] for k in range(x.shape[-1])]

    def stack(self, parts: Any) -> Any:
        """Vectors of their components."""
        return self.module.stack(parts, -1)

    def each(self, parts: Any) -> Any:
        """Vectors of their components, one for each jet of a batch (B, A): (B, 1, n)."""
        return self.stack(parts)[..., None, :]

    def parts_of_each(self, x: Any) -> Any:
        """The reverse of :meth:`each`."""
        return self.parts(x[..., 0, :])

    def matrix(self, rows: Any) -> Any:
        """Matrices of the components of their rows."""
        return self.module.stack([self.stack(row) for row in rows], -2)

    def size(self, x: Any) -> int:
        """How many components vectors have."""
        return x.shape[-1]

    def square(self, x: Any, side: int, places: Any) -> Any:
        """Matrices (..., side, side) with ``x`` at ``places`` of their flat forms, else zero."""
        out = self.module.zeros((*x.shape[:-1], side * side), dtype=x.dtype, device=x.device)
        out[..., places] = x
        return out.reshape(*x.shape[:-1], side, side)

    def constant(self, numbers: np.ndarray, device: Any) -> Any:
        """NumPy's ``numbers`` on a device."""
        return self.module.asarray(numbers, device=device)

    def dot(self, a: Any, b: Any) -> Any:
        """Scalar products."""
        return (a * b).sum(-1)

    def times(self, vector: Any, matrix: Any) -> Any:
        """Row vectors (..., P, n) times matrices (..., n, n)."""
        return vector @ matrix

    def take(self, x: Any, index: Any, size: int) -> Any:
        """The vectors of ``size`` at ``index``, of ``x``, whose numbers follow each other."""
        return x.reshape(-1, size)[index]


_arrays_of = lru_cache(Arrays)


class DrJit:
    """Of Dr.Jit; see :class:`Arrays`."""

    parts = stack = each = parts_of_each = staticmethod(tuple)
    size = staticmethod(len)

    @staticmethod
    def sqrt(x: Any) -> Any:
        import drjit

        return drjit.sqrt(x)

    @staticmethod
    def full_like(x: Any, value: float) -> Any:
        return type(x)(value)  # a literal: products with 0 and 1 cost nothing

    @staticmethod
    def matrix(rows: Any) -> Any:
        return tuple(map(tuple, rows))

    @staticmethod
    def square(x: Any, side: int, places: Any) -> Any:
        out = [type(x[0])(0)] * side**2
        for value, k in zip(x, places):
            out[k] = value
        return tuple(tuple(out[side * k : side * k + side]) for k in range(side))

    @staticmethod
    def constant(numbers: np.ndarray, device: Any) -> Any:
        return numbers

    @staticmethod
    def dot(a: Any, b: Any) -> Any:
        return sum(x * y for x, y in zip(a, b))

    @staticmethod
    def times(vector: Any, matrix: Any) -> Any:
        return tuple(DrJit.dot(vector, column) for column in zip(*matrix))

    @staticmethod
    def take(x: Any, index: Any, size: int) -> Any:
        """A gather, whose gradient is one scatter in the same kernel, in double so that its order
        does not show.
        """
        import drjit

        double: Any = drjit.float64_array_t(type(x))
        values = double(x)
        return tuple(type(x)(drjit.gather(double, values, size * index + k)) for k in range(size))
