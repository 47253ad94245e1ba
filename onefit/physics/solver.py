"""The linear system of an implicit step: conjugate gradients, preconditioned by symmetric
Gauss-Seidel sweeps, and deflated by the motions of the garment's patches.

A sweep carries a force from a vertex to its neighbours only: a pull on a cuff needs as many
iterations as the sleeve has rows of vertices. So each iteration also solves, exactly, for one
translation of each patch (Nicolaides 1987): a small system, with a block for each pair of patches
that touch.

All matrices have 3 x 3 blocks [N/m]. On the CPU each kernel is one compiled loop.
"""

# Warp's kernels have its own types
# mypy: disable-error-code="valid-type"
import numpy as np
from scipy.sparse import bsr_matrix

from .kernels import ints, mat3, real, reals, vec3, wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class _Mesh:
    """The symmetric matrix A, N x N blocks, where two vertices share an edge."""

    first: wp.array(dtype=int)  # (N + 1,): row i has the blocks first[i] to first[i + 1]
    middle: wp.array(dtype=int)  # (N,): where its diagonal block D_i lies
    column: wp.array(dtype=int)
    block: wp.array(dtype=mat3)
    inverse: wp.array(dtype=mat3)  # (N,): of the D_i


@wp.struct
class _Pairs:
    """C, what contacts couple beyond A, which has their blocks of each corner with itself."""

    corners: wp.array2d(dtype=int)  # (P, 4)
    weights: wp.array2d(dtype=real)
    block: wp.array(dtype=mat3)


@wp.struct
class _Patches:
    """Z, which moves all vertices of a patch alike; W = A Z; E = Z^T (A + C) Z = L D L^T."""

    of: wp.array(dtype=int)  # (N,): the patch of each vertex
    first: wp.array(dtype=int)  # (N + 1,): row i of W has the blocks first[i] to first[i + 1]
    column: wp.array(dtype=int)
    block: wp.array(dtype=mat3)
    into: wp.array(dtype=int)  # to which block of W each block of A belongs
    least: wp.array(dtype=int)  # (K,): the first column of each row of E, without contacts
    start: wp.array(dtype=int)  # (K,): and with them
    factor: wp.array2d(dtype=mat3)  # (K, K): E, then L, from start on, below the diagonal
    inverse: wp.array(dtype=mat3)  # (K,): of D
    y: wp.array(dtype=vec3)  # (K,)


@wp.func
def _patch(pairs: _Pairs, patches: _Patches, c: int, k: int):
    """The patch of corner k of contact c."""
    return patches.of[pairs.corners[c, k]]


@wp.func
def _add_coupled(pairs: _Pairs, x: wp.array(dtype=vec3), out: wp.array(dtype=vec3)):
    """out += C x."""
    for c in range(pairs.corners.shape[0]):
        at = vec3()
        for k in range(4):
            at += pairs.weights[c, k] * x[pairs.corners[c, k]]
        for k in range(4):
            v = pairs.corners[c, k]
            weight = pairs.weights[c, k]
            out[v] = out[v] + pairs.block[c] * (weight * (at - weight * x[v]))


@wp.func
def _take_moved(
    pairs: _Pairs, patches: _Patches, back: wp.array(dtype=vec3), out: wp.array(dtype=vec3)
):
    """out -= (A + C) Z y; ``back`` receives -Z y."""
    for i in range(out.shape[0]):
        back[i] = -patches.y[patches.of[i]]
        r = out[i]
        for k in range(patches.first[i], patches.first[i + 1]):
            r -= patches.block[k] * patches.y[patches.column[k]]
        out[i] = r
    _add_coupled(pairs, back, out)


@wp.func
def _gather(patches: _Patches, coupled: wp.array(dtype=vec3), x: wp.array(dtype=vec3)):
    """y = Z^T (A + C) x, where ``coupled`` is C x."""
    for p in range(patches.y.shape[0]):
        patches.y[p] = vec3()
    for i in range(x.shape[0]):
        p = patches.of[i]
        patches.y[p] = patches.y[p] + coupled[i]
        for k in range(patches.first[i], patches.first[i + 1]):
            q = patches.column[k]
            patches.y[q] = patches.y[q] + wp.transpose(patches.block[k]) * x[i]


@wp.func
def _solve_patches(patches: _Patches):
    """y = E^-1 y."""
    count = patches.y.shape[0]
    for p in range(count):
        r = patches.y[p]
        for q in range(patches.start[p], p):
            r -= patches.factor[p, q] * patches.y[q]
        patches.y[p] = r
    for p in range(count):
        patches.y[p] = patches.inverse[p] * patches.y[p]
    for back in range(count):
        p = count - 1 - back
        for q in range(patches.start[p], p):
            patches.y[q] = patches.y[q] - wp.transpose(patches.factor[p, q]) * patches.y[p]


