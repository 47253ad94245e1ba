"""Boundaries of patches moved to where the jets fit best: Lloyd's method with jets for centroids
(after Cohen-Steiner et al. 2004).
"""

import numpy as np
import torch

from polyfit import mesh

from . import clusters

# Weight of a vertex's squared distance from its patch's centroid against its squared distance from
# the jet, each divided by its mean: keeps patches compact.
_COMPACTNESS = 1.0
# Sweeps over the boundaries between two fits.
_SWEEPS_PER_FIT = 4


def refined(surface, rounds, **options):
    """The :class:`polyfit.PatchedSurface` after ``rounds`` times giving vertices at
    boundaries to the neighbouring patch whose jet is nearer, and fitting the jets again with
    ``options``. The number of patches and their connectedness stay; the best round is returned.
    """
    error, order = _error(surface), int(surface.order.max())
    best, least = surface, error
    for _ in range(rounds):
        surface = type(surface).fit(
            surface.patches.relabelled(_reassigned(surface, max(error, 1e-20))), order, **options
        )
        error = _error(surface)
        if error < least:
            best, least = surface, error
    return best


def _error(surface):
    """Mean squared distance of the surface from its mesh [m^2]."""
    weight = torch.as_tensor(
        surface.patches.entry_weight, dtype=surface.uv.dtype, device=surface.uv.device
    )
    return float((surface.residual.detach() ** 2 * weight).sum() / weight.sum())


@torch.no_grad()
def _reassigned(surface, error):
    p = surface.patches
    label, size = p.label.copy(), len(p.label)
    edges = mesh.edges_of(p.sheets)[0]
    points = np.empty((size, 3))
    points[p.sheets] = p.vertices[p.faces]
    area = np.maximum(
        np.bincount(
            p.sheets.ravel(), np.repeat(mesh.areas(p.vertices, p.faces) / 3, 3), minlength=size
        ),
        1e-300,
    )
    tensor = torch.as_tensor(points, dtype=surface.uv.dtype, device=surface.uv.device)
    for sweep in range(_SWEEPS_PER_FIT):
        weight = np.bincount(label, area)
        centre = (
            np.stack([np.bincount(label, area * x) for x in points.T], axis=1) / weight[:, None]
        )

        spread = np.average(((points - centre[label]) ** 2).sum(axis=1), weights=area)

        def squared(v, patch):
            index = [torch.as_tensor(i, device=tensor.device) for i in (v, patch)]
            from_jet = surface.distance(index[1], tensor[index[0]]).double().cpu().numpy()
            return (
                from_jet**2 / error
                + _COMPACTNESS * ((points[v] - centre[patch]) ** 2).sum(axis=1) / spread
            )

        clusters.sweep_boundaries(
            label, edges, sweep, lambda v, own, to: squared(v, to) - squared(v, own)
        )
    return clusters.connected(label, edges, area)
