"""Checks of a triangle mesh, its areas, edges, neighbours and manifold sheets. NumPy and SciPy
only.

``vertices`` (N, 3) float [m], ``faces`` (F, 3) int.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from polyfit.errors import InputError


def as_arrays(
    vertices: ArrayLike, faces: ArrayLike, where: str = "mesh"
) -> tuple[np.ndarray, np.ndarray]:
    """``(vertices (N, 3) float64, faces (F, 3) int64)`` of anything like arrays. Raises InputError,
    in one line that starts with ``where``, for other shapes, for what is no array of numbers, and
    for faces whose vertices are not there.
    """
    V = _numbers(vertices, f"{where}: vertices", "(N, 3)").astype(np.float64)
    F = _numbers(faces, f"{where}: faces", "(F, 3)")
    if V.ndim != 2 or V.shape[1] != 3:
        raise InputError(f"{where}: vertices of shape {V.shape}; (N, 3) is needed")
    if F.size == 0:
        return V, np.empty((0, 3), np.int64)
    if F.ndim != 2 or F.shape[1] != 3:
        raise InputError(f"{where}: faces of shape {F.shape}; (F, 3) is needed")
    if F.dtype.kind not in "iuf" or (F.dtype.kind == "f" and not (F % 1 == 0).all()):
        raise InputError(f"{where}: faces are not whole numbers, which name vertices")
    F = F.astype(np.int64)
    if F.min() < 0 or F.max() >= len(V):
        raise InputError(
            f"{where}: faces name vertices {F.min()} to {F.max()}; 0 to {len(V) - 1} exist"
        )
    return V, F


def _numbers(given: ArrayLike, what: str, needed: str) -> np.ndarray:
    try:
        found = np.asarray(given)
    except (ValueError, TypeError, RuntimeError):  # rows of several lengths; gradients, of torch
        found = np.array(None)
    if found.dtype.kind not in "fiu":
        raise InputError(f"{what} are no array of numbers; {needed} is needed")
    return found


def checked(
    vertices: ArrayLike, faces: ArrayLike, where: str = "mesh", drop_loose: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """``(vertices float64, faces int64)`` of a mesh that can be cut. Faces that name a vertex
    twice, and those that repeat another's vertices, are dropped; with ``drop_loose`` vertices in no
    face, too: the others keep their order. Raises InputError, in one line that starts with
    ``where``, for anything else that is wrong.
    """
    V, F = as_arrays(vertices, faces, where)
    if len(F) == 0:
        raise InputError(f"{where}: no faces; a triangle mesh is needed")
    if drop_loose:
        V, F = in_use(V, F)
    _refuse(~np.isfinite(V).all(axis=1), where, "vertices have coordinates that are not finite")
    F = F[(np.roll(F, 1, axis=1) != F).all(axis=1)]
    _, first = np.unique(np.sort(F, axis=1), axis=0, return_index=True)
    F = F[np.sort(first)]
    if drop_loose:
        V, F = in_use(V, F)
    _refuse(np.bincount(F.ravel(), minlength=len(V)) == 0, where, "vertices are in no face")
    if not areas(V, F).sum() > 1e-12 * np.ptp(V, axis=0).max() ** 2:
        raise InputError(f"{where}: its faces have no area")
    return V, F


def welded(V: np.ndarray, F: np.ndarray, grid: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """``(kept (K,), faces (F, 3))``: the first vertex in each place, in their order, and the faces
    on these. Places are the same that round to the same point of a ``grid`` [m]; 0: that are equal.
    """
    places = V if grid == 0 else np.round(V / grid).astype(np.int64)
    _, first, index = np.unique(places, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    return first[order], number[index.ravel()][F]


_FARTHEST = 1000.0  # from the origin, in extents: there single precision keeps 1/16,000 of one


def centred(V: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """``(vertices, moved)``: vertices (N, 3) that lie too far from the origin for single precision,
    as in a map's coordinates, moved by ``moved`` (3,) so that their middle is there; all others as
    they are, with None.
    """
    low, high = V.min(axis=0, initial=np.inf), V.max(axis=0, initial=-np.inf)
    middle = (low + high) / 2
    if not np.abs(middle).max() > _FARTHEST * (high - low).max() > 0:
        return V, None
    return V - middle, -middle


def in_use(V: np.ndarray, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without vertices in no face; the others keep their order."""
    used, F = np.unique(F, return_inverse=True)
    return V[used], F.reshape(-1, 3)


