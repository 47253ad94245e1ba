"""From second-order models at the vertices to a step in the unknowns of the jet patch: normal
equations, and their elimination. NumPy and SciPy only.

Unknowns of a frame: local ones, the displacements (Δu, Δv) of each of the N vertices or, with its
relief, (Δu, Δv, Δw), d = 2 or 3 of them, sparse like the mesh; and G = A + 6 global ones: the
coefficients in an orthogonal basis, a rotation increment (axis times angle, before the rotation)
and the translation T_c. The first are eliminated, what is left is small and dense.
"""

from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.polynomial import legendre
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.spatial.transform import Rotation

from polyfit.monomials import exponents

from . import lapack


@dataclass
class State:
    """Unknowns of a frame on the host, float64: ``alpha`` (A,), the offset of the coefficients in
    the basis of :class:`Chart`; ``offset`` (N, 3), (Δu, Δv, Δw); ``rotation``: R_c; ``translation``
    (3,): T_c, in the chart's unit."""

    alpha: np.ndarray
    offset: np.ndarray
    rotation: Rotation
    translation: np.ndarray

    def moved(self, step, factor=1.0):
        """The state after a step (global (G,), local (N, d)); coefficients beyond those of the step
        stay, and with d = 2 the relief.
        """
        g, local = step
        alpha, offset = self.alpha.copy(), self.offset.copy()
        alpha[: len(g) - 6] += factor * g[:-6]
        offset[:, : local.shape[1]] += factor * local
        return State(
            alpha,
            offset,
            Rotation.from_rotvec(factor * g[-6:-3]) * self.rotation,
            self.translation + factor * g[-3:],
        )

    def towards(self, other, factor):
        """The state that goes on from this one past ``other``: other + factor (other - self)."""
        turn = (other.rotation * self.rotation.inv()).as_rotvec()
        return State(
            other.alpha + factor * (other.alpha - self.alpha),
            other.offset + factor * (other.offset - self.offset),
            Rotation.from_rotvec(factor * turn) * other.rotation,
            other.translation + factor * (other.translation - self.translation),
        )


@dataclass
class Surface:
    """The vertices (N, 3) [m, world] that a :class:`State` makes, with derivatives.

    ``by_offset`` (N, 3, 3): by (Δu, Δv, Δw), of which the last, ``up`` (3,), is the same
    everywhere; by the coefficients: ``up`` times ``basis`` (N, A); by rotation and translation:
    ``by_motion`` (N, 3, 6).
    """

    vertices: np.ndarray
    by_offset: np.ndarray
    up: np.ndarray
    basis: np.ndarray
    by_motion: np.ndarray


