"""How fast the linear systems of a simulation are solved: by conjugate gradients, with the
garment's patches and without, and by sparse direct factorisations.

    pip install qdldl cholespy                          # for this benchmark only, each if wanted
    python benchmarks/onefit_solver.py                  # skirt in a jumping jack, T-shirt boxing
    python benchmarks/onefit_solver.py --garments shirt.obj --motions dance

Every so many systems of a simulation are kept, and solved again from the same starts. Columns:
*residual*, its norm relative to the right-hand side's, and *error*, the energy norm of what is
left, relative to that of the solution, geometric means; *ms* of the processor for a solution, the
median. A factorisation's has its ordering, for each step has other contacts. SuperLU comes with
SciPy; CHOLMOD is that of the package cholespy.
"""

import argparse
import importlib.util
import time

import numpy as np
from onefit_accuracy import SEED
from scipy.sparse import bsr_matrix, coo_matrix, triu
from scipy.sparse.linalg import splu

import onefit
from onefit.physics import cloth
from onefit.physics.solver import Solver
from polyfit.errors import cli

EVERY = 23  # one system in so many is kept
ITERATIONS = (5, 10, 20, 40, 60)
HEAD = "| garment | motion | solver | residual | error | ms |"


class _Keeping(Solver):
    """A solver that keeps some of the systems that it solves."""

    systems: list = []
    count = 0

    def __init__(self, first, column, patches=None):
        super().__init__(first, column, patches)
        self.of = first, column, patches

    def couple(self, *pairs):
        super().couple(*pairs)
        self.pairs = pairs

    def solve(self, b, start, *limits):
        _Keeping.count += 1
        if _Keeping.count % EVERY == 0:
            arrays = self.block.numpy(), b, start
            _Keeping.systems.append((self.of, self.pairs, *(a.copy() for a in arrays)))
        return super().solve(b, start, *limits)


def solved(system, iterations, patches, tolerance=0.0):
    """The solution (N, 3) [m] of a system, the seconds it took, and the solver."""
    (first, column, of), pairs, block, b, start = system
    solver = Solver(first, column, of if patches else None)
    solver.block.numpy()[:] = block
    solver.couple(*pairs)
    began = time.process_time()
    x, _ = solver.solve(b, start, iterations, tolerance)
    return x, time.process_time() - began, solver


def matrix(system):
    """The sparse matrix (3 N, 3 N) of a system, with what contacts couple."""
    (first, column, _), (corners, weights, between), block, b, _ = system
    one, two = np.nonzero(~np.eye(4, dtype=bool))
    shares = (weights[:, one] * weights[:, two])[:, :, None, None] * between[:, None]
    place = lambda which, axis: (
        3 * corners[:, which, None, None].astype(int)
        + np.expand_dims(np.arange(3), 1 - axis)
        + np.zeros((3, 3), int)
    ).ravel()
    size = 3 * len(b)
    pairs = coo_matrix((shares.ravel(), (place(one, 0), place(two, 1))), (size, size))
    return (bsr_matrix((block, column, first), shape=(size, size)) + pairs).tocsc()


def superlu(A, b):
    factor = splu(
        A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return factor.solve(b)


def by_qdldl(A, b):
    import qdldl

    return qdldl.Solver(triu(A, format="csc"), upper=True).solve(b)


def cholmod(A, b):
    import cholespy

    coo, x = A.tocoo(), np.zeros_like(b)
    rows, columns = coo.row.astype(np.int32), coo.col.astype(np.int32)
    solver = cholespy.CholeskySolverD(len(b), rows, columns, coo.data, cholespy.MatrixType.COO)
    solver.solve(b, x)
    return x


DIRECT = {"SuperLU": superlu, "qdldl": by_qdldl, "CHOLMOD": cholmod}
PACKAGES = {"qdldl": "qdldl", "CHOLMOD": "cholespy"}


def rows(garment, motion):
    """A row for each way to solve."""
    exact, found = [], {}
    for system in _Keeping.systems:
        x, _, solver = solved(system, 2000, True, 1e-12)
        A, b = matrix(system), system[3]
        assert np.allclose(A @ x.ravel(), solver.product(x).ravel(), atol=1e-9 * abs(b).max())
        exact.append((x, A, np.vdot(x, solver.product(x))))

    def note(name, x, seconds, of):
        right, A, size = of
        left = (x - right).ravel()
        b = A @ right.ravel()
        residual = np.linalg.norm(A @ left) / np.linalg.norm(b)
        error = np.sqrt(max(left @ (A @ left), 1e-32 * size) / size)
        found.setdefault(name, []).append((max(residual, 1e-16), error, seconds))

    for iterations in ITERATIONS:
        for patches in (False, True):
            name = f"{iterations} iterations{', patches' if patches else ''}"
            for system, of in zip(_Keeping.systems, exact):
                x, seconds, _ = solved(system, iterations, patches)
                note(name, x, seconds, of)
    for name, solve in DIRECT.items():
        if importlib.util.find_spec(PACKAGES.get(name, "scipy")) is None:
            continue
        for system, of in zip(_Keeping.systems, exact):
            b, began = system[3].ravel(), time.process_time()
            x = solve(of[1], b)
            note(name, x.reshape(-1, 3), time.process_time() - began, of)
    for name, values in found.items():
        residual, error = np.exp(np.log(values).mean(axis=0))[:2]
        cells = f"{residual:.1e} | {error:.1e} | {1e3 * np.median(values, axis=0)[2]:.1f}"
        print(f"| {garment} | {motion} | {name} | {cells} |", flush=True)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", nargs="+", default=["skirt", "tshirt"])
    parser.add_argument("--motions", nargs="+", default=["jumping_jack", "box"], metavar="KIND")
    parser.add_argument("--seconds", type=float, default=0.7, help="of a motion (default: 0.7)")
    args = parser.parse_args(argv)
    draper, cloth.Solver = onefit.load(), _Keeping
    print(HEAD, "|---" * (HEAD.count("|") - 1) + "|", sep="\n")
    for garment, kind in zip(args.garments, args.motions):
        _Keeping.systems.clear()
        motion = onefit.Motion.generate(kind, seconds=args.seconds, seed=SEED)
        draper.simulate(garment, motion)
        rows(garment, kind)


if __name__ == "__main__":
    cli(main)
