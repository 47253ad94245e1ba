"""Seams of panels that were meshed each for itself: both boundaries get the vertices of both, so
that they can be merged. NumPy.
"""

import numpy as np
from scipy.spatial import cKDTree

from polyfit import mesh

_REACH, _SHARE = 0.001, 0.3  # [m], and of an edge's length: how near the other boundary is at most
_ROUNDS = 3  # a triangle is cut along one side a round


def zipped(V, F):
    """``(vertices, faces, count)`` with boundary vertices that lie near each other at one place,
    and with boundary edges cut where vertices of another boundary lie on them, at ``count`` places.
    """
    rim = _rim(F)
    if not len(rim[0]):
        return V, F, 0
    V, cuts = _snapped(V, F, *rim), 0
    for _ in range(_ROUNDS):
        V, F, count = _cut(V, F, *_rim(F))
        cuts += count
        if not count:
            break
    return V, F, cuts


def _rim(F):
    """Faces (E,) and first corners (E,) of the boundary's edges."""
    edges, side = mesh.edges_of(F)
    once = np.bincount(side.ravel(), minlength=len(edges)) == 1
    return np.nonzero(once[side])


def _lying_on(V, F, face, corner):
    """Which boundary ``edge`` (P,) has which boundary ``vertex`` (P,) on it, between its ends; how
    far along, ``t`` (P,), 0 to 1.
    """
    a, b = F[face, corner], F[face, (corner + 1) % 3]
    length = np.linalg.norm(V[b] - V[a], axis=1)
    on = np.unique(np.concatenate([a, b]))
    near = cKDTree(V[on]).query_ball_point((V[a] + V[b]) / 2, length / 2 + _REACH)
    edge = np.repeat(np.arange(len(a)), [len(x) for x in near])
    vertex = on[np.concatenate([np.asarray(x, dtype=np.int64) for x in near])]
    along = (V[b] - V[a])[edge]
    t = np.einsum("nd,nd->n", V[vertex] - V[a][edge], along)
    t /= np.maximum(length[edge], 1e-12) ** 2
    off = np.linalg.norm(V[a][edge] + t[:, None] * along - V[vertex], axis=1)
    lies = (t > 0) & (t < 1) & (off < np.minimum(_REACH, _SHARE * length[edge]))
    lies &= (F[face[edge]] != vertex[:, None]).all(axis=1)
    return edge[lies], vertex[lies], t[lies]


def _snapped(V, F, face, corner):
    """The vertices, those of boundaries that lie near each other at one place."""
    ends = np.stack([F[face, corner], F[face, (corner + 1) % 3]], axis=1)
    length = np.linalg.norm(V[ends[:, 0]] - V[ends[:, 1]], axis=1)
    shortest = np.full(len(V), np.inf)  # of a vertex' boundary edges
    np.minimum.at(shortest, ends.ravel(), np.repeat(length, 2))
    edge, vertex, t = _lying_on(V, F, face, corner)
    on = np.unique(ends)
    close = on[cKDTree(V[on]).query_pairs(_REACH, output_type="ndarray").reshape(-1, 2)]
    pairs = np.concatenate([close, np.stack([vertex, ends[edge, (t > 0.5).astype(int)]], axis=1)])
    apart = np.linalg.norm(V[pairs[:, 0]] - V[pairs[:, 1]], axis=1)
    label = mesh.components(len(V), pairs[apart < _SHARE * shortest[pairs].min(axis=1)])
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    return V[first[label]]


def _cut(V, F, face, corner):
    """``(vertices, faces, count)`` with boundary edges cut where vertices lie on them."""
    edge, vertex, t = _lying_on(V, F, face, corner)
    apart = np.linalg.norm(V[F[face[edge]]] - V[vertex][:, None], axis=2).min(axis=1)
    new = apart > 1e-9
    edge, vertex, t = edge[new], vertex[new], t[new]
    first = np.full(len(F), len(face))  # one side of a face at a time
    np.minimum.at(first, face[edge], edge)
    order = np.lexsort((t, edge))
    order = order[first[face[edge]][order] == edge[order]]
    edge, vertex = edge[order], vertex[order]
    number = len(V) + np.arange(len(vertex))
    fans = [np.delete(F, face[edge], axis=0)]
    for e in np.unique(edge):
        a, b, apex = np.roll(F[face[e]], -corner[e])
        ring = np.concatenate([[a], number[edge == e], [b]])
        fans.append(np.stack([ring[:-1], ring[1:], np.full(len(ring) - 1, apex)], axis=1))
    return np.concatenate([V, V[vertex]]), np.concatenate(fans), len(vertex)
