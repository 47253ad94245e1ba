"""Cloth that meets itself: which parts of a sheet lie near to each other, though they are no
neighbours.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from . import layer_kernels
from .contact import Contacts
from .layer_kernels import wp
from .settings import Settings
from .sheet import Sheet

_PARTS = 2  # in which pairs are looked for at once


def _array(a, dtype):
    return wp.array(np.ascontiguousarray(a), dtype=dtype, device="cpu")


class SelfContact:
    """Contacts of a sheet with itself: of vertices with triangles, and of edges with edges. The
    keys start at ``first``, one a vertex.
    """

    def __init__(self, sheet: Sheet, settings: Settings, first: int) -> None:
        self.settings, self.first = settings, first
        self.stiffness = settings.layers * sheet.material.stretch
        rest, faces = sheet.cut.astype(np.float32), sheet.faces
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
        self._layered = wp.zeros(len(rest), dtype=int, device="cpu")
        self._found = [_room(len(rest)) for _ in range(_PARTS)]
        self._others = ThreadPoolExecutor(_PARTS - 1)

    def find(self, x: np.ndarray) -> Contacts:
        """The contacts of vertices at (N, 3) [m], on the sides on which they are."""
        self._layers.x.numpy()[:] = x
        self._mesh.refit()
        while True:
            for found in self._found:
                found.count.numpy()[:] = 0
            self._search(layer_kernels.vertices_near, len(x))
            self._search(layer_kernels.edges_near, self._layers.edges.shape[0])
            counts = [int(found.count.numpy()[0]) for found in self._found]
            if all(count <= len(found.corners) for count, found in zip(counts, self._found)):
                break
            self._found = [_room(2 * max(counts)) for _ in self._found]
        corners, weights, normal = (
            np.concatenate([getattr(f, name).numpy()[:n] for f, n in zip(self._found, counts)])
            for name in ("corners", "weights", "normal")
        )
        offset, still = np.full(len(corners), self.settings.apart), np.zeros((len(corners), 3))
        key = self.first + corners[:, 0]
        return Contacts(
            key, corners, weights.astype(float), normal.astype(float), offset, still, self.stiffness
        )

    def _search(self, kernel, count):
        """Launches a ``kernel`` for ``count`` vertices or edges, in parts, each in a thread."""
        ends = np.linspace(0, count, _PARTS + 1).astype(int)

        def part(k):
            settings, first = self.settings, int(ends[k])
            near = [2 * settings.apart, settings.approach, self._layered, self._found[k]]
            size = int(ends[k + 1]) - first
            wp.launch(kernel, size, [first, self._layers, *near], device="cpu")

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
