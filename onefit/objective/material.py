"""The objective of a garment's deformation by its material: the energies of :mod:`onefit.physics`
in joules, and the collision. What training lowers, unless it is told to take the paper's.
"""

from dataclasses import replace

import torch

from onefit.physics import sheet as physics

from . import losses, objective

_COLLISION_FRAMES = 8  # drawn at random: to look for the body costs more than all else


def evaluate(garment, deformation, scene, sheets, weights, past=None, dt=1 / 30, generator=None):
    """The terms, a dict of tensors in which the weights are in force, and the posed vertices
    (N, T, 3) [m].

    ``sheets``: ``(sheet, frames)`` for each body, its :class:`onefit.physics.sheet.Sheet` and which
    of the T frames are its own; otherwise as :func:`onefit.objective.objective.evaluate`.
    Stretching, bending, gravity and inertia count ``k_m``, the collision ``k_c``.
    """
    x = objective.vertices(garment, garment.changes(deformation), scene.rest, scene.transforms)
    terms = {}
    if weights.k_c:
        some = torch.randperm(x.shape[1], generator=generator)[:_COLLISION_FRAMES].to(x.device)
        seen = replace(scene, body=scene.body[some])
        terms["collision"], _ = objective.collision(garment, x[:, some], seen, weights, generator)
    if weights.k_m:
        root = scene.transforms[:, 0, :, 3]
        energies = [_energies((x - root)[:, frames], sheet) for sheet, frames in sheets]
        for name in energies[0]:
            terms[name] = weights.k_m * torch.cat([e[name] for e in energies]).mean()
        if past is not None:
            of = lambda sheet, frames: losses.inertia(
                *(a[:, frames] for a in (x, *past)), x.new_tensor(sheet.mass), dt
            )
            shares = [len(frames) / x.shape[1] * of(sheet, frames) for sheet, frames in sheets]
            terms["inertia"] = weights.k_m * sum(shares)
    return terms, x


def _energies(x, sheet):
    return dict(
        stretching=physics.stretching(x, sheet),
        bending=physics.bending(x, sheet),
        gravity=physics.potential(x, sheet),
    )
