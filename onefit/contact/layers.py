"""Cloth that meets itself: which parts of a sheet lie near to each other, though they are no
neighbours.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from . import layer_kernels
from .layer_kernels import wp
from .planes import Contacts
from .settings import ContactSettings

_PARTS = 2  # in which pairs are looked for at once


def _array(a, dtype):
    return wp.array(np.ascontiguousarray(a), dtype=dtype, device="cpu")


class SelfContact:
    """Contacts of a sheet with itself, of ``stiffness`` [N/m]: of vertices with triangles, and of
    edges with edges. ``cut`` (N, 3) [m]: where it has no folds; ``faces`` (F, 3). The keys start at
    ``first``, one a vertex.
    """

    def __init__(
        self,
        cut: np.ndarray,
        faces: np.ndarray,
        settings: ContactSettings,
        stiffness: float,
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
        layers.edges = _array(edges.astype(np.int32), int)
        layers.edges_of = _array(number.reshape(-1, 3).astype(np.int32), int)
        layers.owner = _array((owner // 3).astype(np.int32), int)
        self._mesh = wp.Mesh(layers.x, _array(faces.ravel().astype(np.int32), int))
        layers.mesh = self._mesh.id
        self._layers = layers
        self._reaches = wp.zeros(len(rest), dtype=float, device="cpu")
        self._layered = wp.zeros(len(rest), dtype=int, device="cpu")
        self._edge_reaches = wp.zeros(len(edges), dtype=float, device="cpu")
        self._found = [_room(len(rest)) for _ in range(_PARTS)]
        self._before = np.zeros(0, np.dtype((np.void, 20))), np.zeros((0, 3))  # keys and normals
        self._others = ThreadPoolExecutor(_PARTS - 1)

    def find(self, x: np.ndarray, way: np.ndarray | float = 0.0) -> Contacts:
        """The contacts of vertices at (N, 3) [m], on the sides on which they are, or were when this
        was asked last. A vertex looks as far as its ``way`` (N, 3) [m] in the step leads it against
        the others, and a little farther.
        """
        self._layers.x.numpy()[:] = x
        self._mesh.refit()
        way = np.broadcast_to(way, x.shape)
        goes = np.linalg.norm(way - way.mean(0), axis=1)
        self._reaches.numpy()[:] = np.minimum(self._neighbourhood + goes, self.settings.reach)
        while True:
            for found in self._found:
                found.count.numpy()[:] = 0
            near = self._neighbourhood, self._reaches, self._layered
            self._search(layer_kernels.vertices_near, len(x), *near)
            edges = self._layers.edges.shape[0]
            arguments = [self._layers, self._reaches, self._layered, self._edge_reaches]
            wp.launch(layer_kernels.edge_reaches, edges, arguments, device="cpu")
            of_edges = self._neighbourhood, self._edge_reaches
            self._search(layer_kernels.edges_near, edges, *of_edges)
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
        key = self.first + corners[:, 0]
        return Contacts(
            key, corners, weights.astype(float), normal.astype(float), offset, still, self.stiffness
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


def _room(size):
    """Arrays for so many pairs."""
    found = layer_kernels.Found()
    found.count = wp.zeros(1, dtype=int, device="cpu")
    found.corners = wp.zeros((size, 4), dtype=int, device="cpu")
    found.weights = wp.zeros((size, 4), dtype=float, device="cpu")
    found.normal = wp.zeros(size, dtype=wp.vec3, device="cpu")
    return found
