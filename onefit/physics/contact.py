"""What cloth touches: planes that points of the sheet must stay in front of. Here those of the
moving body's triangles; those of other layers of the cloth are in :mod:`onefit.physics.layers`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from onefit.body import ClosestSurface

from .halves import Halves
from .sheet import Sheet, samples


@dataclass(frozen=True)
class Contacts:
    """C contacts: ``key`` (C,), which is which from step to step; ``corners`` (C, 4) and
    ``weights`` (C, 4): the point sum_i w_i x_i; the plane's ``normal`` (C, 3) and ``offset`` (C,)
    [m], so that the gap is normal . point - offset; ``moved`` (C, 3) [m], by what the other side
    moved in the step; ``stiffness`` [N/m] of each. As long as a gap is below ``least`` [m] a step
    has more iterations.
    """

    key: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    moved: np.ndarray
    stiffness: float
    least: float = -np.inf

    def points(self, x: np.ndarray) -> np.ndarray:
        """The points (C, 3) [m] of a sheet with vertices at ``x`` (N, 3) [m]."""
        return np.einsum("ck,ckj->cj", self.weights, x[self.corners])

    def gap(self, x: np.ndarray) -> np.ndarray:
        """How far they are in front of the planes, (C,) [m]."""
        return np.einsum("cj,cj->c", self.points(x), self.normal) - self.offset


class BodyContact:
    """Contacts of a sheet with a body that moves: ``vertices`` (V, 3) [m] at first, ``faces``.

    A point is held in front of the plane of the triangle that was nearest to it at the start of the
    step, which moves with the body. So the side is that of the start, however fast the body is.
    """

    def __init__(self, sheet: Sheet, vertices: torch.Tensor, faces: torch.Tensor, settings) -> None:
        self.settings, self.faces = settings, faces.cpu().numpy()
        self.stiffness = settings.contact * sheet.material.stretch
        self.count = count = len(sheet)
        own = np.zeros((count, 4))
        own[:, 0] = 1
        corners, weights = samples(sheet.rest, sheet.faces, settings.spacing)
        self.corners = np.concatenate([np.repeat(np.arange(count)[:, None], 4, axis=1), corners])
        self.weights = np.concatenate([own, weights])
        self.surface = ClosestSurface(vertices, faces)
        self.body = vertices.double().numpy()
        self._halves = Halves()

    def __len__(self) -> int:
        return len(self.corners)

    def points(self, x: np.ndarray) -> np.ndarray:
        """The vertices (N, 3) and, below them, the points of the faces: (P, 3)."""
        of_faces = slice(len(x), None)
        inner = (x[self.corners[of_faces]] * self.weights[of_faces, :, None]).sum(1)
        return np.concatenate([x, inner])

    def find(self, x: np.ndarray) -> None:
        """Look for what is near to the vertices (N, 3) [m], on the body where it is now."""
        points = torch.as_tensor(self.points(x)).float()
        ask = lambda first, last: self.surface(points[first:last], self.settings.reach)
        found = self._halves(ask, len(points))
        self.face, self.barycentric, self.point, self.distance, self.normal = (
            torch.cat([getattr(n, name) for n in found]).numpy()
            for name in ("face", "barycentric", "point", "distance", "normal")
        )

    def follow(self, vertices: np.ndarray) -> Contacts:
        """The body moves to ``vertices`` (V, 3) [m]; the contacts of the step in which it does."""
        near = np.flatnonzero(self.face >= 0)
        corners, b = self.faces[self.face[near]], self.barycentric[near, :, None]
        now = vertices[corners]
        point, before = (now * b).sum(1), (self.body[corners] * b).sum(1)
        normal = np.cross(now[:, 1] - now[:, 0], now[:, 2] - now[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offset = (normal * point).sum(1) + self.settings.clearance
        self.body = vertices
        self.surface.follow(vertices)
        corners, weights = self.corners[near], self.weights[near]
        return Contacts(near, corners, weights, normal, offset, point - before, self.stiffness)

    def on_skin(self) -> np.ndarray:
        """Which vertices touch the body or are about to, (N,); after :meth:`find`."""
        return self.distance[: self.count] < 2 * self.settings.clearance

    def pushed_out(self, x: np.ndarray) -> np.ndarray:
        """The vertices (N, 3) [m] after those nearer to the body than ``least``, and the corners of
        points of faces that are, were pushed so far out; after :meth:`find`.
        """
        least = self.settings.least
        deep = np.flatnonzero((self.face >= 0) & (self.distance < least))
        push = (least - self.distance[deep, None]) * self.normal[deep]
        out, depth = x.copy(), np.zeros(len(x))
        order = np.argsort(self.distance[deep])[::-1]  # the deepest last: it counts
        for k in range(4):
            used = order[self.weights[deep[order], k] > 0]
            v = self.corners[deep[used], k]
            deeper = least - self.distance[deep[used]] > depth[v]
            v, used = v[deeper], used[deeper]
            out[v], depth[v] = x[v] + push[used], least - self.distance[deep[used]]
        return out
