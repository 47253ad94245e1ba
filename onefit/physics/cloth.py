"""Cloth in motion: implicit Euler steps of a sheet, each some iterations of Newton's method whose
linear system conjugate gradients solve, started from what the step before found.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from onefit.contact import Contacts, weighted

from . import kernels
from .kernels import ints, reals, wp
from .material import AIR, GRAVITY
from .settings import Settings
from .sheet import Sheet
from .solver import Solver


class _Touch:
    """Contacts as the kernels take them, with friction's ``drag`` (C,) [N/m] for a unit slip, and
    the arrays that receive what they find.
    """

    def __init__(self, contacts: Contacts, drag: np.ndarray) -> None:
        c, self.contacts, self.drag, count = contacts, contacts, drag, len(contacts.key)
        self.arrays = [ints(c.corners), reals(c.weights), reals(c.normal, kernels.vec3)]
        self.arrays += [
            reals(c.offset),
            reals(c.moved, kernels.vec3),
            reals(c.stiffness),
            reals(drag),
        ]
        gap, slip = reals(np.zeros(count)), reals(np.zeros(count))
        self.found = [gap, slip, reals(np.zeros((count, 3, 3)), kernels.mat3)]
        self.gap, self.slip, self.block = (a.numpy() for a in self.found)
        self.coupling = c.weights.sum(1) < 0.5  # or the Hessian is lumped

    def coupled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners, weights and blocks of those that do something and couple their corners."""
        active = np.flatnonzero(((self.gap < 0) | (self.drag > 0)) & self.coupling)
        return self.contacts.corners[active], self.contacts.weights[active], self.block[active]


