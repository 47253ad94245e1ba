"""Contacts of cloth with itself."""

from __future__ import annotations

import numpy as np

from . import layer_kernels as kernels
from .contact import Contacts
from .halves import Halves
from .layer_kernels import wp
from .sheet import Sheet


class SelfContact:
    """Contacts of a sheet with itself: of each vertex with the nearest triangle, and of edges with
    the nearest edge. The keys start at ``first``; there are as many as ``len`` says.
    """

    def __init__(self, sheet: Sheet, settings, first: int) -> None:
        self.sheet, self.settings, self.first = sheet, settings, first
        self.stiffness = settings.layers * sheet.material.stretch
        count, vectors = len(sheet), lambda x: self._array(x.astype(np.float32), wp.vec3)
        self._x, self._rest = vectors(sheet.rest), vectors(sheet.rest)
        self._mesh = wp.Mesh(self._x, self._array(sheet.faces.ravel().astype(np.int32), int))
        self._face = self._array(np.full(count, -1), int)
        self._found, self._normal = vectors(np.zeros((count, 3))), vectors(np.zeros((count, 3)))
        ends = sheet.rest[sheet.edges]
        self._long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 2 * settings.meeting
        self._halves = Halves()

    def __len__(self) -> int:
        return len(self.sheet) + len(self.sheet.edges)

    def _array(self, values, kind):
        return wp.array(values, dtype=kind, device="cpu")

    def find(self, x: np.ndarray, on_skin: np.ndarray | None = None) -> Contacts:
        """The contacts of the step that starts with the vertices at ``x`` (N, 3) [m]. Layers are
        kept on the sides on which they are then, however fast they meet. Where both lie ``on_skin``
        (N,), in an armpit, the skin keeps them apart.
        """
        self._x.numpy()[:] = x
        self._mesh.refit()
        kinds = zip(self._of_vertices(), self._of_edges())
        key, corners, weights, normal = (np.concatenate(pair) for pair in kinds)
        if on_skin is not None:
            free = ~on_skin[corners].all(1)
            key, corners, weights, normal = (a[free] for a in (key, corners, weights, normal))
        offset, still = np.full(len(key), self.settings.apart), np.zeros_like(normal)
        least = -self.settings.apart / 2
        return Contacts(key, corners, weights, normal, offset, still, self.stiffness, least)

    def _of_vertices(self):
        """Keys, corners (C, 4), weights (C, 4) and normals (C, 3)."""
        where = [self._mesh.id, self._x, self._rest, self.settings.meeting]
        into = [self._face, self._found, self._normal]

        def ask(first, last):
            wp.launch(kernels.proximity, last - first, [*where, first, *into], device="cpu")

        self._halves(ask, len(self.sheet))
        vertex = np.flatnonzero(self._face.numpy() >= 0)
        corners = self.sheet.faces[self._face.numpy()[vertex]]
        return (
            self.first + vertex,
            np.concatenate([vertex[:, None], corners], 1),
            np.concatenate([np.ones((len(vertex), 1)), -self._found.numpy()[vertex]], 1),
            self._normal.numpy()[vertex].astype(float),
        )

    def _of_edges(self):
        """The same of edges that have an end near another layer, or may have none though they
        are.
        """
        near = (self._face.numpy()[self.sheet.edges] >= 0).any(1)
        asked = np.flatnonzero(near | self._long)
        edges = self.sheet.edges[asked].astype(np.int32)
        own, other = self._array(edges, wp.vec2i), self._array(edges, wp.vec2i)
        share = self._array(np.zeros((len(asked), 2), np.float32), wp.vec2)
        normal = self._array(np.zeros((len(asked), 3), np.float32), wp.vec3)
        where = [self._mesh.id, self._x, self._rest, own, self.settings.meeting]
        arguments = [*where, other, share, normal]
        wp.launch(kernels.edge_proximity, len(asked), arguments, device="cpu")
        met = np.flatnonzero(other.numpy()[:, 0] >= 0)
        s, t = share.numpy()[met].astype(float).T
        return (
            self.first + len(self.sheet) + asked[met],
            np.concatenate([edges[met], other.numpy()[met]], 1).astype(np.int64),
            np.stack([1 - s, s, t - 1, -t], 1),
            normal.numpy()[met].astype(float),
        )
