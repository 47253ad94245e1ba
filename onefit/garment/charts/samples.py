"""Where a patched garment is measured: points of each patch at which the metric is held, points on
the boundaries of patches, and matrices that differentiate a field of the vertices there.
"""

import numpy as np
import scipy.sparse as sp
import torch

from polyfit import jets, mesh

_METRIC_POINTS = 16  # of each patch
_BOUNDARY_POINTS = 6  # of each pair of patches that meet


def refinement(count, given, levels):
    """The matrix (M, N) from the vertices of a mesh to those after ``levels`` subdivisions."""
    matrix, faces = sp.identity(count, format="csr"), given
    for _ in range(levels):
        faces, edges = mesh.subdivided(faces)
        rows = np.repeat(np.arange(len(edges)), 2)
        middle = sp.csr_matrix(
            (np.full(edges.size, 0.5), (rows, edges.ravel())), (len(edges), matrix.shape[0])
        )
        matrix = sp.vstack([matrix, middle @ matrix]).tocsr()
    return matrix


def metric_points(p, uv, order, rng):
    """``(points (K, M), field)`` of the patches ``p`` with charts' coordinates ``uv`` (E, 2): the
    entries at which the metric is held, and the matrix (3 K M, vertices) to a field's value and its
    derivatives along u and v there.
    """
    own = p.vertex_patch[p.entry_vertex] == p.entry_patch
    ends = np.cumsum(np.bincount(p.entry_patch))
    points, rows, columns, values = [], [], [], []
    for k, (first, last) in enumerate(zip(np.concatenate([[0], ends[:-1]]), ends)):
        e = np.arange(first, last)
        mine = e[own[first:last]] if own[first:last].sum() >= _METRIC_POINTS else e
        chosen = mine[_far_apart(uv[mine], _METRIC_POINTS, rng)]
        points.append(chosen)
        # a field of the vertices as a jet: least squares, weighted by area, held by a trace of
        # a ridge
        b, w = basis(uv[e], order), p.entry_weight[e, None]
        gram = (b * w).T @ b
        fit = np.linalg.solve(
            gram + 1e-7 * np.trace(gram) * np.eye(len(gram)), (b * w).T
        )  # (A, E_k)
        stack = np.stack(
            [basis(uv[chosen], order, *d) @ fit for d in ((0, 0), (1, 0), (0, 1))], 1
        )  # (M, 3, E_k)
        rows.append(np.repeat(3 * _METRIC_POINTS * k + np.arange(3 * _METRIC_POINTS), len(e)))
        columns.append(np.tile(p.entry_vertex[e], 3 * _METRIC_POINTS))
        values.append(stack.reshape(-1))
    points = np.stack(points)  # (K, M)
    field = sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (3 * points.size, len(p.vertices)),
    )
    return points, field


def boundary_points(p, rng):
    """Pairs (B, 2) of entries of the patches ``p`` that lie on one another at the boundary of two
    patches: at most :data:`_BOUNDARY_POINTS`, at random, for each pair of patches.
    """
    pairs = p.boundary
    key = p.entry_patch[pairs] @ [len(p.label), 1]
    shuffled = rng.permutation(len(pairs))
    order = shuffled[np.argsort(key[shuffled], kind="stable")]
    rank = np.arange(len(order)) - np.searchsorted(key[order], key[order])
    return pairs[np.sort(order[rank < _BOUNDARY_POINTS])]


def basis_and_slopes(uv, order):
    """Monomials at ``uv`` and their derivatives along u and v: (..., 3, A)."""
    return torch.stack([jets.basis(uv, order, *d) for d in ((0, 0), (1, 0), (0, 1))], -2)


def basis(uv, order, du=0, dv=0):
    return jets.basis(torch.as_tensor(uv), order, du, dv).numpy()


def _far_apart(uv, count, rng):
    """Indices (count,) of points of uv (P, 2) far from each other; the farthest from those chosen
    is next.
    """
    chosen = [int(rng.integers(len(uv)))]
    distance = np.full(len(uv), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, ((uv - uv[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)
