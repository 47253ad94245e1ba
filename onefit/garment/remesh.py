"""A surface with the same shape and loops at another number of vertices. NumPy; ``vertices`` (N, 3)
[m], ``faces`` (F, 3).
"""

import warnings

import numpy as np

from onefit.body import ClosestSurface
from polyfit import mesh
from polyfit.errors import InputError

_SHORTEST = 0.01  # an edge over the median one: below, its ends have become one


def nearest_on_segments(points, a, b):
    """Of points (N, 3) the nearest point (N, 3) on any of the segments from a (S, 3) to b (S,
    3).
    """
    d = b - a
    t = np.einsum("nsd,sd->ns", points[:, None] - a, d) / np.maximum((d * d).sum(axis=1), 1e-300)
    at = a + np.clip(t, 0, 1)[..., None] * d
    best = ((points[:, None] - at) ** 2).sum(axis=2).argmin(axis=1)
    return at[np.arange(len(points)), best]


def _delaunay(V, F):
    """Faces (F, 3) with the edges flipped whose two opposite angles together are more than 180
    degrees, as long as there are any.
    """
    F = F.copy()
    for _ in range(20):
        edges, side = mesh.edges_of(F)
        order, uses = np.argsort(side.ravel(), kind="stable"), np.bincount(side.ravel())
        start = (np.cumsum(uses) - uses)[uses == 2]
        one, two = (
            order[start],
            order[start + 1],
        )  # corners from which the edge is walked, 3 face + k
        to_next = V[np.roll(F, -1, axis=1)] - V[F]
        to_next /= np.maximum(np.linalg.norm(to_next, axis=2, keepdims=True), 1e-300)
        cosine = -(np.roll(to_next, -1, axis=1) * np.roll(to_next, 1, axis=1)).sum(axis=2)
        angle = np.arccos(np.clip(cosine, -1, 1)).ravel()  # opposite to the side from corner k
        total = angle[one] + angle[two]
        there, touched, flips = set(map(tuple, edges.tolist())), set(), 0
        for k in np.argsort(-total, kind="stable")[: (total > np.pi + 1e-3).sum()]:
            f, g = one[k] // 3, two[k] // 3
            a, b, c = (F[f, (one[k] + i) % 3] for i in range(3))
            d = F[g, (two[k] + 2) % 3]
            new = (min(c, d), max(c, d))
            if f in touched or g in touched or new in there:
                continue
            touched |= {f, g}
            there.add(new)
            F[f], F[g] = (c, a, d), (d, b, c)
            flips += 1
        if not flips:
            break
    return F


def remeshed(V, F, count, steps=40):
    """``(vertices, faces)`` with about ``count`` vertices, evenly spread over the surface, the
    boundary's on its loops.

    Clusters of equal area (ACVD) give the triangles; then vertices slide on the surface towards the
    mean of their neighbours, those of a loop along it, and edges are flipped to the Delaunay
    triangulation. A mesh of fewer than 20 vertices for each new one is cut finer first.
    """
    import pyacvd
    import pyvista

    fine, G = np.asarray(V, dtype=np.float64), np.asarray(F, dtype=np.int64)
    while len(fine) < 20 * count:
        G, edges = mesh.subdivided(G)
        fine = np.concatenate([fine, fine[edges].mean(axis=1)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd uses what pyvista has renamed
        clusters = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(fine, G))
        clusters.cluster(int(count))
        made = clusters.create_mesh()
    x, f = np.array(made.points, dtype=np.float64), made.regular_faces.astype(np.int64)
    f = np.where(mesh.winding(f)[:, None] < 0, f[:, ::-1], f)
    surface, rim = ClosestSurface(V, F), mesh.boundary_edges(np.asarray(F))
    own = np.unique(mesh.boundary_edges(f))
    for step in range(steps):
        if step % 10 == 0:
            f = _delaunay(x, f)
            mean = mesh.neighbour_mean(f, len(x), boundary_apart=True)
        y = mean @ x
        x = np.array(surface(0.5 * (x + y)).point, dtype=np.float64)
        if len(own):
            x[own] = nearest_on_segments(0.5 * (x + y)[own], V[rim[:, 0]], V[rim[:, 1]])
    return x, _delaunay(x, f)


def check(V, F, name, count):
    """Raises InputError where faces of a garment called ``name``, that :func:`remeshed` made with
    ``count`` vertices, have no area, as where a sleeve has too few vertices to stay open.
    """
    side = np.linalg.norm(V[np.roll(F, -1, axis=1)] - V[F], axis=2)
    if side.min() < _SHORTEST * np.median(side):
        raise InputError(
            f"{name}: count = {count} vertices are too few, a sleeve or a leg closes; twice as many"
            " may do"
        )
