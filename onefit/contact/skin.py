"""Cloth beside the skin: the one model of post-processing and simulation.

Points are a garment's vertices, and points of its large faces. A look finds, for each, the body's
triangle nearest to it. From there on that triangle holds the point, wherever the body moves: what
was outside stays outside, however fast a limb is. What is too near is pushed out.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from onefit.body import ClosestSurface
from polyfit.mesh import edges_of

from .planes import Contacts
from .points import samples
from .settings import THINNEST, ContactSettings


class SkinContact:
    """Contact of a garment with ``faces`` (F, 3), at ``rest`` (N, 3) [m], arrays, with skin.

    A look goes as far as ``reach`` [m], beside vertices inside as ``deepest``. Vertices nearer than
    ``least`` [m] are pushed so far out; points of faces nearer than ``point_near`` to
    ``point_least`` [m]. The pushes of the first of ``rounds`` are smoothed so many times
    (``smoothing``) over the mesh; what that leaves inside is pushed again. A point of an edge is
    there for each of its faces, which lean on it, or ``once``. Vertices are float32 tensors (N, 3)
    [m] on the CPU, or Warp arrays of them.
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        settings: ContactSettings,
        *,
        reach: float,
        deepest: float,
        least: float,
        point_near: float,
        point_least: float,
        rounds: int = 1,
        smoothing: int = 0,
        once: bool = False,
    ) -> None:
        from . import kernels  # compiled at the first use

        self._kernels, self._wp, self.settings = kernels, kernels.wp, settings
        self.count = count = len(rest)
        self._pool = ThreadPoolExecutor(1)  # a second thread
        corners, weights = samples(rest, faces, settings.spacing, once)
        own = np.repeat(np.arange(count)[:, None], 4, axis=1)
        #: (P, 4): the vertices, and the points of faces below them: sum_i weights_i x_corners_i
        self.corners = np.concatenate([own, corners])
        self.weights = np.concatenate([np.eye(1, 4).repeat(count, 0), weights])
        self._of_faces = self._array(corners, int, 2), self._array(weights, float, 2)
        edges = edges_of(faces)[0]
        start, end = np.concatenate([edges, edges[:, ::-1]]).T
        first = np.concatenate([[0], np.cumsum(np.bincount(start, minlength=count))])
        #: the neighbours of vertex v: ``around[1][around[0][v]:around[0][v + 1]]``
        self.around = [self._array(a, int) for a in (first, end[np.argsort(start, kind="stable")])]
        self._reach, self._deepest, self._least = reach, deepest, least
        self._of_points = point_near, point_least, settings.reach
        self._rounds, self._smoothing = rounds, smoothing
        empty = lambda size, kind: self._wp.empty(size, dtype=kind, device="cpu")
        #: where each point touches the body: the face, -1 for none, and barycentric coordinates
        self.touched = (
            self._array(np.full(len(self), -1), int),
            empty(len(self), self._wp.vec3),
        )
        self._push, self._work = (empty(count, self._wp.vec3) for _ in range(2))
        self._known, self._queue = (empty(count, self._wp.int32) for _ in range(2))
        # of the points of faces: the wanted push [m], and how near to the body each is at least
        self._found = [empty(len(corners), kind) for kind in (self._wp.vec3, float)]
        self._x = empty(count, self._wp.vec3)
        self._planes = [empty(len(self), kind) for kind in (self._wp.vec3, float, self._wp.vec3)]

    def __len__(self) -> int:
        return len(self.corners)

    def _array(self, values, kind, dimensions=1):
        return self._wp.array(values, dtype=kind, ndim=dimensions, device="cpu")

    def _on_cpu(self, x):
        return self._wp.from_torch(x, dtype=self._wp.vec3) if torch.is_tensor(x) else x

    def vertices(self, x: np.ndarray):
        """Vertices (N, 3) [m], an array, as the other methods take them; until the next call."""
        self._x.numpy()[:] = x
        return self._x

    def look(self, x, surface: ClosestSurface, goal=None) -> None:
        """For each point what it touches of the body's ``surface``, and by how much it is to be
        pushed, on two threads. Where the body lies between ``goal`` (N, 3) [m] and the cloth, this
        is to come to the near side.
        """
        x = self._on_cpu(x)
        goal = x if goal is None else self._on_cpu(goal)
        body, counts = surface.of_kernels, (self.count, len(self) - self.count)
        launch = lambda kernel, count, *a: self._wp.launch(kernel, count, [body, *a], device="cpu")

        def part(half):
            (first, last), (start, end) = ([n * k // 2 for k in (half, half + 1)] for n in counts)
            limits = first, THINNEST, self._least, self._reach
            found = goal, x, self._push, self._known, *self.touched
            launch(self._kernels.first_look, last - first, *limits, *found)
            points = x, *self._of_faces, *self._found, *self.touched
            launch(self._kernels.points_looked_at, end - start, start, *self._of_points, *points)

        other = self._pool.submit(part, 0)
        part(1)
        other.result()

    def push_out(self, x, surface: ClosestSurface) -> np.ndarray:
        """Vertices are pushed out of the body's ``surface`` after a :meth:`look` at them; the last
        round's pushes (N, 3) [m].

        The shortest way, or as :meth:`look` has it of a goal. The pushes, not the surface, are
        smoothed over the mesh, so that no fold is lost and none made. That a vertex is not within
        the reach is quickly told; only beside those found inside, and among those that were pushed,
        deeper ones are looked for. Points of faces push the face's corners.
        """
        limits = self._rounds, self._smoothing, self._least, self._deepest, *self._of_points
        points, work = (*self._of_faces, *self._found), (self._work, self._queue)
        vertices = self._on_cpu(x), self._push, self._known, *self.touched
        arguments = [surface.of_kernels, *self.around, *points, *limits, *vertices, *work]
        self._wp.launch(self._kernels.pushed_out, 1, arguments, device="cpu")
        return self._push.numpy()

    def follow(
        self, surface: ClosestSurface, bodies: np.ndarray, stiffness: np.ndarray
    ) -> Contacts:
        """The body moves to ``bodies`` (V, 3) [m], and its ``surface`` with it; the contacts of the
        step in which it does, after a :meth:`look`: each point that touches is held in front of the
        plane of its triangle, with its ``stiffness`` (P,) [N/m].
        """
        before = self._array(surface.vertices, self._wp.vec3)
        surface.follow(bodies)
        arguments = [surface.of_kernels, before, self.settings.clearance, *self.touched]
        arguments += self._planes
        self._wp.launch(self._kernels.planes, len(self), arguments, device="cpu")
        near = np.flatnonzero(self.touched[0].numpy() >= 0)
        corners, weights = self.corners[near], self.weights[near]
        normal, offset, moved = (a.numpy()[near].astype(float) for a in self._planes)
        return Contacts(near, corners, weights, normal, offset, moved, stiffness[near])
