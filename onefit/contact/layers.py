"""Cloth that meets itself: which parts of a sheet lie near to each other, though they are no
neighbours.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from polyfit.mesh import components

from . import layer_kernels
from .layer_kernels import wp
from .planes import Contacts
from .settings import ContactSettings

_PARTS = 2  # in which pairs are looked for at once
_STRAIGHT = 0.7  # of a way along the edges of a grid, at least, is as long as the straight one


def _array(a, dtype):
    return wp.array(np.ascontiguousarray(a), dtype=dtype, device="cpu")


class SelfContact:
    """Contacts of a sheet with itself: of vertices with triangles, and of edges with edges, each
    with the lesser ``stiffness`` (N,) [N/m] of its two sides. ``cut`` (N, 3) [m]: where the sheet
    has no folds; ``faces`` (F, 3). The keys start at ``first``, one a vertex.
    """

    def __init__(
        self,
        cut: np.ndarray,
        faces: np.ndarray,
        settings: ContactSettings,
        stiffness: np.ndarray,
        first: int,
    ) -> None:
        self.settings, self.first, self.stiffness = settings, first, stiffness
        self._neighbourhood = 2 * settings.apart
        rest = cut.astype(np.float32)
        of = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), -1).reshape(-1, 2)
        edges, owner, number = np.unique(of, axis=0, return_index=True, return_inverse=True)
        layers = layer_kernels.Layers()
        layers.x = _array(rest.copy(), wp.vec3)
        layers.rest = _array(rest, wp.vec3)
        layers.along = _array(_along(cut, edges).astype(np.float32), wp.vec4)
        layers.edges = _array(edges.astype(np.int32), int)
        layers.edges_of = _array(number.reshape(-1, 3).astype(np.int32), int)
        layers.owner = _array((owner // 3).astype(np.int32), int)
        layers.faces = _array(faces.astype(np.int32), int)
        layers.way = _array(np.zeros_like(rest), wp.vec3)
        corners = rest[faces]
        self._boxes = [_array(c, wp.vec3) for c in (corners.min(1), corners.max(1))]
        self._tree = wp.Bvh(*self._boxes)
        layers.tree = self._tree.id
        self._layers = layers
        self._layered = wp.zeros(len(rest), dtype=int, device="cpu")
        self._looks = wp.zeros(len(edges), dtype=int, device="cpu")
        self._found = [_room(len(rest)) for _ in range(_PARTS)]
        self._before = np.zeros(0, np.dtype((np.void, 20))), np.zeros((0, 3))  # keys and normals
        self._others = ThreadPoolExecutor(_PARTS - 1)

    def find(self, x: np.ndarray, way: np.ndarray | float = 0.0) -> Contacts:
        """The contacts of vertices at (N, 3) [m], on the sides on which they are, or were when this
        was asked last. A vertex looks as far as its ``way`` (N, 3) [m] in the step leads it against
        the others, and a little farther.
        """
        layers, launch = self._layers, partial(wp.launch, device="cpu")
        layers.x.numpy()[:] = x
        layers.way.numpy()[:] = way - np.broadcast_to(way, x.shape).mean(0)
        launch(layer_kernels.boxes, len(layers.faces), [layers, *self._boxes])
        self._tree.refit()
        near = self._neighbourhood
        while True:
            for found in self._found:
                found.count.numpy()[:] = 0
            self._search(layer_kernels.vertices_near, len(x), near, self._layered)
            looking = [layers, near, self._layered, self._looks]
            launch(layer_kernels.edges_that_look, len(self._looks), looking)
            self._search(layer_kernels.edges_near, len(self._looks), near, self._looks)
            counts = [int(found.count.numpy()[0]) for found in self._found]
            if all(count <= len(found.corners) for count, found in zip(counts, self._found)):
                break
            self._found = [_room(2 * max(counts)) for _ in self._found]
        corners, weights, normal = (
            np.concatenate([getattr(f, name).numpy()[:n] for f, n in zip(self._found, counts)])
            for name in ("corners", "weights", "normal")
        )
        self._keep_sides(corners, weights, normal)
        offset, still = np.full(len(corners), self.settings.apart), np.zeros((len(corners), 3))
        key, stiffness = self.first + corners[:, 0], self.stiffness[corners[:, [0, 3]]].min(1)
        return Contacts(
            key, corners, weights.astype(float), normal.astype(float), offset, still, stiffness
        )

    def _keep_sides(self, corners, weights, normal):
        """Turns each ``normal`` (P, 3) of pairs, with ``corners`` and ``weights`` (P, 4), that have
        passed through each other since the last time: those of a vertex above a triangle, and of
        edges. Others have no sides.
        """
        edges = weights[:, 1] > 0
        sided = np.flatnonzero(edges | (weights[:, 1:].max(1) < 0))
        rows = np.column_stack([edges, corners])[sided].astype(np.int32)
        keys = rows.view(np.dtype((np.void, 20))).ravel()
        before, normals = self._before
        _, now, then = np.intersect1d(keys, before, return_indices=True)
        passed = np.einsum("ci,ci->c", normal[sided[now]], normals[then]) < 0
        normal[sided[now[passed]]] *= -1
        self._before = keys, normal[sided]

    def _search(self, kernel, count, *near):
        """Launches a ``kernel`` for ``count`` vertices or edges, in parts, each in a thread."""
        ends = np.linspace(0, count, _PARTS + 1).astype(int)

        def part(k):
            first = int(ends[k])
            size, arguments = int(ends[k + 1]) - first, [self._layers, *near, self._found[k]]
            wp.launch(kernel, size, [first, *arguments], device="cpu")

        others = [self._others.submit(part, k) for k in range(1, _PARTS)]
        part(0)
        for other in others:
            other.result()


def _along(cut, edges):
    """How far the vertices (N, 3) [m] of a sheet with ``edges`` (E, 2) are from four of them along
    the sheet, (N, 4) [m], or less; each is the farthest from those before it, in its own part.
    """
    count = len(cut)
    long = np.linalg.norm(cut[edges[:, 0]] - cut[edges[:, 1]], axis=1)
    graph = coo_matrix((long, edges.T), (count, count)).tocsr()
    part = components(count, edges)
    ends, found = np.unique(part, return_index=True)[1], []
    for _ in range(5):
        found.append(dijkstra(graph, directed=False, indices=ends, min_only=True))
        order = np.lexsort([np.min(found, axis=0), part])
        ends = order[np.flatnonzero(np.diff(part[order], append=-1))]
    return _STRAIGHT * np.stack(found[1:], 1)  # the first lies anywhere


def _room(size):
    """Arrays for so many pairs."""
    found = layer_kernels.Found()
    found.count = wp.zeros(1, dtype=int, device="cpu")
    found.corners = wp.zeros((size, 4), dtype=int, device="cpu")
    found.weights = wp.zeros((size, 4), dtype=float, device="cpu")
    found.normal = wp.zeros(size, dtype=wp.vec3, device="cpu")
    return found