class Chart:
    """The template's jet on the host, in a basis of products of Legendre polynomials, which stays
    well conditioned to order 14.
    """

    def __init__(self, template):
        self.template = template
        self.order = template.order
        powers = exponents(self.order)
        self.degree = powers.sum(1)  # of each coefficient
        self._u, self._v = powers.T
        self.to_monomials = _legendre_to_monomials(self.order)
        self._from_monomials = np.linalg.inv(self.to_monomials)
        self._alpha = self._from_monomials @ template.alpha
        self._axes = template.scale * template.rotation  # chart to world
        # the derivative of sum c_k P_k has the coefficients D c
        derivative = [
            np.pad(legendre.legder(row), (0, self.order + 1))[: self.order + 1]
            for row in np.eye(self.order + 1)
        ]
        self._derivative = np.array(derivative).T
        self.bending = self._bending()

    def size(self, order):
        """How many coefficients a jet of ``order`` has."""
        return int((self.degree <= order).sum())

    def _bending(self):
        """The mean square of the second derivatives over the unit disc, as a quadratic form of the
        coefficients, (A, A).
        """
        x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 25)])
        x, y = x[x * x + y * y <= 1], y[x * x + y * y <= 1]
        d = self._derivative
        parts = []
        for du, dv, factor in ((2, 0, 1), (1, 1, np.sqrt(2)), (0, 2, 1)):
            pu = legendre.legvander(x, self.order) @ np.linalg.matrix_power(d, du)
            pv = legendre.legvander(y, self.order) @ np.linalg.matrix_power(d, dv)
            parts.append(factor * pu[:, self._u] * pv[:, self._v])
        return sum(p.T @ p for p in parts) / len(x)

    def state(self, arrays):
        """A :class:`State` from the arrays of ``Unknowns.to_numpy``."""
        a = {name: np.asarray(x, dtype=np.float64) for name, x in arrays.items()}
        return State(
            self._from_monomials @ a["delta_alpha"],
            np.stack([a["delta_u"], a["delta_v"], a["delta_w"]], 1),
            Rotation.from_quat(a["rotation"]),
            a["translation"],
        )

    def rigid(self, rotation, translation):
        """(R_c, T_c) that moves the template by p -> R p + t in the world (Rotation, (3,) [m])."""
        t = self.template
        turn = t.rotation.T @ rotation.as_matrix() @ t.rotation
        return (
            Rotation.from_matrix(turn),
            t.rotation.T @ (rotation.apply(t.origin) + translation - t.origin) / t.scale,
        )

    def arrays(self, state):
        """The reverse of :meth:`state`."""
        return {
            "delta_alpha": self.to_monomials @ state.alpha,
            "delta_u": state.offset[:, 0],
            "delta_v": state.offset[:, 1],
            "delta_w": state.offset[:, 2],
            "rotation": state.rotation.as_quat(),
            "translation": state.translation,
        }

    def surface(self, state, order=None):
        """The :class:`Surface` of a state; its derivatives by the coefficients up to ``order``
        (default: all).
        """
        t = self.template
        uv = t.chart + state.offset[:, :2]
        alpha = self._alpha + state.alpha
        matrix = np.zeros((self.order + 1, self.order + 1))
        matrix[self._u, self._v] = alpha
        pu, pv = (legendre.legvander(uv[:, k], self.order) for k in (0, 1))
        along = pu @ matrix
        height = (along * pv).sum(1) + state.offset[:, 2]
        slope = np.stack(
            [
                ((pu @ (self._derivative @ matrix)) * pv).sum(1),
                (along * (pv @ self._derivative)).sum(1),
            ],
            1,
        )
        rotation = state.rotation.as_matrix()
        turn = self._axes @ rotation
        y = np.column_stack([uv, height])
        size = len(self._u) if order is None else self.size(order)
        by_motion = np.empty((len(y), 3, 6))
        by_motion[:, :, 3:] = self._axes
        x = y @ rotation.T
        for k, (a, b) in enumerate(
            ((1, 2), (2, 0), (0, 1))
        ):  # axis k of the chart crossed with the point
            by_motion[:, :, k] = x[:, a, None] * self._axes[:, b] - x[:, b, None] * self._axes[:, a]
        by_offset = np.tile(turn, (len(y), 1, 1))
        by_offset[:, :, :2] += turn[None, :, 2:] * slope[:, None, :]
        return Surface(
            y @ turn.T + (t.origin + self._axes @ state.translation),
            by_offset,
            turn[:, 2],
            pu[:, self._u[:size]] * pv[:, self._v[:size]],
            by_motion,
        )

    def fitted(self, state, vertices, iterations=8, bending=1e-6):
        """The state, from ``state`` on, whose vertices come closest to ``vertices`` (N, 3) [m,
        world], in the least-squares sense.

        Each vertex slides freely in its tangent plane, so that only distances along the normals
        count for the other unknowns. The relief stays as it is.
        """
        size = len(state.alpha)
        prior = np.zeros((size + 6, size + 6))
        prior[:size, :size] = bending * len(vertices) * self.template.scale**2 * self.bending
        for _ in range(iterations):
            surface = self.surface(state)
            missing = vertices - surface.vertices
            tangents = surface.by_offset[:, :, :2]
            normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            rows = np.column_stack(
                [
                    (normal @ surface.up)[:, None] * surface.basis,
                    np.einsum("nk,nkm->nm", normal, surface.by_motion),
                ]
            )
            # sliding makes rotations in the plane and shifts along it free: a little damping holds
            # them
            square = rows.T @ rows + prior
            right = rows.T @ np.einsum("nk,nk->n", normal, missing) - prior[:, :size] @ state.alpha
            g = np.linalg.solve(
                square + 1e-6 * np.trace(square) / len(square) * np.eye(len(square)), right
            )
            rest = (
                missing
                - (surface.basis @ g[:size])[:, None] * surface.up
                - surface.by_motion @ g[size:]
            )
            square = tangents.transpose(0, 2, 1) @ tangents
            uv = np.linalg.solve(square, np.einsum("nka,nk->na", tangents, rest)[:, :, None])[
                :, :, 0
            ]
            state = state.moved((g, uv))
        return state

    def through(self, state, vertices, order):
        """The state with the motion of ``state`` whose vertices are ``vertices`` (N, 3) [m, world]:
        as much of their heights as a jet of ``order`` can hold in the coefficients, the rest in the
        relief."""
        t, turn = self.template, self._axes @ state.rotation.as_matrix()
        y = np.linalg.solve(turn, (vertices - t.origin - self._axes @ state.translation).T).T
        offset = np.column_stack([y[:, :2] - t.chart, y[:, 2]])
        found = State(np.zeros_like(state.alpha), offset, state.rotation, state.translation)
        offset[:, 2] -= self.surface(found).basis @ self._alpha
        return self.absorbed(found, order)

    def absorbed(self, state, order, ridge=1e-6):
        """The state of the same surface with as much of the relief as a jet of ``order`` can hold
        in the coefficients instead; ``ridge`` holds those that the vertices do not determine."""
        size, relief = self.size(order), state.offset[:, 2]
        basis = self.surface(state, order).basis
        held = ridge * len(relief) * (self.bending[:size, :size] + np.eye(size))
        alpha, offset = state.alpha.copy(), state.offset.copy()
        part = np.linalg.solve(basis.T @ basis + held, basis.T @ relief)
        alpha[:size] += part
        offset[:, 2] -= basis @ part
        return State(alpha, offset, state.rotation, state.translation)


