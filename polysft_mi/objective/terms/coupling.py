"""What couples the patches of an atlas: where several hold a vertex, each is drawn to the blended
surface (paper, section "OneFit", the boundary loss, which does the same at sampled points).

Blending alone would let two patches move apart, one up and one down, where they overlap. Import
only after a Mitsuba variant is set.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from .term import Term


class PatchCoupling(Term):
    """k_coupling times the squared distances of the patches' points from the vertices that they are
    blended to, weighted by their shares, a mean over the vertices in overlaps, over the template's
    scale squared. Displacements do not count.
    """

    name, setting = "coupling", "k_coupling"

    def __init__(self, inputs):
        super().__init__(inputs)
        self._surface, atlas = inputs.surface, inputs.atlas
        held, entry = atlas.template.weight > 0, atlas.entry_of
        count = max(int((held.sum(1) > 1).sum()), 1)
        self._pairs = []
        # sum_k w_k |p_k - x|^2 = sum over pairs k < l of w_k w_l |p_k - p_l|^2
        for a, b in itertools.combinations(range(entry.shape[1]), 2):
            kept = held[:, a] & held[:, b]
            one, other = entry[kept, a], entry[kept, b]
            weight = atlas.entry_weight[one] * atlas.entry_weight[other]
            patches = np.stack([atlas.entry_patch[one], atlas.entry_patch[other]], 1)
            for pair in np.unique(patches, axis=0):
                at = (patches == pair).all(1)
                self._pairs.append((*pair.tolist(), one[at], other[at], weight[at]))
        self._unit = 1 / (count * atlas.template.scale**2)

    def energy(self, at):
        if not self._pairs:
            return mi.Float(0)
        layers = self._surface.patch_points(at.unknowns)
        middle = sum(weight * mi.Point3d(x) for weight, x in layers)
        apart = sum(weight * dr.squared_norm(mi.Point3d(x) - middle) for weight, x in layers)
        return mi.Float(self.weight * self._unit * dr.sum(apart))

    def add(self, at):
        energy, surface, normal = 0.0, at.surface, at.normal
        size = surface.basis.shape[1] + 6
        for k, m, one, other, share in self._pairs:
            share = share * (self.weight * self._unit)
            apart = surface.points[one] - surface.points[other]
            columns = np.concatenate(
                [_columns(surface, k, one), -_columns(surface, m, other)], 2
            ).reshape(-1, 2 * size)
            weighted = np.repeat(2 * share, 3)[:, None] * columns
            energy += float(share @ (apart * apart).sum(1))
            pull, curvature = weighted.T @ apart.ravel(), weighted.T @ columns
            places = [slice(p * size, (p + 1) * size) for p in (k, m)]
            for a, rows in enumerate(places):
                normal.gradient[rows] += pull[a * size : (a + 1) * size]
                for b, at_ in enumerate(places):
                    normal.glob[rows, at_] += curvature[
                        a * size : (a + 1) * size, b * size : (b + 1) * size
                    ]
        return energy


def _columns(surface, patch, entries):
    """Derivatives (P, 3, A + 6) of the patch's own points by its jet and motion."""
    by_jet = surface.up[patch][:, None] * surface.rest_basis[entries][:, None]
    return np.concatenate([by_jet, surface.rest_motion[entries]], 2)