@wp.kernel
def _factorise(mesh: _Mesh, pairs: _Pairs, patches: _Patches):
    """W, and E = L D L^T in the rows' envelopes, of the patches. One thread."""
    count = patches.y.shape[0]
    for p in range(count):
        patches.start[p] = patches.least[p]
    for c in range(pairs.corners.shape[0]):
        for a in range(4):
            for b in range(4):
                one = _patch(pairs, patches, c, a)
                patches.start[one] = wp.min(patches.start[one], _patch(pairs, patches, c, b))
    for p in range(count):
        for q in range(patches.start[p], p + 1):
            patches.factor[p, q] = mat3()
    for k in range(patches.block.shape[0]):
        patches.block[k] = mat3()
    for k in range(mesh.block.shape[0]):
        patches.block[patches.into[k]] = patches.block[patches.into[k]] + mesh.block[k]
    for i in range(patches.of.shape[0]):
        own = patches.of[i]
        for k in range(patches.first[i], patches.first[i + 1]):
            other = patches.column[k]
            if other <= own:
                patches.factor[own, other] = patches.factor[own, other] + patches.block[k]
    for c in range(pairs.corners.shape[0]):
        for a in range(4):
            for b in range(4):
                one = _patch(pairs, patches, c, a)
                two = _patch(pairs, patches, c, b)
                if a != b and two <= one:
                    both = pairs.weights[c, a] * pairs.weights[c, b] * pairs.block[c]
                    patches.factor[one, two] = patches.factor[one, two] + both
    for p in range(count):
        for q in range(patches.start[p], p):  # L_pq D_q
            r = patches.factor[p, q]
            for m in range(wp.max(patches.start[p], patches.start[q]), q):
                r -= patches.factor[p, m] * wp.transpose(patches.factor[q, m])
            patches.factor[p, q] = r
        middle = patches.factor[p, p]
        for q in range(patches.start[p], p):
            below = patches.factor[p, q]
            patches.factor[p, q] = below * patches.inverse[q]
            middle -= patches.factor[p, q] * wp.transpose(below)
        patches.inverse[p] = wp.inverse(middle)


@wp.kernel
def _conjugate_gradients(
    mesh: _Mesh,
    pairs: _Pairs,
    patches: _Patches,
    iterations: int,
    tolerance: real,  # of the residual's norm, relative to the right-hand side's
    b: wp.array(dtype=vec3),  # overwritten
    x: wp.array(dtype=vec3),  # start, and result
    change: wp.array(dtype=vec3),
    p: wp.array(dtype=vec3),
    t: wp.array(dtype=vec3),
    w: wp.array(dtype=vec3),
    u: wp.array(dtype=vec3),
    done: wp.array(dtype=int),  # receives the number of iterations
):
    """(A + C) x = b. One thread.

    With A = L + D + L^T: CG on (D + L)^-1 (A + C - F) (D + L^T)^-1, preconditioned by D, where
    F = (A + C) Z E^-1 Z^T (A + C) takes away what patches do for themselves. In Eisenstat's form
    (1981) a sweep back and one forward do for the product with A, too; C and F are products more.
    """
    n = x.shape[0]
    zero = real(0.0)
    size = zero
    for i in range(n):
        mesh.inverse[i] = wp.inverse(mesh.block[mesh.middle[i]])
        size += wp.dot(b[i], mesh.inverse[i] * b[i])
        u[i] = vec3()
        change[i] = vec3()
    _add_coupled(pairs, x, u)
    for m in range(patches.y.shape[0]):
        patches.y[m] = vec3()
    for i in range(n):  # the residual, and then that without what patches do
        r = b[i] - u[i]
        for k in range(mesh.first[i], mesh.first[i + 1]):
            r -= mesh.block[k] * x[mesh.column[k]]
        t[i] = r
        m = patches.of[i]
        patches.y[m] = patches.y[m] + r
    _solve_patches(patches)
    for i in range(n):
        x[i] = x[i] + patches.y[patches.of[i]]
    _take_moved(pairs, patches, w, t)
    rho = zero
    for i in range(n):
        r = t[i]
        for k in range(mesh.first[i], mesh.middle[i]):
            r -= mesh.block[k] * b[mesh.column[k]]
        b[i] = mesh.inverse[i] * r
        p[i] = r
        rho += wp.dot(b[i], r)
    done[0] = 0
    limit = tolerance * tolerance * size
    for turn in range(iterations):
        if rho <= limit or rho <= real(1.0e-30):
            break
        for back in range(n):
            i = n - 1 - back
            r = p[i]
            for k in range(mesh.middle[i] + 1, mesh.first[i + 1]):
                r -= mesh.block[k] * t[mesh.column[k]]
            t[i] = mesh.inverse[i] * r
            u[i] = vec3()
        _add_coupled(pairs, t, u)
        _gather(patches, u, t)
        _solve_patches(patches)
        _take_moved(pairs, patches, w, u)
        curvature = zero
        for i in range(n):
            r = p[i] - mesh.block[mesh.middle[i]] * t[i] + u[i]
            for k in range(mesh.first[i], mesh.middle[i]):
                r -= mesh.block[k] * w[mesh.column[k]]
            w[i] = mesh.inverse[i] * r
            curvature += wp.dot(p[i], t[i] + w[i])
        alpha = rho / curvature
        after = zero
        for i in range(n):
            change[i] = change[i] + alpha * t[i]
            b[i] = b[i] - alpha * (t[i] + w[i])
            after += wp.dot(b[i], mesh.block[mesh.middle[i]] * b[i])
        beta = after / rho
        for i in range(n):
            p[i] = mesh.block[mesh.middle[i]] * b[i] + beta * p[i]
        rho = after
        done[0] = turn + 1
    for i in range(n):
        u[i] = vec3()
    _add_coupled(pairs, change, u)
    _gather(patches, u, change)
    _solve_patches(patches)
    for i in range(n):
        x[i] = x[i] + change[i] - patches.y[patches.of[i]]


