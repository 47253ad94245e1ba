"""What cloth touches: the moving body's triangles, and itself. Positions go in, contacts come out:
planes that points of the sheet must stay in front of.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from onefit.body import ClosestSurface

from .sheet import Sheet, samples


@dataclass(frozen=True)
class Contacts:
    """C contacts: ``key`` (C,), which is which from step to step; ``corners`` (C, 4) and
    ``weights`` (C, 4): the point sum_i w_i x_i, or, where the weights sum to zero, the vector from
    one point of the sheet to another; the plane's ``normal`` (C, 3) and ``offset`` (C,)
    [m], so that the gap is normal . point - offset; ``moved`` (C, 3) [m], by what the other side
    moved in the step; ``stiffness`` [N/m] of each.
    """

    key: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    moved: np.ndarray
    stiffness: float


def weighted(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The sums (C, 3) of ``x`` (C, K, 3) with ``weights`` (C, K)."""
    return np.einsum("cki,ck->ci", x, weights)


class ThreadContact:
    """Threads between two places of a sheet, from the vertex ``start`` (S,) to the point
    ``barycentric`` (S, 3) of a triangle with ``corners`` (S, 3): no longer than ``lengths`` (S,)
    [m]. The keys start at ``first``, one a thread.
    """

    def __init__(self, start, corners, barycentric, lengths, stiffness: float, first: int) -> None:
        self.corners = np.column_stack([start, corners])
        self.weights = np.column_stack([np.ones(len(start)), -barycentric])
        self.lengths, self.stiffness = lengths, stiffness
        self.keys = first + np.arange(len(start))

    def find(self, x: np.ndarray) -> Contacts:
        """The contacts of vertices at (N, 3) [m]."""
        thread = weighted(x[self.corners], self.weights)
        long = np.linalg.norm(thread, axis=1, keepdims=True)
        towards = -thread / np.maximum(long, 1e-9)
        still = np.zeros((len(thread), 3))
        return Contacts(
            self.keys, self.corners, self.weights, towards, -self.lengths, still, self.stiffness
        )


class BodyContact:
    """Contacts of a sheet with a body that moves: ``vertices`` (V, 3) [m] at first, ``faces``.

    A point is held in front of the plane of the triangle that was nearest to it at the start of the
    step, which moves with the body. So the side is that of the start, however fast the body is.
    """

    def __init__(self, sheet: Sheet, vertices: torch.Tensor, faces: torch.Tensor, settings) -> None:
        self.settings, self.faces = settings, faces.cpu().numpy()
        self.stiffness = settings.contact * sheet.material.stretch
        count = len(sheet)
        own = np.zeros((count, 4))
        own[:, 0] = 1
        corners, weights = samples(sheet.rest, sheet.faces, settings.spacing)
        self.corners = np.concatenate([np.repeat(np.arange(count)[:, None], 4, axis=1), corners])
        self.weights = np.concatenate([own, weights])
        self.surface = ClosestSurface(vertices, faces)
        self.body = vertices.double().numpy()
        self._pool = ThreadPoolExecutor(max(1, torch.get_num_threads()))

    def __len__(self) -> int:
        return len(self.corners)

    def points(self, x: np.ndarray) -> np.ndarray:
        """The vertices (N, 3) and, below them, the points of the faces: (P, 3)."""
        of_faces = slice(len(x), None)
        inner = weighted(x[self.corners[of_faces]], self.weights[of_faces])
        return np.concatenate([x, inner])

    def find(self, x: np.ndarray) -> None:
        """Look for what is near to the vertices (N, 3) [m], on the body where it is now."""
        parts = torch.as_tensor(self.points(x)).float().chunk(self._pool._max_workers)
        found = list(self._pool.map(lambda p: self.surface(p, self.settings.reach), parts))
        self.face, self.barycentric, self.point, self.distance, self.normal = (
            torch.cat([getattr(n, name) for n in found]).numpy()
            for name in ("face", "barycentric", "point", "distance", "normal")
        )

    def follow(self, vertices: np.ndarray) -> Contacts:
        """The body moves to ``vertices`` (V, 3) [m]; the contacts of the step in which it does."""
        near = np.flatnonzero(self.face >= 0)
        corners, b = self.faces[self.face[near]], self.barycentric[near]
        now = vertices[corners]
        point, before = weighted(now, b), weighted(self.body[corners], b)
        normal = np.cross(now[:, 1] - now[:, 0], now[:, 2] - now[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offset = np.einsum("ci,ci->c", normal, point) + self.settings.clearance
        self.body = vertices
        self.surface.follow(vertices)
        corners, weights = self.corners[near], self.weights[near]
        return Contacts(near, corners, weights, normal, offset, point - before, self.stiffness)

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
