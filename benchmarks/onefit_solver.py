"""How fast the linear systems of a simulation are solved, with and without the garment's patches.

    python benchmarks/onefit_solver.py                  # skirt in a jumping jack, T-shirt boxing
    python benchmarks/onefit_solver.py --garments shirt.obj --motions dance

Every so many systems of a simulation are kept, and solved again from the same starts. Columns:
*error*, the energy norm of what is left, relative to that of the solution, a geometric mean; *ms*
of a solution on one thread, the median.
"""

import argparse
import time

import numpy as np
from onefit_accuracy import SEED

import onefit
from onefit.physics import cloth
from onefit.physics.solver import Solver
from polyfit.errors import cli

EVERY = 23  # one system in so many is kept
ITERATIONS = (5, 10, 20, 40, 60)
HEAD = "| garment | motion | iterations | error, no patches | ms | error, patches | ms |"


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
    began = time.perf_counter()
    x, _ = solver.solve(b, start, iterations, tolerance)
    return x, time.perf_counter() - began, solver


def rows(garment, motion):
    """A row for each of ITERATIONS."""
    exact = []
    for system in _Keeping.systems:
        x, _, solver = solved(system, 2000, True, 1e-12)
        exact.append((x, np.vdot(x, solver.product(x))))
    for iterations in ITERATIONS:
        cells = []
        for patches in (False, True):
            errors, times = [], []
            for system, (x, size) in zip(_Keeping.systems, exact):
                found, seconds, solver = solved(system, iterations, patches)
                left = found - x
                errors.append(np.vdot(left, solver.product(left)) / size)
                times.append(1e3 * seconds)
            cells += [f"{np.exp(np.log(errors).mean() / 2):.4f}", f"{np.median(times):.1f}"]
        print(f"| {garment} | {motion} | {iterations} | {' | '.join(cells)} |", flush=True)


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