def _refuse(bad: Any, where: str, what: str) -> None:
    if bad.any():
        raise InputError(
            f"{where}: {bad.sum()} {what} (the first is vertex {int(np.argmax(bad))}, counted"
            " from 0)"
        )


def face_vectors(V: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Normals of the faces, as long as twice their area, (F, 3) [m^2]."""
    return np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])


def vertex_normals(V: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of the vertices: the means of the adjacent faces' normals, weighted by
    area (trimesh weights by angle). Zero where no face is.
    """
    N = [np.bincount(F.ravel(), np.repeat(x, 3), len(V)) for x in face_vectors(V, F).T]
    total = np.stack(N, axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def areas(V: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Areas of the faces, (F,) [m^2]."""
    return 0.5 * np.linalg.norm(face_vectors(V, F), axis=1)


def signed_areas(points: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Areas of the faces of a plane mesh, ``points`` (N, 2), (F,): above 0 where x turns to y."""
    a, b = points[F[:, 1]] - points[F[:, 0]], points[F[:, 2]] - points[F[:, 0]]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def edges_of(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the faces, each once and the smaller vertex first, (E, 2); and of which edge the
    side from corner k to the next is, (F, 3)."""
    side = np.stack([F, np.roll(F, -1, axis=1)], axis=-1)
    side.sort(axis=-1)
    size = int(F.max()) + 1
    key, index = np.unique(side[..., 0] * size + side[..., 1], return_inverse=True)
    return np.stack([key // size, key % size], axis=1), index.reshape(F.shape)


def boundary_edges(F: np.ndarray) -> np.ndarray:
    """Directed edges (B, 2) that have one face only, as the face walks them."""
    edges, side = edges_of(F)
    once = np.bincount(side.ravel(), minlength=len(edges))[side] == 1
    return np.stack([F, np.roll(F, -1, axis=1)], axis=-1)[once]


def loops(F: np.ndarray) -> list[np.ndarray]:
    """The boundary of a manifold mesh as a list of vertex indices, in the order in which their
    faces walk them; the longest first.
    """
    after = dict(boundary_edges(F).tolist())
    found = []
    while after:
        loop = [next(iter(after))]
        while (following := after.pop(loop[-1], None)) is not None and following != loop[0]:
            loop.append(following)
        found.append(np.array(loop))
    return sorted(found, key=len, reverse=True)


def neighbour_mean(F: np.ndarray, count: int, boundary_apart: bool = False) -> csr_matrix:
    """Sparse (count, count) matrix that takes the mean of each vertex's neighbours; with
    ``boundary_apart`` boundary vertices have those along their loop only.
    """
    e = edges_of(F)[0]
    if boundary_apart:
        b = boundary_edges(F)
        on = np.zeros(count, dtype=bool)
        on[b] = True
        pairs = np.concatenate([e[~on[e[:, 0]]], e[~on[e[:, 1]]][:, ::-1], b, b[:, ::-1]])
    else:
        pairs = np.concatenate([e, e[:, ::-1]])
    weight = 1 / np.bincount(pairs[:, 0], minlength=count)[pairs[:, 0]]
    return coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()


def sheets(F: np.ndarray) -> np.ndarray:
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


def winding(F: np.ndarray) -> np.ndarray:
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


def _across(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of two faces: the corners (of F.ravel()) from which the one and the other walk
    along them.
    """
    _, edge = edges_of(F)
    order = np.argsort(edge.ravel(), kind="stable")
    uses = np.bincount(edge.ravel())
    start = (np.cumsum(uses) - uses)[uses == 2]
    return order[start], order[start + 1]


def components(count: int, pairs: np.ndarray) -> np.ndarray:
    """Numbers (count,) from 0 of the connected components of a graph with the edges ``pairs`` (E,
    2).
    """
    graph = coo_matrix(
        (np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count)
    )
    return connected_components(graph, directed=False)[1].astype(np.int64)