def _legendre_to_monomials(order):
    """The matrix (A, A) that takes coefficients of P_{i-j}(u) P_j(v), products of Legendre
    polynomials, to those of the monomials.
    """
    powers = exponents(order)
    leg = [
        np.pad(legendre.leg2poly(row), (0, order - k))
        for k, row in enumerate(np.eye(k + 1)[k] for k in range(order + 1))
    ]
    return np.array([[leg[a][i] * leg[b][j] for a, b in powers] for i, j in powers])


class Pattern:
    """Which vertices of the mesh share an edge, or are one of the ``further`` pairs (P, 2): the
    blocks of every matrix here, in the order of (row, column), and a narrow ordering.
    """

    def __init__(self, faces, edges, count, further=None):
        self.count, self.faces, self.edges = count, faces, edges
        a, b = (edges if further is None else np.concatenate([edges, further])).T
        each = np.arange(count)
        self._keys = np.unique(
            np.concatenate([each * count + each, a * count + b, b * count + a])
        )  # at a vertex of four triangles, pairs repeat
        self.row, self.column = np.divmod(self._keys, count)
        self.start = np.searchsorted(self.row, np.arange(count + 1))
        self.diagonal = self.find(each, each)
        # the U blocks on the diagonal of a symmetric matrix and above it, the others, and of which
        # of the first these are the transposed
        self.upper, self.lower = (
            np.flatnonzero(self.row <= self.column),
            np.flatnonzero(self.row > self.column),
        )
        self._half_keys = self._keys[self.upper]
        self.mirrored = self.find_half(self.column[self.lower], self.row[self.lower])
        self.half_edges = self.find_half(*edges.T)
        self.difference = sp.csr_matrix(  # of the edges' ends, (E, N)
            (
                np.tile([1.0, -1.0], len(edges)),
                (np.repeat(np.arange(len(edges)), 2), edges.ravel()),
            ),
            shape=(len(edges), count),
        )
        self.to_ends = self.difference.T.tocsr()  # sums over the edges at a vertex, with signs
        graph = sp.csr_matrix(
            (np.ones(len(self._keys)), (self.row, self.column)), shape=(count, count)
        )
        order = reverse_cuthill_mckee(graph, symmetric_mode=True)
        self.place = np.empty(count, dtype=np.int64)  # of each vertex in the narrow ordering
        self.place[order] = each
        self.order = order
        self.laplacian = self.blocks_of(
            self.to_ends @ self.difference
        )  # sum over edges of (x_a - x_b)^2

    def blocks_of(self, matrix):
        """A sparse matrix (N, N) within the pattern as one number a block, (B,)."""
        matrix, out = matrix.tocoo(), np.zeros(len(self._keys))
        out[self.find(matrix.row, matrix.col)] = matrix.data
        return out

    def find(self, i, j):
        """Indices of the blocks (i, j)."""
        return np.searchsorted(self._keys, i * self.count + j)

    def find_half(self, i, j):
        """Indices in the half, (K,), of the blocks (i, j) or, where these lie below the diagonal,
        (j, i).
        """
        return np.searchsorted(self._half_keys, np.minimum(i, j) * self.count + np.maximum(i, j))

    def whole(self, half):
        """All blocks (B, d, d) of the symmetric matrix whose upper ``half`` (U, d, d) is given."""
        out = np.empty((len(self._keys), *half.shape[1:]))
        out[self.upper] = half
        out[self.lower] = half[self.mirrored].transpose(0, 2, 1)
        return out


