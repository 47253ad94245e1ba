"""Simulation: implicit steps of the cloth's physics on the garment's own mesh, from frame to frame.

A network's drape, or plain skinning, is where the cloth starts, what holds its waistband, and what
it is weakly drawn to; all else are the material, the air, the moving body and the cloth itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from onefit.garment import Stitches
from onefit.physics import Material, Settings, Sheet, WornCloth


def simulated(
    guide: torch.Tensor,
    rest: torch.Tensor,
    faces: torch.Tensor,
    held: np.ndarray,
    bodies: torch.Tensor,
    body_faces: torch.Tensor,
    *,
    material: Material | Sequence[Material],
    steps: int,
    fps: float,
    settings: Settings | None = None,
    first: int = 0,
    sides: np.ndarray | None = None,
    cut: np.ndarray | None = None,
    stitches: Stitches | None = None,
    patches: np.ndarray | None = None,
    of: np.ndarray | None = None,
) -> Iterator[torch.Tensor]:
    """The garment's vertices (N, 3) [m] in one frame after the other, from the ``first`` on: those
    before lead to it, and are not given.

    ``guide`` (T, N, 3) [m]: the drape that leads the cloth; ``rest`` (N, 3) [m] and ``faces``
    (F, 3) of the garment graded to the body, of a ``material``, or of several, of which ``of`` (F,)
    says each face's; ``held`` (N,): how firmly each vertex is held, as
    :func:`onefit.garment.waistband.held` says; ``bodies`` (T, V, 3) [m], ``body_faces`` (G, 3);
    ``steps`` in a frame, in which the body moves along straight lines; ``sides`` (F, 3) [m]: the
    lengths of the faces at rest, and ``cut`` (N, 3) [m], of a garment that was cut otherwise than
    it hangs; ``stitches``: what else holds it together; ``patches`` (N,): the patch of each vertex.
    """
    settings = settings or Settings()
    order = _order(faces.numpy(), len(rest))
    number = np.argsort(order)
    cut = None if cut is None else cut[order]
    sheet = Sheet(rest.double().numpy()[order], number[faces.numpy()], material, sides, cut, of)
    start, moving = guide.double().numpy()[:, order], bodies.numpy()
    threads = None
    if stitches:
        ends = number[stitches.start], number[stitches.corners], stitches.barycentric
        threads = *ends, stitches.lengths
    of = None if patches is None else patches[order]
    worn = WornCloth(sheet, start[0], moving[0], body_faces.numpy(), settings, of, threads)
    cloth, dt = worn.cloth, 1 / fps / steps
    pull = settings.draw * sheet.mass + sheet.firmness * np.asarray(held)[order]

    def step(now, target):
        worn.step(dt, now, target, pull)

    def slowly(now, target):
        step(now, target)
        cloth.v *= settings.damping

    def frame(t, step):
        for k in range(1, steps + 1):
            share = k / steps
            between = lambda x: (1 - share) * x[t - 1] + share * x[t]
            step(between(moving), between(start))

    for t in range(1, first + 1):
        frame(t, slowly)
    for _ in range(round(settings.settling * fps) * steps):
        slowly(moving[first], start[first])
    if len(start) > first + 1:  # the motion begins at once, and the cloth is in it
        cloth.v = fps * (start[first + 1] - start[first])
    yield torch.as_tensor(cloth.x[number]).float()
    for t in range(first + 1, len(start)):
        frame(t, step)
        yield torch.as_tensor(cloth.x[number]).float()


def _order(faces, count):
    """The vertices (N,) in an order in which neighbours are near, for the solver's sweeps."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    link = coo_matrix((np.ones(len(start)), (start, end)), (count, count)).tocsr()
    return np.asarray(reverse_cuthill_mckee((link + link.T).tocsr(), symmetric_mode=True))