class Cloth:
    """A ``sheet`` at ``x`` (N, 3) [m] with velocities ``v`` (N, 3) [m/s]; ``keys``: how many
    contacts can be told from each other; ``patches`` (N,): the patch of each vertex, by which
    the :class:`onefit.physics.solver.Solver` is deflated.

    Baraff and Witkin's scheme (SIGGRAPH 1998). With y = x + dt v + dt^2 g, the free flight, a step
    lowers m / (2 dt^2) |x - y|^2 + stretching + bending + air + contacts + friction, linearised at
    y with a positive semidefinite matrix.
    """

    def __init__(
        self,
        sheet: Sheet,
        x: np.ndarray,
        settings: Settings | None = None,
        keys: int = 0,
        patches: np.ndarray | None = None,
    ) -> None:
        self.sheet, self.settings = sheet, settings or Settings()
        self.x = np.array(x, dtype=np.float64)
        self.v = np.zeros_like(self.x)
        self.load, self.slip = np.zeros(keys), np.zeros(keys)  # [N], [m] in the last step
        self.iterations = 0  # of the last step
        self._forced = np.zeros_like(self.x)  # by what forces moved the cloth in the last step
        self._dt = 0.0  # [s], of the last step
        N, E, F, H = len(sheet), sheet.edges, sheet.faces, sheet.hinges
        of_face, self._face_parts = _in_halves(F, N)
        of_hinge, self._hinge_parts = _in_halves(H, N)
        F, H = F[of_face], H[of_hinge]
        each = np.arange(N)
        pairs = np.concatenate([E, E[:, ::-1], np.stack([each, each], 1)])
        where = np.unique(pairs[:, 0] * N + pairs[:, 1])
        at = lambda i, j: np.searchsorted(where, i * N + j)
        beside = [
            (p, q) for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3)) for p, q in ((i, j), (j, i))
        ]
        of_faces = np.stack([at(F[:, a], F[:, b]) for a in range(3) for b in range(3)], 1)
        of_hinges = [at(H[:, i], H[:, i]) for i in range(4)]
        of_hinges += [at(H[:, p], H[:, q]) for p, q in beside]
        first = np.searchsorted(where // N, np.arange(N + 1))
        self._solver = Solver(first, where % N, patches)
        self._middle = ints(self._solver.middle)
        self._faces, self._of_faces = ints(F), ints(of_faces)
        angles, stiffness = sheet.angles[of_hinge], sheet.stiffness[of_hinge]
        self._hinges = ints(H), reals(angles), reals(stiffness)
        self._of_hinges = ints(np.stack(of_hinges, 1).reshape(-1, 14))
        gradients, weight = sheet.gradients[of_face], (sheet.stretch * sheet.area)[of_face]
        self._stretch = reals(gradients, kernels.vec2), reals(weight)
        self._drag = reals(sheet.drag[of_face] * AIR / 2)
        self._vectors = [reals(np.zeros((N, 3)), kernels.vec3) for _ in range(4)]
        self._springs = reals(np.zeros(N))
        self._other = ThreadPoolExecutor(1)  # a second thread

    def touches(self, contacts: Sequence[Contacts], dt: float) -> list[_Touch]:
        """The ``contacts`` of a step of ``dt`` [s], as :meth:`assemble` takes them."""
        slow = self.settings.contact.sticking * dt
        friction = lambda c: self.sheet.friction[c.corners[:, [0, 3]]].mean(1)  # of the two sides
        drag = lambda c: friction(c) * self.load[c.key] / np.maximum(self.slip[c.key], slow)
        return [_Touch(c, drag(c)) for c in contacts]

    def assemble(
        self,
        y: np.ndarray,
        dt: float,
        touches: Sequence[_Touch] = (),
        pull: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """The gradient (N, 3) [N] at ``y`` (N, 3) [m] of all but inertia, weight and pull. The
        matrix stays here, with the masses / dt^2 and the ``pull`` (N,) [N/m].
        """
        x, before, velocity, force = self._vectors
        for vector, value in zip(self._vectors, (y, self.x, self.v, 0)):
            vector.numpy()[:] = value
        self._solver.block.numpy()[:] = 0
        self._springs.numpy()[:] = self.sheet.mass / dt**2 + pull
        into = [force, self._solver.block]
        launch = lambda kernel, size, arguments: wp.launch(kernel, size, arguments, device="cpu")
        launch(kernels.springs, len(y), [self._springs, self._middle, into[1]])
        air = [self._drag, dt, self._of_faces]
        energies = [
            (kernels.bending, self._hinge_parts, [x, *self._hinges, self._of_hinges]),
            (kernels.stretching, self._face_parts, [x, self._faces, *self._stretch, air[2]]),
            (kernels.drag, self._face_parts, [x, before, velocity, self._faces, *air]),
        ]

        def part(which):
            for kernel, ends, arguments in energies:
                first, last = ends[which : which + 2]
                launch(kernel, last - first, [first, *arguments, *into])

        half = self._other.submit(part, 0)  # no vertex is of both halves
        part(1)
        half.result()
        part(2)
        for touch in touches:
            size, places = len(touch.gap), [x, before, *touch.arrays, self._middle]
            launch(kernels.contact, size, [*places, *touch.found, *into])
        none = (np.zeros((0, 4)), np.zeros((0, 4)), np.zeros((0, 3, 3)))
        parts = [none, *(touch.coupled() for touch in touches)]
        self._solver.couple(*(np.concatenate(a) for a in zip(*parts)))
        return force.numpy()

    def product(self, vector: np.ndarray) -> np.ndarray:
        """The matrix that was last assembled times ``vector`` (N, 3)."""
        return self._solver.product(vector)

    def flight(self, dt: float) -> np.ndarray:
        """Where the vertices (N, 3) [m] would be after a step of ``dt`` [s] without any force but
        their weight.
        """
        y = self.x + dt * self.v
        y[:, 2] -= GRAVITY * dt * dt
        return y

    def step(
        self,
        dt: float,
        contacts: Sequence[Contacts] = (),
        target: np.ndarray | None = None,
        pull: np.ndarray | float = 0.0,
    ) -> None:
        """One step of ``dt`` [s]. Each vertex is pulled to ``target`` (N, 3) [m] by springs of
        stiffness ``pull`` (N,) [N/m].
        """
        longer = dt / self._dt if self._dt else 1.0
        self._forced, self.slip, self._dt = longer**2 * self._forced, longer * self.slip, dt
        y = self.flight(dt)
        pull = np.broadcast_to(pull, len(y))
        target = y if target is None else target
        inertia = self.sheet.mass / dt**2
        settings = self.settings
        after, start, self.iterations = y, self._forced, 0
        touches = self.touches(contacts, dt)
        for _ in range(settings.newton):
            gradient = self.assemble(after, dt, touches, pull)
            gradient = gradient + inertia[:, None] * (after - y) + pull[:, None] * (after - target)
            move, done = self._solver.solve(
                -gradient, start, settings.iterations, settings.tolerance
            )
            self.iterations += done
            after, start = after + move, np.zeros_like(y)
        self._forced = after - y
        self._remember(after, touches)
        self.v, self.x = (after - self.x) / dt, after

    def _remember(self, after, touches):
        """Loads and slips of the contacts, for the next step's friction: of those that were in
        touch when the step was last linearised.
        """
        load, slip = np.zeros_like(self.load), np.zeros_like(self.slip)
        for touch in touches:
            c = touch.contacts.of(touch.gap < 0)
            point = weighted(after[c.corners], c.weights)
            gap = np.einsum("ci,ci->c", point, c.normal) - c.offset
            slid = point - weighted(self.x[c.corners], c.weights) - c.moved
            slid -= np.einsum("ci,ci->c", slid, c.normal)[:, None] * c.normal
            np.maximum.at(load, c.key, c.stiffness * np.maximum(-gap, 0))
            np.maximum.at(slip, c.key, np.linalg.norm(slid, axis=1))
        self.load, self.slip = load, slip


def _in_halves(corners, count):
    """An order (E,) of elements with ``corners`` (E, K) of ``count`` vertices in which those of the
    first half of the vertices come first, then those of the second, then those of both; and where
    each part begins and ends, (4,).
    """
    second = corners >= count // 2
    part = np.where(second.all(1), 1, 2 * second.any(1))
    order = np.argsort(part, kind="stable")
    return order, np.searchsorted(part[order], range(4)).tolist()
