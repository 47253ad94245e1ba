"""Sparse symmetric matrices over a mesh, factorised as block tridiagonal ones. NumPy and LAPACK."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from . import lapack

# rows a block below which one thread is faster than two, which pass Python's lock to and fro
_WORTH_A_THREAD = 100
_other = ThreadPoolExecutor(1, "elimination")


class Blocks:
    """A symmetric matrix with the pattern's d x d blocks, factorised as block tridiagonal in the
    narrow ordering, by LAPACK.

    On these narrow meshes that is faster than general sparse Cholesky, above all with many
    right-hand sides (``benchmarks/factorisation.py``). It is done from both ends at once, by two
    threads, which meet in the middle.
    """

    def __init__(self, pattern, d=2):
        self.pattern, self.d = pattern, d
        row, column = pattern.place[pattern.row], pattern.place[pattern.column]
        width = max(8, int(np.abs(row - column).max()))  # vertices a block
        self.count = -(-pattern.count // width)
        self.width = width
        self.size = size = d * width
        self.middle = self.count // 2
        self.chains = (
            range(self.middle),
            range(self.count - 1, self.middle, -1),
        )  # of blocks, towards the middle
        each = np.arange(d)
        at = (
            d * row[:, None, None] + each[None, :, None],
            d * column[:, None, None] + each[None, None, :],
        )
        r, c = (np.broadcast_to(x, (len(row), d, d)) for x in at)
        part, down = r // size, c // size
        self._inside = np.flatnonzero(
            (part == down) & (r >= c)
        )  # LAPACK reads the lower triangle alone
        self._beside = np.flatnonzero(
            part == down - np.sign(down - self.middle)
        )  # rows of the next block towards the middle
        # each block in Fortran order, those beside transposed
        self._at_inside = ((part * size + c % size) * size + r % size).ravel()[self._inside]
        self._at_beside = ((down * size + r % size) * size + c % size).ravel()[self._beside]
        self._order = (d * pattern.order[:, None] + each).ravel()

    def rows(self, k):
        """The rows of block k, a slice; its size is the blocks' but for the last one's."""
        return slice(k * self.size, min((k + 1) * self.size, self.d * self.pattern.count))

    def following(self, k):
        """The next block after k towards the middle."""
        return k + (1 if k < self.middle else -1)

    def run_chains(self, run):
        """Run either chain of blocks, the second in a thread of its own where blocks are large
        enough to be worth it.
        """
        first, second = self.chains
        if self.size < _WORTH_A_THREAD:
            run(first)
            run(second)
            return
        other = _other.submit(run, second)
        try:
            run(first)
        finally:
            failed = other.exception()  # waits
        if failed:
            raise failed

    def eliminate(self, blocks, columns, dtype=np.float64):
        """Factorise (B, d, d) = L L^T: returns an :class:`Elimination` with L^-1 columns for
        columns (dN, C), in ``dtype``. Raises LinAlgError where it is not positive.
        """
        values, shape = blocks.ravel(), (self.count, self.size, self.size)
        inside, beside = (np.zeros(shape, dtype) for _ in range(2))
        inside.ravel()[self._at_inside] = values[self._inside]
        beside.ravel()[self._at_beside] = values[self._beside]
        parts = [self.rows(k) for k in range(self.count)]
        sizes = [part.stop - part.start for part in parts]
        factors = [block.T[:n, :n] for block, n in zip(inside, sizes)]
        coupling = [None] * self.count
        y = columns.astype(dtype)[self._order]

        def run(chain):
            for k in chain:
                following = self.following(k)
                lapack.cholesky(factors[k])
                lapack.solve(factors[k], y[parts[k]].T, transposed=True, right=True)
                coupling[k] = w = beside[k].T[: sizes[k], : sizes[following]]
                lapack.solve(factors[k], w)
                if following != self.middle:
                    lapack.subtract_square(factors[following], w)
                    y[parts[following]] -= w.T @ y[parts[k]]

        self.run_chains(run)
        for k in (chain[-1] for chain in self.chains if chain):
            lapack.subtract_square(factors[self.middle], coupling[k])
            y[parts[self.middle]] -= coupling[k].T @ y[parts[k]]
        lapack.cholesky(factors[self.middle])
        lapack.solve(factors[self.middle], y[parts[self.middle]].T, transposed=True, right=True)
        return Elimination(self, factors, coupling, y)


class Elimination:
    """L of a factorised matrix, block by block: on the diagonal, and beside it towards the middle
    (transposed); and ``columns``, L^-1 times those given."""

    def __init__(self, blocks, factors, coupling, columns):
        self.blocks, self.factors, self.coupling, self.columns = blocks, factors, coupling, columns

    def back(self, y):
        """L^-T y, (dN,) or (dN, C), in the order of the vertices."""
        blocks = self.blocks
        x = np.array(y.reshape(len(y), -1), dtype=self.columns.dtype, order="C")

        def solve(k):
            lapack.solve(self.factors[k], x[blocks.rows(k)].T, right=True)

        def run(chain):
            for k in reversed(chain):
                x[blocks.rows(k)] -= self.coupling[k] @ x[blocks.rows(blocks.following(k))]
                solve(k)

        solve(blocks.middle)
        blocks.run_chains(run)
        out = np.empty_like(x)
        out[blocks._order] = x
        return out.reshape(y.shape)

    def inverse_diagonal(self):
        """The blocks on the diagonal of the inverse, (N, d, d)."""
        blocks, size = self.blocks, self.blocks.size
        found = np.zeros((blocks.count, size, size), self.columns.dtype)

        def fill(k, following=None):
            factor = self.factors[k]
            lower = factor.copy(order="F")
            lapack.inverse(lower)
            found[k, : len(lower), : len(lower)] = np.tril(lower) + np.tril(lower, -1).T
            if following is not None:
                w = self.coupling[k].copy(order="F")
                lapack.solve(factor, w, transposed=True)
                n = w.shape[1]
                found[k, : len(w), : len(w)] += w @ found[following, :n, :n] @ w.T

        def run(chain):
            for k in reversed(chain):
                fill(k, blocks.following(k))

        fill(blocks.middle)
        blocks.run_chains(run)
        part, at = np.divmod(blocks.d * blocks.pattern.place, size)
        each = np.arange(blocks.d)
        return found[
            part[:, None, None], at[:, None, None] + each[:, None], at[:, None, None] + each
        ]
