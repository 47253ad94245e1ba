"""Finer meshes of the same surface, and where a point of the coarse mesh lies on the fine one.

``F`` (F, 3) int are faces; barycentric coordinates are in the order of a face's corners.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array

from .triangles import edges_of


def subdivided(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut in four at the middles of its sides: ``(faces (4 F, 3), edges (E, 2))``.

    The middle of ``edges[e]`` is the vertex n + e, n the number of vertices of F. The children of
    face f are the rows 4 f + k: k = 0, 1, 2 at corner k and 3 in the middle, each with its corners
    in the order of the parent's (the middle one: opposite to them).
    """
    edges, side = edges_of(F)
    (a, b, c), (ab, bc, ca) = F.T, (side + int(F.max()) + 1).T
    children = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.stack([np.stack(child, axis=1) for child in children], axis=1).reshape(-1, 3), edges


def subdivided_loop(F: np.ndarray, count: int) -> tuple[np.ndarray, Any]:
    """The faces of :func:`subdivided`, and the matrix (``count`` + E, ``count``), sparse, that
    gives their vertices on Loop's smooth surface of ``count`` vertices (Loop, 1987). An edge of one
    face, or of more than two, is a boundary: a curve of its own.
    """
    finer, edges = subdivided(F)
    finer = np.where(finer > F.max(), finer + count - 1 - F.max(), finer)  # past loose vertices
    side = edges_of(F)[1]
    inside = np.bincount(side.ravel(), minlength=len(edges)) == 2
    (a, b), middle = edges.T, count + np.arange(len(edges))
    across, opposite = side.ravel(), np.roll(F, 1, axis=1).ravel()  # corner k + 2 of side k
    across, opposite = across[inside[across]], opposite[inside[across]]
    rim = np.zeros(count, bool)
    rim[edges[~inside]] = True
    start, end = np.concatenate([a, b]), np.concatenate([b, a])
    kept = np.tile(~inside, 2) | ~rim[start]  # a boundary's vertex has neighbours along it alone
    start, end = start[kept], end[kept]
    k = np.maximum(np.bincount(start, minlength=count), 1)
    inner = 0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / k)) ** 2
    moved = np.where(rim, 0.25, inner)  # share of the neighbours
    ends = np.where(inside, 0.375, 0.5)
    row = [middle, middle, count + across, np.arange(count), start]
    column = [a, b, opposite, np.arange(count), end]
    value = [ends, ends, np.full(len(across), 0.125), 1 - moved, (moved / k)[start]]
    shape = (count + len(edges), count)
    at = (np.concatenate(row), np.concatenate(column))
    return finer, coo_array((np.concatenate(value), at), shape).tocsr()


def child(face: ArrayLike, barycentric: ArrayLike, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Where points on a mesh lie after ``levels`` subdivisions: (face (...,), barycentric (..., 3))
    turned into those of the finer mesh.
    """
    face, b = np.asarray(face, dtype=np.int64), np.asarray(barycentric, dtype=np.float64)
    for _ in range(levels):
        corner = b.argmax(axis=-1)
        outer = np.take_along_axis(b, corner[..., None], -1)[..., 0] >= 0.5
        near = 2 * b - (np.arange(3) == corner[..., None])
        b = np.where(outer[..., None], near, 1 - 2 * b)
        face = 4 * face + np.where(outer, corner, 3)
    return face, b


def refined(F: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The faces with every side cut in ``parts``: ``(faces (parts^2 F, 3), face (N',), barycentric
    (N', 3))``, where the new vertex k lies at ``barycentric[k]`` on the face ``face[k]`` of F. The
    vertices of F come first, in their order; neighbours share the new ones.
    """
    grid = np.array(
        [(i, j, parts - i - j) for i in range(parts, -1, -1) for j in range(parts - i, -1, -1)]
    )
    count = int(F.max()) + 1
    edges, side = edges_of(F)
    forward = (
        edges[side][..., 0] == F
    )  # whether the side from corner k runs from the smaller vertex to the larger
    inner = np.cumsum((grid > 0).all(axis=1)) - 1
    index = np.empty((len(F), len(grid)), dtype=np.int64)
    for n, b in enumerate(grid):
        zero = np.flatnonzero(b == 0)
        if len(zero) == 2:
            index[:, n] = F[:, b.argmax()]
        elif len(zero) == 1:
            k = (int(zero[0]) + 1) % 3  # the side from corner k to the next
            step = np.where(forward[:, k], b[(k + 1) % 3], b[k])
            index[:, n] = count + side[:, k] * (parts - 1) + step - 1
        else:
            index[:, n] = (
                count
                + len(edges) * (parts - 1)
                + np.arange(len(F)) * ((parts - 1) * (parts - 2) // 2)
                + inner[n]
            )
    at = {tuple(b): n for n, b in enumerate(grid)}
    small = [[at[i, j, k], at[i - 1, j + 1, k], at[i - 1, j, k + 1]] for i, j, k in at if i > 0]
    small += [
        [at[i - 1, j + 1, k], at[i - 2, j + 1, k + 1], at[i - 1, j, k + 1]]
        for i, j, k in at
        if i > 1
    ]
    total = count + len(edges) * (parts - 1) + len(F) * ((parts - 1) * (parts - 2) // 2)
    first = np.empty(total, dtype=np.int64)
    first[index.ravel()[::-1]] = np.arange(index.size)[::-1]
    return (
        index[:, np.array(small)].reshape(-1, 3),
        first // len(grid),
        grid[first % len(grid)] / parts,
    )
