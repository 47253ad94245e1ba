"""Post-processing of drapes, frame after frame, on the CPU: the cloth keeps its motion, edges come
back towards their lengths in front of the skin, and vertices are pushed out of the body.

A network says what cloth does on average. A mean of folds has shorter edges than cloth, and a mean
of swings is a smaller one.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from onefit.body import ClosestSurface
from onefit.physics import samples

PULL = 50.0  # [1/s^2]: acceleration towards the drape, for a unit distance: a pendulum of 20 cm
NEAR = 0.06  # [m] from the body at rest, where skin doubles the pull
DRAG = 4.0  # [1/m] of the air, times velocity squared: 1.2 kg/m^3 over twice cotton's 0.15 kg/m^2
_SWING_SMOOTHING = 2  # times in a frame
_ROUNDS = 24  # of the lengths
RADIUS = 0.985  # spectral radius of a round, as the acceleration takes it to be
CLEARANCE = 0.003  # [m] from the body
REACH, _LET_GO = 0.006, 0.03  # [m] from the body: cloth touches it, or has gone from there
_PUSHES = 5  # rounds
_THINNEST = 0.02  # [m] of limbs: cloth no farther from the drape has not passed through one
SMOOTHING = 6  # times, of the pushes of the first round
DEEPEST = 0.08  # [m]; vertices deeper in the body than this stay there
SPACING = 0.02  # [m] of the points of faces that are looked at beside the vertices
# [m]: what of these is nearer to the body than the first is pushed to the second, for skin bulges
# between them; and how deep they are looked for
_FACE_NEAR, _FACE_CLEARANCE, _FACE_DEEPEST = 0.0015, 0.002, 0.03
_OF_POINTS = _FACE_NEAR, _FACE_CLEARANCE, _FACE_DEEPEST


def pull(vertices, body, held):
    """How firmly each of a garment's ``vertices`` (N, 3) [m] at rest is drawn to the network's
    drape, (N,) [1/s^2]: by PULL far from the standard ``body`` (:class:`onefit.Body`), more the
    nearer it is to the skin, which holds it; wholly where it is ``held`` (N,), 0 to 1.
    """
    surface = ClosestSurface(body.vertices, body.faces)
    gap = surface(vertices, 10 * NEAR).distance
    gap = np.maximum(np.asarray(gap, dtype=float), CLEARANCE)
    return (PULL * (1 + (NEAR / gap) ** 2) + 1e6 * np.asarray(held)).astype(np.float32)


class PostProcessing:
    """Post-processing of one garment with ``faces`` (F, 3): ``rest`` (N, 3) [m] graded to the body,
    ``lengths`` (E,) [m] at rest of its ``edges`` (E, 2), ``pull`` (N,) [1/s^2] as :func:`pull`
    says; two ``surfaces`` of the body, each a :class:`onefit.body.ClosestSurface`, will follow its
    frames in turn. The methods change a frame ``x`` (N, 3) float32 [m].
    """

    def __init__(self, rest, faces, edges, lengths, pull, surfaces=()):
        from . import kernels  # compiled at the first use

        self._kernels, self._wp, self._count = kernels, kernels.wp, len(rest)
        self._surfaces = surfaces
        self._pool = ThreadPoolExecutor(1)  # a second thread
        rest, faces = rest.cpu().numpy(), faces.cpu().numpy()
        start, end = np.concatenate([edges, edges[:, ::-1]]).T
        degree = np.bincount(start, minlength=self._count)
        first = np.concatenate([[0], np.cumsum(degree)])
        squares = np.asarray(lengths) ** 2
        self._edges = self._array(edges, self._wp.vec2i), self._array(squares, float)
        self._degree = self._array(np.maximum(degree, 1), float)
        self._around = [self._array(a, int) for a in (first, end[np.argsort(start, kind="stable")])]
        corners, weights = _distinct(*samples(rest, faces, SPACING))
        self._points = self._array(corners, int, 2), self._array(weights, float, 2)
        self._pull = self._array(np.asarray(pull), float)
        empty = lambda count, kind: self._wp.empty(count, dtype=kind, device="cpu")
        # of the points: the wanted push [m], and how near to the body each is at least [m]
        self._found = [empty(len(corners), kind) for kind in (self._wp.vec3, float)]
        self._work = [empty(self._count, self._wp.vec3) for _ in range(2)]
        self._known, self._queue = (empty(self._count, self._wp.int32) for _ in range(2))
        # where each vertex touches the body: the face, and barycentric coordinates
        self._touched = (
            self._array(np.full(self._count, -1), int),
            empty(self._count, self._wp.vec3),
        )
        self._planes = empty(self._count, self._wp.vec3), empty(self._count, float)

    def _array(self, values, kind, dimensions=1):
        return self._wp.array(values, dtype=kind, ndim=dimensions, device="cpu")

    def _launch(self, kernel, *arguments, count=1):
        arguments = [
            self._wp.from_torch(a, dtype=self._wp.vec3) if torch.is_tensor(a) else a
            for a in arguments
        ]
        self._wp.launch(kernel, count, arguments, device="cpu")

    def __call__(self, guide, bodies, fps, past=None):
        """Vertices (T, N, 3) [m]: ``guide`` (T, N, 3), a network's drape at ``fps`` frames a
        second, post-processed; ``bodies`` (T, V, 3) [m]; ``past`` (2, N, 3) [m], the cloth in the
        two frames before, as the last call left it. Without a past the motion begins at once,
        and the cloth is in it.
        """
        out = guide.detach().float().cpu().clone()
        goals = self._wp.from_torch(out.clone(), dtype=self._wp.vec3)
        frames = self._wp.from_torch(out, dtype=self._wp.vec3)
        was, before = (None, None) if past is None else past.detach().float().cpu()
        begins = out[min(1, len(out) - 1)] - out[0]
        for t, surface in enumerate(self._followed(bodies.detach().cpu().numpy())):
            x = frames[t]
            if before is not None:
                self.move(x, before, was, 1 / fps)
            else:
                self.look(x, goals[t], surface)
            self.restore_lengths(x, surface)
            self.push_out(x, goals[t], surface)
            was, before = out[0] - begins if before is None else before, x
        return out.to(guide)

    def move(self, x, before, was, dt):
        """One step of ``dt`` [s], by the implicit Euler method: the cloth goes on as from ``was``
        to ``before``, (N, 3) [m], slowed down by the air, and is pulled to where ``x`` has it. How
        far it is from there is smoothed over the mesh: a swing makes no wrinkles.
        """
        arrays = self._pull, DRAG, dt, *self._around, _SWING_SMOOTHING, *self._work
        self._launch(self._kernels.moved, x, before, was, *arrays)

    def restore_lengths(self, x, surface, rounds=_ROUNDS):
        """Edges come nearer to their lengths: errors that span about ten edges are mended, and the
        cloth as a whole hardly moves. Vertices that touched the body at the last :meth:`look` or
        :meth:`push_out` stay in front of the planes of the faces that they touched, which have
        moved with the body's ``surface``: what is tight slides along the skin. A vertex that has
        gone _LET_GO from there is free.
        """
        of_body = CLEARANCE, _LET_GO, surface.of_kernels, *self._touched
        arrays = *self._edges, self._degree, rounds, RADIUS, *of_body, x, *self._work, *self._planes
        self._launch(self._kernels.lengths_restored, *arrays)

    def push_out(self, x, goal, surface, rounds=_PUSHES, reach=REACH):
        """Vertices are pushed to CLEARANCE from the body's ``surface``.

        Where the body lies between the network's drape, ``goal`` (N, 3) [m], and the cloth, the
        cloth comes to the body's near side: a knee that rises fast takes it along. All else goes
        the shortest way. The pushes, not the surface, are smoothed over the mesh, so that no fold
        is lost and none made. What that leaves inside is pushed again, unsmoothed, in at most
        ``rounds`` rounds. That a vertex is not within ``reach`` [m] of the body is quickly told;
        only beside those found inside, and among those that were pushed, deeper ones are looked
        for. Points of the faces, SPACING from each other, push the face's corners
        where they come nearer to the body than _FACE_NEAR.
        """
        self.look(x, goal, surface, reach)
        push, smooth = self._work
        settings = rounds, SMOOTHING, CLEARANCE, DEEPEST, *_OF_POINTS
        points = *self._points, *self._found
        arrays = *self._around, *points, *settings, x, push, self._known, *self._touched
        self._launch(self._kernels.pushed_out, surface.of_kernels, *arrays, smooth, self._queue)

    def look(self, x, goal, surface, reach=REACH):
        """The first look of :meth:`push_out`, on two threads: which vertices are to be pushed, and
        which touch the body, for it is within ``reach`` [m] of them.
        """
        body, counts = surface.of_kernels, (self._count, len(self._points[0]))
        points = *self._points, *self._found

        def part(half):
            (first, last), (start, end) = ([n * k // 2 for k in (half, half + 1)] for n in counts)
            settings = first, _THINNEST, CLEARANCE, reach, goal, x, self._work[0], self._known
            self._launch(
                self._kernels.first_look, body, *settings, *self._touched, count=last - first
            )
            settings = start, *_OF_POINTS, x
            self._launch(
                self._kernels.points_looked_at, body, *settings, *points, count=end - start
            )

        other = self._pool.submit(part, 0)
        part(1)
        other.result()

    def _followed(self, bodies):
        """The surface of each frame; that of the next follows meanwhile."""
        surfaces = self._surfaces
        follow = lambda t: self._pool.submit(surfaces[t % 2].follow, bodies[t])
        following = follow(0)
        for t in range(len(bodies)):
            following.result()
            if t + 1 < len(bodies):
                following = follow(t + 1)
            yield surfaces[t % 2]


def _distinct(corners, weights):
    """Of points (P, C) those that differ: a point of an edge is one of both its faces."""
    order = np.argsort(np.where(weights > 0, corners, -1), axis=1)
    corners, weights = (np.take_along_axis(a, order, axis=1) for a in (corners, weights))
    key = np.concatenate([np.where(weights > 0, corners, -1), np.rint(1e6 * weights)], axis=1)
    first = np.unique(key, axis=0, return_index=True)[1]
    return corners[first], weights[first]
