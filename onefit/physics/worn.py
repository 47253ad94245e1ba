"""Cloth that is worn: a sheet in motion on a moving body, in contact with it and with itself."""

from __future__ import annotations

import numpy as np

from onefit.body import ClosestSurface
from onefit.contact import SelfContact, SkinContact, ThreadContact

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
        contact, stretch = settings.contact, sheet.material.stretch
        limits = dict.fromkeys(("least", "point_near", "point_least"), contact.least)
        limits |= dict.fromkeys(("reach", "deepest"), contact.reach)
        self._skin = SkinContact(sheet.rest, sheet.faces, contact, **limits)
        self._surface, self._firm = ClosestSurface(body, body_faces), contact.stiffness * stretch
        between, keys = contact.layer_stiffness * stretch, len(self._skin)
        self._itself = SelfContact(sheet.cut, sheet.faces, contact, between, keys)
        keys, self._threads = keys + len(sheet), []
        if threads is not None:
            *ends, lengths = threads
            lengths = np.maximum(lengths, contact.apart)
            self._threads.append(ThreadContact(*ends, lengths, self._firm, keys))
            keys += len(lengths)
        self.cloth = Cloth(sheet, x, settings, keys, patches)
        self._push_out()

    def step(
        self, dt: float, body: np.ndarray, target: np.ndarray, pull: np.ndarray | float
    ) -> None:
        """One step of ``dt`` [s], in which the body moves to ``body`` (V, 3) [m]; ``target`` and
        ``pull`` as :meth:`onefit.physics.Cloth.step` takes them.
        """
        cloth = self.cloth
        contacts = [self._skin.follow(self._surface, body, self._firm)]
        contacts.append(self._itself.find(cloth.x, dt * cloth.v))
        contacts += [threads.find(cloth.x) for threads in self._threads]
        cloth.step(dt, contacts, target, pull)
        self._push_out()

    def _push_out(self):
        at = self._skin.vertices(self.cloth.x)
        self._skin.look(at, self._surface)
        self.cloth.x += self._skin.push_out(at, self._surface)