def _zeros(shape, dtype):
    return wp.zeros(shape, dtype=dtype, device="cpu")


class Solver:
    """Solves (A + C) x = b [N] for x [m], of N vertices: A has a block where two vertices share an
    edge, C where contacts couple others. Row i of A has the blocks ``first[i]`` to ``first[i + 1]``
    (N + 1,), in the rising columns ``column`` (M,). ``patches`` (N,): the patch of each vertex;
    None: all are in one.

    Who uses it fills ``block``, a Warp array of the M blocks; ``middle`` (N,) is where those of the
    diagonal lie. They hold the contacts' blocks of each corner with itself, too.
    """

    def __init__(
        self, first: np.ndarray, column: np.ndarray, patches: np.ndarray | None = None
    ) -> None:
        count = len(first) - 1
        row = np.repeat(np.arange(count), np.diff(first))
        self.middle = np.flatnonzero(row == column)
        mesh = self._mesh = _Mesh()
        mesh.first, mesh.middle, mesh.column = ints(first), ints(self.middle), ints(column)
        mesh.block, mesh.inverse = _zeros(len(column), mat3), _zeros(count, mat3)
        self.block = mesh.block
        of = _in_order(np.zeros(count, int) if patches is None else patches)
        K = int(of.max()) + 1
        where, into = np.unique(row * K + of[column], return_inverse=True)
        p = self._patches = _Patches()
        p.of, p.into, p.column = ints(of), ints(into), ints(where % K)
        p.first = ints(np.searchsorted(where // K, np.arange(count + 1)))
        p.block, p.factor = _zeros(len(where), mat3), _zeros((K, K), mat3)
        p.inverse, p.y, p.start = _zeros(K, mat3), _zeros(K, vec3), _zeros(K, int)
        least = np.arange(K)
        np.minimum.at(least, of[where // K], where % K)
        p.least = ints(least)
        self._vectors = [_zeros(count, vec3) for _ in range(7)]
        self._done = _zeros(1, int)
        self.couple(np.zeros((0, 4)), np.zeros((0, 4)), np.zeros((0, 3, 3)))

    def couple(self, corners: np.ndarray, weights: np.ndarray, blocks: np.ndarray) -> None:
        """Sets C, by contacts' ``corners`` (P, 4), ``weights`` (P, 4) and ``blocks`` (P, 3, 3)
        [N/m]: what a contact adds between its corners i and j is weight_i weight_j block.
        """
        pairs = self._pairs = _Pairs()
        pairs.corners = ints(corners)
        pairs.weights = reals(weights)
        pairs.block = reals(blocks, mat3)

    def solve(
        self, b: np.ndarray, start: np.ndarray, iterations: int, tolerance: float
    ) -> tuple[np.ndarray, int]:
        """x (N, 3) [m] for ``b`` (N, 3) [N], and how many iterations it took from ``start`` (N, 3)
        [m]: ``iterations`` at most, fewer where the residual falls below ``tolerance`` times ``b``.
        """
        right, x, *work = self._vectors
        right.numpy()[:], x.numpy()[:] = b, start
        parts = [self._mesh, self._pairs, self._patches]
        wp.launch(_factorise, 1, parts, device="cpu")
        arrays = [*parts, iterations, tolerance, right, x, *work, self._done]
        wp.launch(_conjugate_gradients, 1, arrays, device="cpu")
        return x.numpy().copy(), int(self._done.numpy()[0])

    def product(self, vector: np.ndarray) -> np.ndarray:
        """(A + C) times ``vector`` (N, 3): slow and readable."""
        mesh, pairs, size = self._mesh, self._pairs, 3 * len(vector)
        blocks = self.block.numpy(), mesh.column.numpy(), mesh.first.numpy()
        out = (bsr_matrix(blocks, shape=(size, size)) @ np.ravel(vector)).reshape(-1, 3)
        corners, weights, block = (a.numpy() for a in (pairs.corners, pairs.weights, pairs.block))
        at = np.einsum("ck,ckd->cd", weights, vector[corners])[:, None]
        one_by_one = weights[:, :, None] * vector[corners]
        of_corners = np.einsum("cde,cke->ckd", block, at - one_by_one) * weights[:, :, None]
        np.add.at(out, corners, of_corners)
        return out


def _in_order(label):
    """Labels (N,) as numbers from 0 on that rise with the mean place of their vertices, so that
    patches that touch have near numbers.
    """
    _, label, count = np.unique(label, return_inverse=True, return_counts=True)
    mean = np.bincount(label, np.arange(len(label))) / count
    return np.argsort(np.argsort(mean))[label]
