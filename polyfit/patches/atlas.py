"""An atlas: a surface cut into as few patches as height graphs can hold, which overlap and are
blended by a partition of unity. NumPy and SciPy only.

In: a triangle mesh. Out: for each vertex the patches that hold it and their weights. A patch holds
a part of a surface that is a height graph over the plane of its mean normal: a sheet is one patch,
a tube three strips, a ball four or more caps. The clusters are those of
:mod:`polyfit.patches.clusters`, merged from single vertices.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from polyfit import mesh

from .clusters import NORMAL_WEIGHTS, connected, merged, relaxed
from .unity import shares

# A face is steep over a patch's plane beyond this cosine; of the surface no larger share is, so
# that a collar or a hem that is folded in needs no patch of its own
STEEP, STEEP_SHARE = 0.45, 0.1
# The way along a patch is longer than the way through the air by no more radii of a disc of its
# area: both legs of trousers, or a sleeve and the side below it, are no patch
_DETOUR = 2.0
_OVERLAP = 0.4  # width of the overlap, in radii of a disc of the patch's area
FINE = 128  # clusters that vertices are merged to before patches are sought
_ENOUGH = 4000  # vertices; where fewer do not do, patches are sought on a finer mesh


@dataclass(frozen=True)
class Cover:
    """The patches of a mesh's vertices, N of them, K patches.

    ``patch`` (N, M): the patches that hold each vertex, the first its own; ``weight`` (N, M): their
    share in it, each row with the sum 1, 0 where there are fewer than M; ``normal`` (K, 3): mean
    normals of the patches.
    """

    patch: np.ndarray
    weight: np.ndarray
    normal: np.ndarray

    def __len__(self) -> int:
        """K, the number of patches."""
        return len(self.normal)

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray) -> "Cover":
        """The cover of the mesh (N, 3), (F, 3), whose faces are oriented alike within each
        component, by the fewest patches that hold it.
        """
        edges = mesh.edges_of(faces)[0]
        vectors = mesh.face_vectors(vertices, faces) / 2
        part = mesh.components(len(vertices), edges)
        label, count = np.empty(len(vertices), dtype=np.int64), 0
        for k in range(part.max() + 1):
            inside = np.flatnonzero(part == k)
            found = _few(vertices, faces[part[faces[:, 0]] == k], vectors[part[faces[:, 0]] == k])
            label[inside] = found[inside] + count
            count = label[inside].max() + 1
        patch, weight = partition(vertices, faces, edges, label)
        return cls(patch, weight, _normals(label, faces, vectors))


def is_graph(vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray) -> bool:
    """Whether no face lies the other way round than most in the plane across ``normal`` (3,)."""
    up = int((mesh.face_vectors(vertices, faces) @ normal > 0).sum())
    return min(up, len(faces) - up) == 0


def partition(vertices, faces, edges, label):
    """(patch (N, M), weight (N, M)) of :class:`Cover` for clusters ``label`` (N,): a patch's weight
    falls with the distance from it along the surface, to nothing at the overlap's width.
    """
    count = int(label.max()) + 1
    if count == 1:
        return np.zeros((len(vertices), 1), dtype=np.int64), np.ones((len(vertices), 1))
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sp.coo_matrix((length, edges.T), 2 * (len(vertices),)).tocsr()
    area = np.bincount(
        label[faces].ravel(), np.repeat(mesh.areas(vertices, faces) / 3, 3), minlength=count
    )
    width = np.maximum(_OVERLAP * np.sqrt(area / np.pi), 1.5 * length.mean())
    near = np.zeros((len(vertices), count))
    for k in range(count):
        own = np.flatnonzero(label == k)
        far = dijkstra(graph, directed=False, indices=own, min_only=True, limit=width[k])
        near[:, k] = np.maximum(1 - far / width[k], 0) ** 2
    near[np.arange(len(vertices)), label] = 1 + 1e-9  # its own patch comes first
    vertex, cluster = np.nonzero(near)
    kept, share = shares(vertex, near[vertex, cluster], len(near))
    vertex, cluster = vertex[kept], cluster[kept]
    layer = np.arange(len(kept)) - np.searchsorted(vertex, vertex)
    patch = np.repeat(label[:, None], layer.max() + 1, axis=1)
    weight = np.zeros(patch.shape)
    patch[vertex, layer], weight[vertex, layer] = cluster, share
    return patch, weight


def _few(vertices, faces, vectors):
    """Labels (N,) of the vertices of one component, in the fewest clusters that hold it."""
    count = len(vertices)
    inside = np.unique(faces)
    label = np.zeros(count, dtype=np.int64)
    normals = np.stack(
        [np.bincount(faces.ravel(), np.repeat(x, 3), minlength=count) for x in vectors.T], 1
    )
    area = np.bincount(faces.ravel(), np.repeat(np.linalg.norm(vectors, axis=1) / 3, 3), count)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    local = np.empty(count, dtype=np.int64)
    local[inside] = np.arange(len(inside))
    edges, points = local[mesh.edges_of(faces)[0]], vertices[inside]
    normals, area = normals[inside], np.maximum(area[inside], 1e-9 * area[inside].mean())
    faces = local[faces]

    def held(own):
        return _steep(own, faces, vectors) <= STEEP_SHARE

    if held(np.zeros(len(inside), dtype=np.int64)):
        return label

    def clusters(start, count, weight):
        radius = np.sqrt(area.sum() / (np.pi * count))
        feature = np.concatenate([points / radius, weight * normals], axis=1)
        found = merged(start, feature, area, edges, count)
        if count < FINE:
            found = connected(relaxed(found, feature, area, edges), edges, area)
        return np.unique(found, return_inverse=True)[1]

    fine = clusters(np.arange(len(inside)), FINE, NORMAL_WEIGHTS[0])
    if not held(fine) and len(points) < _ENOUGH:  # of long faces, as on the side of a low-poly can
        finer, cut = mesh.subdivided(faces)
        halved = np.concatenate([points, points[cut].mean(1)])
        own = _few(halved, finer, mesh.face_vectors(halved, finer) / 2)[: len(points)]
        label[inside] = np.unique(own, return_inverse=True)[1]
        return label
    for wanted in range(2, FINE if held(fine) else 0):  # what many do not hold, few do not
        for weight in NORMAL_WEIGHTS:
            own = clusters(fine, wanted, weight)
            if held(own):
                label[inside] = _compact(own, points, edges, area)
                return label
    label[inside] = fine
    return label


def _compact(label, points, edges, area):
    """The clusters ``label`` (N,) of points (N, 3) [m] with ``edges`` (E, 2) and an ``area`` (N,)
    [m^2] each; those with a detour above _DETOUR are cut in two halfway along it, until there are
    none.
    """
    label, length = label.copy(), np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    k = 0
    while k <= label.max():
        own = np.flatnonzero(label == k)
        inner = (label[edges] == k).all(1)
        graph = sp.coo_matrix((length[inner], edges[inner].T), 2 * (len(points),)).tocsr()
        along = lambda i: dijkstra(graph, directed=False, indices=own[i])[own]
        x = points[own]
        end = np.linalg.norm(x - x.mean(0), axis=1).argmax()
        far = along(end)
        for _ in range(3):  # from one end of a detour to the other
            start, near = end, far
            end = (near - np.linalg.norm(x - x[start], axis=1)).argmax()
            far = along(end)
        detour = near[end] - np.linalg.norm(x[end] - x[start])
        if detour > _DETOUR * np.sqrt(area[own].sum() / np.pi):
            label[own[far < near]] = label.max() + 1
        else:
            k += 1
    return label


def _normals(label, faces, vectors):
    """Mean normals (K, 3) of the clusters, of length 1."""
    count = int(label.max()) + 1
    found = np.stack(
        [np.bincount(label[faces].ravel(), np.repeat(x, 3), minlength=count) for x in vectors.T], 1
    )
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-300)


def _steep(label, faces, vectors):
    """Share of the area that is steep over the planes of the clusters ``label`` (N,): over that of
    each cluster that has a corner of the face.
    """
    normal, area = _normals(label, faces, vectors), np.linalg.norm(vectors, axis=1)
    steep = np.einsum("fk,fck->fc", vectors, normal[label[faces]]) < STEEP * area[:, None]
    return steep.all(1) @ area / max(area.sum(), 1e-300)
