"""How fast the linear systems of a simulation are solved: by conjugate gradients, with the
garment's patches and without, vertex by vertex, and by sparse direct factorisations; and what
barriers would cost beside.

    pip install pyamg qdldl cholespy ipctk              # for this benchmark only, each if wanted
    python benchmarks/onefit_solver.py                  # skirt in a jumping jack, T-shirt boxing
    python benchmarks/onefit_solver.py --garments shirt.obj --motions dance

Every so many systems of a simulation are kept, and solved again from the same starts. Columns:
*residual*, its norm relative to the right-hand side's, and *error*, the energy norm of what is
left, relative to that of the solution, geometric means; *ms* of the processor for a solution, the
median. A factorisation's has its ordering, for each step has other contacts. SuperLU comes with
SciPy; CHOLMOD is that of the package cholespy. *Vertex by vertex* is what vertex block descent
(VBD) does with a quadratic energy: each vertex's own 3x3 system, one after the other, by pyamg.

The second table is of the same frames, garment and body as one mesh, by ipctk: *ms* of the
processor to look for what is nearer than 3 mm, for the barriers' gradient and Hessian, and for the
longest step without a collision to the next frame: once each, an iteration of Newton, beside a
factorisation. *Crossed* says whether the mesh passes through itself, where no barrier can begin.
"""

import argparse
import importlib.util
import itertools
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
SWEEPS = (10, 40, 160)
NEAR = 0.003  # [m]: where barriers begin, as far as a simulation holds cloth from skin
BARRIER_HEAD = "| garment | motion | near | barriers | step | crossed |"
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


def vertex_by_vertex(system, A, sweeps):
    """The solution after so many sweeps of block Gauss-Seidel, forwards and backwards in turns."""
    from pyamg.relaxation.relaxation import block_gauss_seidel

    b, x = system[3].ravel(), system[4].ravel().copy()
    blocks = A.tobsr(blocksize=(3, 3))
    began = time.process_time()
    block_gauss_seidel(blocks, x, b, iterations=sweeps // 2, sweep="symmetric", blocksize=3)
    return x.reshape(-1, 3), time.process_time() - began


def barriers(drape):
    """Seconds of the parts of a Newton iteration with barriers, (3,) medians over the frames of a
    drape, and the share of the frames in which something passes through something.
    """
    import ipctk

    count = drape.vertices.shape[1]
    faces = np.concatenate([drape.faces, drape.body_faces + count]).astype(np.int32)
    frames = np.concatenate([drape.vertices, drape.body], 1).astype(np.float64)
    mesh = ipctk.CollisionMesh(frames[0], ipctk.edges(faces), faces)
    mesh.can_collide = ipctk.make_static_obstacle_filter(count)  # skin meets no skin
    potential, seconds, crossed = ipctk.BarrierPotential(NEAR, 1.0), [], 0
    for now, then in itertools.pairwise(frames):
        crossed += ipctk.has_intersections(mesh, now)
        at = [time.process_time()]
        near = ipctk.NormalCollisions()
        near.build(mesh, now, NEAR)
        at.append(time.process_time())
        potential.gradient(near, mesh, now)
        potential.hessian(near, mesh, now, ipctk.PSDProjectionMethod.CLAMP)
        at.append(time.process_time())
        ipctk.compute_collision_free_stepsize(mesh, now, then)
        at.append(time.process_time())
        seconds.append(np.diff(at))
    return np.median(seconds, axis=0), crossed / len(seconds)


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
    for sweeps in SWEEPS if importlib.util.find_spec("pyamg") else ():
        for system, of in zip(_Keeping.systems, exact):
            x, seconds = vertex_by_vertex(system, of[1], sweeps)
            note(f"vertex by vertex, {sweeps} sweeps", x, seconds, of)
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
    draper, cloth.Solver, drapes = onefit.load(), _Keeping, {}
    print(HEAD, "|---" * (HEAD.count("|") - 1) + "|", sep="\n")
    for garment, kind in zip(args.garments, args.motions):
        _Keeping.systems.clear()
        motion = onefit.Motion.generate(kind, seconds=args.seconds, seed=SEED)
        drapes[garment, kind] = draper.simulate(garment, motion)
        rows(garment, kind)
    if importlib.util.find_spec("ipctk"):
        print("", BARRIER_HEAD, "|---" * (BARRIER_HEAD.count("|") - 1) + "|", sep="\n")
        for names, drape in drapes.items():
            seconds, crossed = barriers(drape)
            times = [f"{1e3 * x:.0f}" for x in seconds]
            print("|", " | ".join([*names, *times, f"{100 * crossed:.0f} %"]), "|", flush=True)


if __name__ == "__main__":
    cli(main)
