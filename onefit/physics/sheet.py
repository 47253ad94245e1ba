"""A garment's mesh as a thin sheet: what its energies need, found once from the rest shape, and the
energies themselves in torch: readable, differentiable, and what :mod:`onefit.physics.kernels` is
tested against.

Points stand first and frames second, (N, T, 3), as in :mod:`onefit.objective`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from polyfit import mesh

from .material import GRAVITY, Material

_LEAST = 1e-12  # of the roots below, so that a degenerate triangle has a gradient


class Sheet:
    """``rest`` (N, 3) [m] and ``faces`` (F, 3), arrays, of ``material``, or of several, of which
    ``of`` (F,) says each face's. With ``sides`` (F, 3) [m], from each corner of a face to the next,
    the lengths at rest are these, not those of ``rest``, and the sheet rests flat: cloth that hangs
    in folds, as it was cut; NaN: of this face they are those of ``rest``, as its angles are.
    ``cut`` (N, 3) [m] is where it has no folds yet, so that only neighbours are near to each other.

    ``stretch`` and ``drag`` (F,) are the materials' numbers, ``firmness`` [N/m] and ``friction``
    (N,) those of stretch and friction at the vertices; ``area`` (F,) [m^2]; ``mass`` (N,) [kg];
    ``gradients`` (F, 3, 2) [1/m], those of the three corners' hat functions in the plane of the
    triangle, so that F = sum_a x_a g_a^T is the deformation gradient; ``hinges`` (H, 4): the ends
    of an inner edge and the corners opposite to it, of the face that has the edge in this sense and
    of the other; ``angles`` (H,) [rad], those of the hinges at rest; ``stiffness`` (H,) [J], of a
    hinge for a unit angle.
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        material: Material | Sequence[Material],
        sides: np.ndarray | None = None,
        cut: np.ndarray | None = None,
        of: np.ndarray | None = None,
    ) -> None:
        materials = [material] if isinstance(material, Material) else list(material)
        made_of = np.zeros(len(faces), dtype=int) if of is None else np.asarray(of)
        each = lambda name: np.array([float(getattr(m, name)) for m in materials])[made_of]
        self.rest = np.asarray(rest, dtype=np.float64)
        self.faces = np.asarray(faces, dtype=np.int64)
        self.cut = self.rest if cut is None else np.asarray(cut, dtype=np.float64)
        corners = self.rest[self.faces]
        of_rest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        self.sides = of_rest if sides is None else np.where(np.isnan(sides), of_rest, sides)
        flat = flattened(self.sides)
        inverse = np.linalg.inv(flat)
        self.gradients = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)
        self.area = np.linalg.det(flat) / 2
        self.stretch, self.drag = each("stretch"), each("drag")
        self.firmness, self.friction = np.zeros(len(self.rest)), np.zeros(len(self.rest))
        self.firmness[self.faces] = self.stretch[:, None]
        self.friction[self.faces] = each("friction")[:, None]
        share = np.repeat(each("density") * self.area / 3, 3)
        self.mass = np.bincount(self.faces.ravel(), share, len(self.rest))
        self.edges = mesh.edges_of(self.faces)[0]
        self.hinges, side = _hinges(self.faces)
        squared = self.sides.ravel()[side[:, 0]] ** 2
        bending = each("bending")[side[:, 0] // 3]
        self.stiffness = bending * squared / self.area[side // 3].sum(1)
        self.angles = _hinge_angles(torch.as_tensor(self.rest)[:, None], self.hinges)[:, 0].numpy()
        if sides is not None:
            self.angles[~np.isnan(np.ravel(sides)[side[:, 0]])] = 0

    def __len__(self) -> int:
        return len(self.rest)


def flattened(sides: np.ndarray) -> np.ndarray:
    """Matrices (F, 2, 2) [m] whose columns are the sides from corner 0 to 1 and from 0 to 2 of
    triangles laid flat, of the lengths ``sides`` (F, 3) [m] of 01, 12, 20.
    """
    a, b, c = sides.T
    x = (a * a + c * c - b * b) / (2 * a)
    y = np.sqrt(np.maximum(c * c - x * x, _LEAST))
    return np.stack([np.stack([a, x], 1), np.stack([0 * a, y], 1)], 1)


def _hinges(faces):
    """(H, 4) of :class:`Sheet`, and of each the sides (H, 2) of its two faces, 3 face + corner."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    opposite = np.roll(faces, -2, axis=1).ravel()
    count = faces.max() + 1
    key, back = start * count + end, end * count + start
    order = np.argsort(key)
    at = np.searchsorted(key[order], back).clip(max=len(key) - 1)
    other = order[at]
    inner = (key[other] == back) & (start < end)
    chosen, other = np.flatnonzero(inner), other[inner]
    hinges = np.stack([start[chosen], end[chosen], opposite[chosen], opposite[other]], 1)
    return hinges, np.stack([chosen, other], 1)


def deformation(x, sheet):
    """Deformation gradients (F, T, 3, 2) of points (N, T, 3) [m]."""
    gradients = torch.as_tensor(sheet.gradients).to(x)
    corners = x[torch.as_tensor(sheet.faces, device=x.device)]  # (F, 3, T, 3)
    return torch.einsum("fatc,fad->ftcd", corners, gradients)


def stretching(x, sheet):
    """Energy (T,) [J] of points (N, T, 3) [m]: stretch / 2 * area * |F - R|^2 of each triangle, R
    the rotation nearest to F (as-rigid-as-possible; Chao et al. 2010). Its tension is ``stretch``
    times the strain, along both principal directions for itself.

    |F - R|^2 = tr C - 2 tr S + 2, where C = F^T F = S^2 and tr S = sqrt(tr C + 2 sqrt(det C)).
    """
    F = deformation(x, sheet)
    C = F.transpose(-1, -2) @ F
    trace = C[..., 0, 0] + C[..., 1, 1]
    det = C[..., 0, 0] * C[..., 1, 1] - C[..., 0, 1].square()
    squared = trace - 2 * (trace + 2 * det.clamp(min=_LEAST).sqrt()).sqrt() + 2
    weight = torch.as_tensor(sheet.stretch * sheet.area / 2).to(x)
    return (weight[:, None] * squared).sum(0)


def _hinge_angles(x, hinges):
    """Angles (H, T) [rad] between the normals of the triangles on both sides of hinges (H, 4), of
    points (N, T, 3); more than 0 where the outer side is the convex one.
    """
    a, b, c, d = (x[torch.as_tensor(hinges[:, k], device=x.device)] for k in range(4))
    edge = torch.nn.functional.normalize(b - a, dim=-1)
    one, two = torch.linalg.cross(b - a, c - a), torch.linalg.cross(d - a, b - a)
    sine = (torch.linalg.cross(one, two) * edge).sum(-1)
    return torch.atan2(sine, (one * two).sum(-1))


def bending(x, sheet):
    """Energy (T,) [J] of points (N, T, 3) [m]: B / 2 |e|^2 / (A1 + A2) (angle - rest angle)^2 of
    each hinge (Grinspun et al. 2003); the factor makes a cylinder of even triangles cost B / 2
    curvature^2 an area.
    """
    turned = _hinge_angles(x, sheet.hinges) - torch.as_tensor(sheet.angles).to(x)[:, None]
    turned = torch.remainder(turned + torch.pi, 2 * torch.pi) - torch.pi
    return (torch.as_tensor(sheet.stiffness).to(x)[:, None] / 2 * turned.square()).sum(0)


def potential(x, sheet):
    """Potential energy (T,) [J] of points (N, T, 3) [m] above z = 0."""
    return GRAVITY * (torch.as_tensor(sheet.mass).to(x)[:, None] * x[..., 2]).sum(0)
