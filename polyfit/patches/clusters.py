"""Clusters of vertices that one jet can hold: ACVD (Valette & Chassery 2004), with the normals in
its energy.

ACVD finds connected clusters that have the least sum of squared distances from their centroids.
They are round and of equal area. A jet also needs a height graph, but a round cluster of a sleeve
may go all the way around it. So a vertex is the point (x / r, w n) in six dimensions here: r is the
radius of a disc of the clusters' mean area, n the vertex's normal, w a weight. The energy is
ACVD's.

pyacvd makes a fine cut. Its clusters are merged down to the number asked for, each time where the
energy grows least (Ward 1963). Then the boundaries move to where the energy is lowest.
"""

import heapq
import warnings

import numpy as np

from polyfit import mesh

# Weights w of the normals against positions, tried in this order
NORMAL_WEIGHTS = (1.5, 3.0, 6.0)
# until at most this share of the area faces away from its cluster's mean normal
_FOLDED_SHARE = 0.01
_FINE_PER_CLUSTER = 12  # clusters of the fine cut for each cluster asked for
_VERTICES_PER_FINE = 4  # vertices that each of the fine cut should have, at least
_MAX_SWEEPS = 100  # over the boundaries


def clusters(points, normals, area, faces, edges, count):
    """Labels 0 .. count - 1 (P,) of a connected mesh: points (P, 3) [m], unit normals (P, 3), area
    (P,) [m^2] around each, faces (F, 3), edges (E, 2).

    Every cluster is connected; there may be fewer than ``count``. Where clusters still fold over,
    the normals get more weight, as long as that helps.
    """
    radius = np.sqrt(area.sum() / (np.pi * count))
    fine = max(count, min(_FINE_PER_CLUSTER * count, len(points) // _VERTICES_PER_FINE))
    fine = connected(_acvd(points, faces, fine), edges, area)
    fine = np.unique(fine, return_inverse=True)[1]
    best, least = None, np.inf
    for weight in NORMAL_WEIGHTS:
        feature = np.concatenate([points / radius, weight * normals], axis=1)
        label = connected(
            relaxed(merged(fine, feature, area, edges, count), feature, area, edges), edges, area
        )
        folded = _folded(label, normals, area)
        if folded < 0.9 * least:
            best, least = label, folded
        if folded <= _FOLDED_SHARE or folded > least:
            break
    return np.unique(best, return_inverse=True)[1]


def plain(points, area, faces, edges, count):
    """The same by ACVD as it is, of positions alone: the paper's cut. A cluster may fold over."""
    return np.unique(connected(_acvd(points, faces, count), edges, area), return_inverse=True)[1]


def _folded(label, normals, area):
    """Share of the area that faces away from its cluster's mean normal."""
    mean = _sums(label, normals, area)[0]
    return area[(normals * mean[label]).sum(axis=1) < 0].sum() / area.sum()


def _acvd(points, faces, count):
    import pyacvd
    import pyvista

    if count >= len(points):
        return np.arange(len(points))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd uses what pyvista has renamed
        # its own joining of pieces (iso_try) can leave clusters of a single vertex: connected()
        # does it
        found = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(points, faces)).cluster(
            int(count), iso_try=0
        )
    return np.asarray(found, dtype=np.int64)


def merged(label, feature, area, edges, count):
    """Neighbouring clusters merged, cheapest first, until ``count`` are left."""
    total, size = _sums(label, feature, area)
    near = [set() for _ in size]
    for a, b in np.unique(label[edges], axis=0).tolist():
        if a != b:
            near[a].add(b)
            near[b].add(a)
    heap = []

    def offer(a, b):
        difference = total[a] / size[a] - total[b] / size[b]
        growth = size[a] * size[b] / (size[a] + size[b]) * (difference @ difference)
        heapq.heappush(heap, (growth, min(a, b), max(a, b), stamp[a] + stamp[b]))

    stamp, parent = [0] * len(size), np.arange(len(size))
    for a in range(len(size)):
        for b in near[a]:
            if a < b:
                offer(a, b)
    left = len(size)
    while left > count and heap:
        _, a, b, when = heapq.heappop(heap)
        if parent[a] != a or parent[b] != b or when != stamp[a] + stamp[b]:
            continue
        parent[b], left = a, left - 1
        total[a] += total[b]
        size[a] += size[b]
        stamp[a] += 1
        near[a] = (near[a] | near[b]) - {a, b}
        for c in near[b]:
            near[c].discard(b)
        for c in near[a]:
            near[c].add(a)
            offer(a, c)
    while (parent[parent] != parent).any():
        parent = parent[parent]
    return np.unique(parent[label], return_inverse=True)[1]


def relaxed(label, feature, area, edges):
    """Vertices at the boundaries given to the neighbouring cluster where that lowers the energy,
    until few move.
    """
    label = label.copy()
    for sweep in range(_MAX_SWEEPS):
        total, size = _sums(label, feature, area)
        centre = total / size[:, None]

        def cost(v, own, to):
            w = area[v]
            rest = np.maximum(size[own] - w, 1e-12 * size[own])
            joined = size[to] * w / (size[to] + w) * _squared(feature[v] - centre[to])
            return joined - size[own] * w / rest * _squared(feature[v] - centre[own])

        if sweep_boundaries(label, edges, sweep, cost) < 1e-3:
            break
    return label


def sweep_boundaries(label, edges, sweep, cost):
    """Give, in place, vertices at the clusters' boundaries to that neighbouring cluster for which
    ``cost(vertices, own, to)`` (C,) is least, where it is negative.

    Each sweep looks at every other vertex, so that neighbours seldom move together. Returns how
    many of those looked at moved, as a share.
    """
    between = edges[label[edges[:, 0]] != label[edges[:, 1]]]
    both = np.concatenate([between, between[:, ::-1]])
    both = both[(both[:, 0] * 2654435761 >> 7) % 2 == sweep % 2]
    v, to = both[:, 0], label[both[:, 1]]
    own, change = label[v], cost(v, label[v], to)
    best = np.lexsort((change, v))
    best = best[np.append(True, v[best[1:]] != v[best[:-1]])[: len(best)]]
    best = best[change[best] < 0]
    size, leaving = np.bincount(label), np.bincount(own[best], minlength=label.max() + 1)
    best = best[(size > leaving)[own[best]]]
    label[v[best]] = to[best]
    return len(best) / max(1, len(np.unique(v)))


def _sums(label, feature, area):
    size = np.bincount(label, area)
    return np.stack(
        [np.bincount(label, area * f, minlength=len(size)) for f in feature.T], axis=1
    ), np.maximum(size, 1e-300)


def _squared(x):
    return np.einsum("ij,ij->i", x, x)


def connected(label, edges, weight):
    """The labels with each cluster's heaviest connected piece kept, and the rest given to the
    clusters around it.
    """
    piece = mesh.components(len(label), edges[label[edges[:, 0]] == label[edges[:, 1]]])
    weight_of = np.bincount(piece, weight)
    owner = np.empty(len(weight_of), dtype=np.int64)
    owner[piece] = label
    order = np.lexsort((-weight_of, owner))
    heaviest = np.zeros(len(owner), dtype=bool)
    heaviest[order[np.append(True, owner[order[1:]] != owner[order[:-1]])]] = True
    label = np.where(heaviest[piece], label, -1)
    while (label < 0).any():
        for a, b in (edges.T, edges.T[::-1]):
            take = (label[a] < 0) & (label[b] >= 0)
            label[a[take]] = label[b[take]]
    return label


def split_in_two(label, which, points, edges, weight):
    """The labels with the cluster ``which`` cut across its longest extent; the new cluster has the
    next free number.
    """
    inside = np.flatnonzero(label == which)
    centred = points[inside] - points[inside].mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    label = label.copy()
    label[inside[np.argsort(along, kind="stable")[len(inside) // 2 :]]] = label.max() + 1
    return connected(label, edges, weight)
