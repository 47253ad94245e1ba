"""Post-processing of drapes, frame after frame, on the CPU: the cloth keeps its motion, edges come
back towards their lengths in front of the skin, and vertices are pushed out of the body.

A network says what cloth does on average. A mean of folds has shorter edges than cloth, and a mean
of swings is a smaller one.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch

from onefit.body import ClosestSurface
from onefit.contact import (
    DEEPEST,
    POINT_CLEARANCE,
    POINT_NEAR,
    TOUCHING,
    ContactSettings,
    SkinContact,
)

PULL = 50.0  # [1/s^2]: acceleration towards the drape, for a unit distance: a pendulum of 20 cm
NEAR = 0.06  # [m] from the body at rest, where skin doubles the pull
DRAG = 4.0  # [1/m] of the air, times velocity squared: 1.2 kg/m^3 over twice cotton's 0.15 kg/m^2
_SWING_SMOOTHING = 2  # times in a frame
_ROUNDS = 24  # of the lengths
RADIUS = 0.985  # spectral radius of a round, as the acceleration takes it to be
_PUSHES, _SMOOTHING = 5, 6  # rounds; times, of the pushes of the first
CONTACT = ContactSettings()
_OVER_CLOTH = replace(CONTACT, spacing=0.01)  # [m]: folds are narrower than limbs


def pull(vertices, body, held):
    """How firmly each of a garment's ``vertices`` (N, 3) [m] at rest is drawn to the network's
    drape, (N,) [1/s^2]: by PULL far from the standard ``body`` (:class:`onefit.Body`), more the
    nearer it is to the skin, which holds it; wholly where it is ``held`` (N,), 0 to 1.
    """
    surface = ClosestSurface(body.vertices, body.faces)
    gap = surface(vertices, 10 * NEAR).distance
    gap = np.maximum(np.asarray(gap, dtype=float), CONTACT.clearance)
    return (PULL * (1 + (NEAR / gap) ** 2) + 1e6 * np.asarray(held)).astype(np.float32)


def pushes(**near):
    """How a :class:`onefit.contact.SkinContact` pushes drapes out; ``near`` in place of what it is
    for cloth in motion.
    """
    of_motion = dict(reach=TOUCHING, least=CONTACT.clearance)
    of_motion |= dict(point_near=POINT_NEAR, point_least=POINT_CLEARANCE)
    how = dict(deepest=DEEPEST, rounds=_PUSHES, smoothing=_SMOOTHING, once=True)
    return of_motion | how | near


class PostProcessing:
    """Post-processing of one garment with ``faces`` (F, 3): ``rest`` (N, 3) [m] graded to the body,
    ``lengths`` (E,) [m] at rest of its ``edges`` (E, 2), ``pull`` (N,) [1/s^2] as :func:`pull`
    says; two ``surfaces`` of the body, each a :class:`onefit.body.ClosestSurface`, will follow its
    frames in turn; ``under`` gives, for one frame after the other, the surfaces of what else it is
    worn over. The methods change a frame ``x`` (N, 3) float32 [m].
    """

    def __init__(self, rest, faces, edges, lengths, pull, surfaces=(), under=()):
        from . import kernels  # compiled at the first use

        self._kernels, self._wp, self._count = kernels, kernels.wp, len(rest)
        self._surfaces, self._under = surfaces, iter(under)
        self._pool = ThreadPoolExecutor(1)  # a second thread
        #: how the cloth touches the skin
        mesh = rest.cpu().numpy(), faces.cpu().numpy()
        self.skin = SkinContact(*mesh, CONTACT, **pushes())
        self._cloth = SkinContact(*mesh, _OVER_CLOTH, **pushes()) if under else None
        degree = np.bincount(np.asarray(edges).ravel(), minlength=self._count)
        squares = np.asarray(lengths) ** 2
        self._edges = self._array(edges, self._wp.vec2i), self._array(squares, float)
        self._degree = self._array(np.maximum(degree, 1), float)
        self._pull = self._array(np.asarray(pull), float)
        empty = lambda count, kind: self._wp.empty(count, dtype=kind, device="cpu")
        self._work = [empty(self._count, self._wp.vec3) for _ in range(2)]
        self._planes = empty(self._count, self._wp.vec3), empty(self._count, float)

    def _array(self, values, kind):
        return self._wp.array(values, dtype=kind, device="cpu")

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
                self.skin.look(x, surface, goals[t])
            self.restore_lengths(x, surface)
            self.skin.look(x, surface, goals[t])
            self.skin.push_out(x, surface)
            for layer in next(self._under, ()):
                self._cloth.look(x, layer)
                self._cloth.push_out(x, layer)
            was, before = out[0] - begins if before is None else before, x
        return out.to(guide)

    def move(self, x, before, was, dt):
        """One step of ``dt`` [s], by the implicit Euler method: the cloth goes on as from ``was``
        to ``before``, (N, 3) [m], slowed down by the air, and is pulled to where ``x`` has it. How
        far it is from there is smoothed over the mesh: a swing makes no wrinkles.
        """
        arrays = self._pull, DRAG, dt, *self.skin.around, _SWING_SMOOTHING, *self._work
        self._launch(self._kernels.moved, x, before, was, *arrays)

    def restore_lengths(self, x, surface, rounds=_ROUNDS):
        """Edges come nearer to their lengths: errors that span about ten edges are mended, and the
        cloth as a whole hardly moves. Vertices that touched the body at the last look of the
        ``skin`` stay in front of the planes of the faces that they touched, which have moved with
        the body's ``surface``: what is tight slides along the skin. A vertex that has gone the
        contact's reach from there is free.
        """
        of_body = CONTACT.clearance, CONTACT.reach, surface.of_kernels, *self.skin.touched
        arrays = *self._edges, self._degree, rounds, RADIUS, *of_body, x, *self._work, *self._planes
        self._launch(self._kernels.lengths_restored, *arrays)

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
