"""What any triangle mesh needs before it is cut: checks, manifold sheets, subdivision. NumPy only.

``vertices`` (N, 3) float [m], ``faces`` (F, 3) int.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .errors import InputError


def checked(vertices, faces, where="mesh"):
    """``(vertices float64, faces int64)`` of a mesh that can be cut. Faces that name a vertex
    twice, and those that repeat another's vertices, are dropped. Raises InputError, in one line
    that starts with ``where``, for anything else that is wrong.
    """
    V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    if V.ndim != 2 or V.shape[1] != 3 or len(V) == 0:
        raise InputError(f"{where}: vertices of shape {V.shape}; (N, 3) is needed")
    if F.size == 0:
        raise InputError(f"{where}: no faces; a triangle mesh is needed")
    if F.ndim != 2 or F.shape[1] != 3:
        raise InputError(f"{where}: faces of shape {F.shape}; (F, 3) is needed")
    F = F.astype(np.int64)
    if F.min() < 0 or F.max() >= len(V):
        raise InputError(
            f"{where}: faces name vertices {F.min()} to {F.max()}; 0 to {len(V) - 1} exist"
        )
    _refuse(~np.isfinite(V).all(axis=1), where, "vertices have coordinates that are not finite")
    F = F[(np.roll(F, 1, axis=1) != F).all(axis=1)]
    _, first = np.unique(np.sort(F, axis=1), axis=0, return_index=True)
    F = F[np.sort(first)]
    _refuse(np.bincount(F.ravel(), minlength=len(V)) == 0, where, "vertices are in no face")
    if not areas(V, F).sum() > 1e-12 * np.ptp(V, axis=0).max() ** 2:
        raise InputError(f"{where}: its faces have no area")
    return V, F


def _refuse(bad, where, what):
    if bad.any():
        raise InputError(
            f"{where}: {bad.sum()} {what} (the first is vertex {int(np.argmax(bad))}, counted"
            " from 0)"
        )


def face_vectors(V, F):
    """Normals of the faces, as long as twice their area, (F, 3) [m^2]."""
    return np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])


def areas(V, F):
    """Areas of the faces, (F,) [m^2]."""
    return 0.5 * np.linalg.norm(face_vectors(V, F), axis=1)


def edges_of(F):
    """Edges of the faces, each once and the smaller vertex first, (E, 2); and of which edge the
    side from corner k to the next is, (F, 3)."""
    side = np.stack([F, np.roll(F, -1, axis=1)], axis=-1)
    side.sort(axis=-1)
    size = int(F.max()) + 1
    key, index = np.unique(side[..., 0] * size + side[..., 1], return_inverse=True)
    return np.stack([key // size, key % size], axis=1), index.reshape(F.shape)


def sheets(F):
    """Faces (F, 3) whose vertices are those of F, split where the surface is no manifold.

    At an edge of three or more faces, and at a vertex where parts meet that share no edge there,
    each part gets a vertex of its own; so the new faces are joined by edges of two faces only, as
    far as a local cut can achieve that. Winding does not matter.
    """
    one, two = _across(F)
    after = lambda corner: corner - corner % 3 + (corner + 1) % 3
    alike = F.ravel()[one] == F.ravel()[two]
    pairs = [
        (one, np.where(alike, two, after(two))),
        (after(one), np.where(alike, after(two), two)),
    ]
    return components(F.size, np.concatenate([np.stack(p, axis=1) for p in pairs])).reshape(F.shape)


def winding(F):
    """1 or -1 for each face (F,): -1 where it is wound against most faces of its component, so that
    all agree after it is turned round.

    Components that have no two sides (a Moebius strip) are left as they are. F as of
    :func:`sheets`.
    """
    one, two = _across(F)
    against = (F.ravel()[one] == F.ravel()[two]) * len(F)
    f, g = one // 3, two // 3  # faces f and g are wound alike, or f and g turned round are
    pairs = np.concatenate(
        [np.stack([f, g + against], axis=1), np.stack([f + len(F), g + len(F) - against], axis=1)]
    )
    kept, turned = components(2 * len(F), pairs).reshape(2, -1)
    agree = np.bincount(kept, minlength=max(kept.max(), turned.max()) + 1)
    more = (agree[kept] > agree[turned]) | ((agree[kept] == agree[turned]) & (kept <= turned))
    return np.where(more, 1, -1)


def _across(F):
    """The edges of two faces: the corners (of F.ravel()) from which the one and the other walk
    along them.
    """
    _, edge = edges_of(F)
    order = np.argsort(edge.ravel(), kind="stable")
    uses = np.bincount(edge.ravel())
    start = (np.cumsum(uses) - uses)[uses == 2]
    return order[start], order[start + 1]


def components(count, pairs):
    """Numbers (count,) from 0 of the connected components of a graph with the edges ``pairs`` (E,
    2).
    """
    graph = coo_matrix(
        (np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count)
    )
    return connected_components(graph, directed=False)[1].astype(np.int64)


def subdivided(F):
    """Every face cut in four at the middles of its sides: ``(faces (4 F, 3), edges (E, 2))``.

    The middle of ``edges[e]`` is the vertex n + e, n the number of vertices of F. The children of
    face f are the rows 4 f + k: k = 0, 1, 2 at corner k and 3 in the middle, each with its corners
    in the order of the parent's (the middle one: opposite to them).
    """
    edges, side = edges_of(F)
    (a, b, c), (ab, bc, ca) = F.T, (side + int(F.max()) + 1).T
    children = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.stack([np.stack(child, axis=1) for child in children], axis=1).reshape(-1, 3), edges


def child(face, barycentric, levels):
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


def refined(F, parts):
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