# rows a block below which one thread is faster than two, which pass Python's lock to and fro
_ALONE = 100
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

    def both(self, run):
        """Run either chain of blocks, the second in a thread of its own where blocks are large
        enough to be worth it.
        """
        first, second = self.chains
        if self.size < _ALONE:
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

        self.both(run)
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

    def only(self, chosen):
        """The same with the columns ``chosen`` alone."""
        return Elimination(self.blocks, self.factors, self.coupling, self.columns[:, chosen])

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
        blocks.both(run)
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
        blocks.both(run)
        part, at = np.divmod(blocks.d * blocks.pattern.place, size)
        each = np.arange(blocks.d)
        return found[
            part[:, None, None], at[:, None, None] + each[:, None], at[:, None, None] + each
        ]


@dataclass
class Normal:
    """Normal equations of a frame: ``local`` (B, d, d), ``cross`` (dN, G), ``glob`` (G, G) and the
    gradient ``local_gradient`` (N, d), ``gradient`` (G,).
    """

    local: np.ndarray
    cross: np.ndarray
    glob: np.ndarray
    local_gradient: np.ndarray
    gradient: np.ndarray


class Reduced:
    """Normal equations with the local block eliminated under Levenberg-Marquardt's ``damping``:
    ``schur`` (G, G) and ``right`` (G,) remain.

    The elimination is in ``dtype``: single precision will do for a step, which is tried and then
    kept or not, in half the time. Raises LinAlgError where the damped local block is not positive
    definite.
    """

    def __init__(self, blocks, normal, damping, dtype=np.float64):
        self.blocks = blocks
        diagonal = blocks.pattern.diagonal
        local = normal.local.copy()
        for k in range(blocks.d):
            main = local[diagonal, k, k]
            local[diagonal, k, k] = main * (1 + damping) + 1e-9 * main.mean()
        self.elimination = blocks.eliminate(
            local, np.column_stack([normal.cross, normal.local_gradient.ravel()]), dtype
        )
        y = self.elimination.columns
        whole = (y.T @ y).astype(np.float64)
        main = np.diag(normal.glob)
        self.schur = normal.glob + np.diag(damping * main + 1e-9 * main.mean()) - whole[:-1, :-1]
        self.right = normal.gradient - whole[:-1, -1]

    def step(self):
        """The step (global (G,), local (N, d)), and the decrease that the model promises. Raises
        LinAlgError where what remains is not positive definite.
        """
        g = self._minimum()
        return (g, self.following(g)), self.promised(g)

    def _minimum(self):
        return -cho_solve(
            cho_factor(self.schur, check_finite=False), self.right, check_finite=False
        )

    def promised(self, g):
        """The decrease that the model promises of the step to its minimum, whose global unknowns
        are ``g`` (G,).
        """
        y = self.elimination.columns[:, -1]
        return 0.5 * float(y @ y - g @ self.right)

    def following(self, g):
        """The step (N, d) of the local unknowns that goes with a step (G,) of the global ones."""
        y = self.elimination.columns
        return -self.elimination.back(y[:, -1] + y[:, :-1] @ g).reshape(-1, self.blocks.d)

    def slide(self):
        """The step (N, d) of the local unknowns alone."""
        return -self.elimination.back(self.elimination.columns[:, -1]).reshape(-1, self.blocks.d)

    def decrease(self):
        """The decrease that :meth:`step` promises, without the step. Raises LinAlgError like it."""
        return self.promised(self._minimum())

    def lower(self, size):
        """The same where only the first ``size`` coefficients, the motion and the local unknowns
        may move.
        """
        keep = np.r_[np.arange(size), np.arange(len(self.right) - 6, len(self.right))]
        part = copy(self)
        part.elimination = self.elimination.only(np.r_[keep, len(self.right)])
        part.schur, part.right = self.schur[np.ix_(keep, keep)], self.right[keep]
        return part

    def without(self, size, alpha):
        """The step (G,) that takes the coefficients from ``size`` on, whose values are ``alpha``
        (A,), to zero, the others following, and the increase that the model expects of it at a
        minimum."""
        high = np.arange(size, len(self.right) - 6)
        rest = np.r_[np.arange(size), np.arange(len(self.right) - 6, len(self.right))]
        g = np.zeros(len(self.right))
        g[high] = -alpha[high]
        pull = self.schur[np.ix_(rest, high)] @ g[high]
        g[rest] = -cho_solve(
            cho_factor(self.schur[np.ix_(rest, rest)], check_finite=False), pull, check_finite=False
        )
        return g, 0.5 * float(g @ self.schur @ g)

    def variance(self, by_local, by_global):
        """The diagonal of J H^-1 J^T (N,), where row i of J has the derivatives ``by_local`` (N, d)
        by the vertex's own unknowns and ``by_global`` (N, G).
        """
        solved = self.elimination.back(self.elimination.columns[:, :-1]).reshape(
            *by_local.shape, -1
        )
        rows = by_global - np.einsum("na,nag->ng", by_local, solved)
        half = solve_triangular(
            np.linalg.cholesky(self.schur), rows.T, lower=True, check_finite=False
        )
        return (half * half).sum(0) + np.einsum(
            "na,nab,nb->n", by_local, self.elimination.inverse_diagonal(), by_local
        )


