"""Cloth that is worn: a sheet in motion on a moving body, in contact with it and with itself."""

from __future__ import annotations

import numpy as np

from onefit.body import ClosestSurface
from onefit.contact import SelfContact, SkinContact, ThreadContact, weighted

from .cloth import Cloth
from .settings import Settings
from .sheet import Sheet


class WornCloth:
    """A ``sheet`` that starts at ``x`` (N, 3) [m] on a body with its vertices at ``body`` (V, 3)
    [m], ``body_faces``. ``patches`` (N,), as :class:`onefit.physics.Cloth` takes them; ``threads``:
    ``(start (S,), corners (S, 3), barycentric (S, 3), lengths (S,))`` of what holds it together, as
    :class:`onefit.contact.ThreadContact` takes them. ``cloth`` is what moves.
    """

    def __init__(
        self,
        sheet: Sheet,
        x: np.ndarray,
        body: np.ndarray,
        body_faces: np.ndarray,
        settings: Settings,
        patches: np.ndarray | None = None,
        threads: tuple | None = None,
    ) -> None:
        contact, firmness = settings.contact, sheet.firmness
        limits = dict.fromkeys(("least", "point_near", "point_least"), contact.least)
        limits |= dict.fromkeys(("reach", "deepest"), contact.reach)
        self._skin = SkinContact(sheet.rest, sheet.faces, contact, **limits)
        self._surface, firm = ClosestSurface(body, body_faces), contact.stiffness * firmness
        self._firm = firm[self._skin.corners[:, 0]]
        between, keys = contact.layer_stiffness * firmness, len(self._skin)
        self._itself = SelfContact(sheet.cut, sheet.faces, contact, between, keys)
        keys, self._threads = keys + len(sheet), []
        if threads is not None:
            *ends, lengths = threads
            lengths = np.maximum(lengths, contact.apart)
            self._threads.append(ThreadContact(*ends, lengths, firm[ends[0]], keys))
            keys += len(lengths)
        self.cloth = Cloth(sheet, x, settings, keys, patches)
        self._target, self._stride, self._most_parts = self.cloth.x, settings.stride, settings.parts
        self._push_out()
        self._target = self.cloth.x.copy()

    def step(
        self, dt: float, body: np.ndarray, target: np.ndarray, pull: np.ndarray | float
    ) -> None:
        """One step of ``dt`` [s], in which the body moves to ``body`` (V, 3) [m]; ``target`` and
        ``pull`` as :meth:`onefit.physics.Cloth.step` takes them. Where cloth flies towards cloth it
        is done in parts, in which body and target go on evenly.
        """
        start = self._surface.vertices.copy(), self._target
        skin, way, pairs = self._ahead(dt, body)
        parts = self._parts(pairs, way)
        if parts == 1:
            self._part(dt, skin, pairs, target, pull)
            return
        self._surface.follow(start[0])
        for k in range(1, parts + 1):
            now, to = (a + k / parts * (b - a) for a, b in zip(start, (body, target)))
            skin, _, pairs = self._ahead(dt / parts, now)
            self._part(dt / parts, skin, pairs, to, pull)

    def _ahead(self, dt, body):
        """The body moves to ``body`` (V, 3) [m]: contacts with it; where the cloth goes (N, 3) [m]
        as it flies, and as the skin takes it along; and what meets there.
        """
        skin = self._skin.follow(self._surface, body, self._firm)
        way = dt * self.cloth.v
        own = skin.of(skin.key < len(way))
        gap = np.einsum("ci,ci->c", self.cloth.x[own.key] + way[own.key], own.normal) - own.offset
        way[own.key] -= np.minimum(gap, 0)[:, None] * own.normal
        return skin, way, self._itself.find(self.cloth.x, way)

    def _parts(self, pairs, way):
        """In how many parts a step is done. A pair stays on its side where that is in its step's
        beginning; if layers go far, other vertices and edges meet than were near.
        """
        vector = lambda x: weighted(x[pairs.corners], pairs.weights)
        goes = np.einsum("ci,ci->c", vector(way), pairs.normal)
        near = np.einsum("ci,ci->c", vector(self.cloth.x), pairs.normal) + goes < pairs.offset
        farthest = -goes.min(initial=0.0, where=near)
        return int(np.clip(np.ceil(farthest / self._stride), 1, self._most_parts))

    def _part(self, dt, skin, pairs, target, pull):
        threads = [threads.find(self.cloth.x) for threads in self._threads]
        self.cloth.step(dt, [skin, pairs, *threads], target, pull)
        self._target = target
        self._push_out()

    def _push_out(self):
        at = self._skin.vertices(self.cloth.x)
        self._skin.look(at, self._surface)
        self.cloth.x += self._skin.push_out(at, self._surface)
