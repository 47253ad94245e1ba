"""``python benchmarks/factorisation.py``: ways to factorise the tracker's sparse uv block with all
its right-hand sides, in milliseconds.

The matrix is that of a sheet's grid (``--grid`` vertices a side) with the tracker's own pattern:
residuals between neighbours, 2 unknowns a vertex, and ``--columns`` right-hand sides (the global
unknowns and the gradient). Libraries that are not installed are left out.
"""

import argparse
import time

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
from threadpoolctl import threadpool_limits

from polysft_mi.solvers.linear import Blocks
from polysft_mi.surface.pattern import Pattern


def grid(side):
    """(faces, edges) of a square grid of side x side vertices."""
    k = np.arange(side * side).reshape(side, side)
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    faces = np.stack([a, b, c, b, d, c], 1).reshape(-1, 3)
    return faces, np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )


def system(pattern, rng):
    """Positive definite blocks (B, 2, 2) of residuals between neighbours."""
    i, j = pattern.edges.T
    a, b = rng.normal(size=(2, len(i), 2))
    at = np.concatenate(
        [pattern.find(i, i), pattern.find(j, j), pattern.find(i, j), pattern.find(j, i)]
    )
    outer = lambda x, y: x[:, :, None] * y[:, None]
    blocks = np.zeros((len(pattern.row), 2, 2))
    np.add.at(blocks, at, np.concatenate([outer(a, a), outer(b, b), outer(a, b), outer(b, a)]))
    blocks[pattern.diagonal] += 0.1 * np.eye(2)
    return blocks


def seconds(run, repeats):
    run()
    began = time.perf_counter()
    for _ in range(repeats):
        run()
    return (time.perf_counter() - began) / repeats


def main():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--grid", type=int, nargs="*", default=[33, 60, 100])
    p.add_argument("--columns", type=int, nargs="*", default=[22, 73])
    p.add_argument("--repeats", type=int, default=5)
    options = p.parse_args()
    print(
        "| vertices | right-hand sides | ours: block tridiagonal, LAPACK | SciPy banded | SuperLU |"
        " cholespy (CHOLMOD) | qdldl |"
    )
    print("|---|---|---|---|---|---|---|")
    for side in options.grid:
        pattern = Pattern(*grid(side), side * side)
        rng = np.random.default_rng(0)
        values = system(pattern, rng)
        blocks = Blocks(pattern)
        n = 2 * pattern.count
        matrix = sp.bsr_matrix((values, pattern.column, pattern.start), shape=(n, n)).tocsc()
        for columns in options.columns:
            right = rng.normal(size=(n, columns))
            cells = [seconds(lambda: blocks.eliminate(values, right), options.repeats)]
            cells += [
                other(matrix, right, blocks, options.repeats)
                for other in (banded, superlu, cholespy, qdldl)
            ]
            print(
                f"| {side * side} | {columns} | "
                + " | ".join("–" if c is None else f"{1e3 * c:.1f}" for c in cells)
                + " |",
                flush=True,
            )


def banded(matrix, right, blocks, repeats):
    order = blocks._order
    m = matrix[order][:, order].tocoo()
    low = m.row >= m.col
    width = int((m.row - m.col).max())

    def run():
        table = np.zeros((width + 1, m.shape[0]))
        table[(m.row - m.col)[low], m.col[low]] = m.data[low]
        return scipy.linalg.cho_solve_banded(
            (scipy.linalg.cholesky_banded(table, lower=True), True), right[order]
        )

    return seconds(run, repeats)


def superlu(matrix, right, blocks, repeats):
    options = {
        "permc_spec": "MMD_AT_PLUS_A",
        "options": {"SymmetricMode": True},
        "diag_pivot_thresh": 0.0,
    }
    return seconds(lambda: scipy.sparse.linalg.splu(matrix, **options).solve(right), repeats)


def cholespy(matrix, right, blocks, repeats):
    try:
        from cholespy import CholeskySolverD, MatrixType
    except ImportError:
        return None
    m = matrix.tocoo()
    out = np.zeros_like(right)
    rows, columns = m.row.astype(np.int32), m.col.astype(np.int32)
    return seconds(
        lambda: CholeskySolverD(m.shape[0], rows, columns, m.data, MatrixType.COO).solve(
            right, out
        ),
        repeats,
    )


def qdldl(matrix, right, blocks, repeats):
    try:
        import qdldl as library
    except ImportError:
        return None
    upper = sp.triu(matrix).tocsc()
    solver = library.Solver(upper, upper=True)

    def run():
        solver.update(upper, upper=True)
        return [solver.solve(column) for column in right.T]

    return seconds(run, repeats)


if __name__ == "__main__":
    with threadpool_limits(1):  # as the tracker does
        main()