def hinges(chart, faces):
    """What a height over the chart (N, 2), both in the chart's unit, bends at the H inner edges of
    the mesh with ``faces`` (F, 3): the pairs (H, 2) of vertices that lie across each, and the
    sparse J (H, N) that makes the bends. The sum of their squares is the integral of the squared
    curvature of a roll along the mesh's rows, up to three times that of others; no plane has any.

    After Bergou et al., "A Quadratic Bending Model for Inextensible Surfaces" (SGP 2006).
    """
    start, end, apex = (np.concatenate([faces[:, (k + j) % 3] for k in range(3)]) for j in range(3))
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high, apex = low[order], high[order], apex[order]
    first = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    quads = np.stack([low[first], high[first], apex[first], apex[first + 1]], 1)
    x = chart[quads]

    def across(i, j, k):  # sine and cosine, times the lengths, of the angle at i
        a, b = x[:, j] - x[:, i], x[:, k] - x[:, i]
        return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), (a * b).sum(1)

    (s2, c2), (s3, c3), (t2, d2), (t3, d3) = (
        across(0, 1, 2),
        across(0, 1, 3),
        across(1, 0, 2),
        across(1, 0, 3),
    )
    area = np.maximum(0.5 * (s2 + s3), 1e-12)
    from_0, from_1 = (
        [c / np.maximum(s, 1e-12) for s, c in pair]
        for pair in (((s2, c2), (s3, c3)), ((t2, d2), (t3, d3)))
    )
    rows = np.stack(
        [
            from_1[0] + from_1[1],
            from_0[0] + from_0[1],
            -from_0[0] - from_1[0],
            -from_0[1] - from_1[1],
        ],
        1,
    )
    rows /= np.sqrt(area)[:, None]
    matrix = sp.csr_matrix(
        (rows.ravel(), (np.repeat(np.arange(len(quads)), 4), quads.ravel())),
        shape=(len(quads), len(chart)),
    )
    return quads[:, 2:], matrix
