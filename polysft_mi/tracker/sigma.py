"""How sure each vertex is: the curvature of the whole objective at a minimum, and how far the
surface is from what the objective takes it for.

The curvature knows of the noise of pixels alone. Where the surface strains its edges to follow the
images, it is at odds with them, and by how much says more of its error.
"""

import numpy as np
from scipy.linalg import LinAlgError

from polysft_mi.solvers import Reduced

_UNDAMPED = 1e-9
_ROUNDS = 4  # of the mean over neighbours


def along_rays(objective, model, origin):
    """Standard deviation (N,) [m, float32] of each vertex along its ray from ``origin`` (3,) [m]:
    NaN where the curvatures are singular.

    With h that of the curvature, s the root of the mean squared strain around, and r the template's
    scale, it is ``sigma_strain`` (h s r)^1/2, times ``sigma_unseen`` where no pixel sees the
    vertex, and h at least.
    """
    rules, template = objective.rules, objective.problem.template
    noise = _of_noise(objective, model, origin)
    strain = _strain(template, model.surface.vertices)
    seen = objective.seen(model.surface.vertices)
    found = rules.sigma_strain * np.sqrt(noise * strain * template.scale)
    found[~seen] *= rules.sigma_unseen
    return np.maximum(found, noise).astype(np.float32)


def _of_noise(objective, model, origin):
    """(N,) [m]: from the inverse of the curvature, by the pixels' noise."""
    surface, local = model.surface, model.normal.local.shape[-1]
    atlas = objective.atlas
    ray = surface.vertices - origin
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    by_global = atlas.global_columns(surface, ray)
    by_local = np.einsum("nk,nka->na", ray, surface.offset_jacobian)[:, :local]
    try:
        patterns = objective.inputs.operators.patterns
        reduced = Reduced.of(patterns, model.normal, _UNDAMPED)
        variance = reduced.variance(by_local, by_global)
    except (LinAlgError, np.linalg.LinAlgError):
        variance = np.full(len(ray), np.nan)
    return np.sqrt(model.evaluation.noise * variance)


def _strain(template, vertices):
    """(N,): the root of the mean squared strain of the edges around each vertex, smoothed."""
    edges, count = template.edges, len(vertices)
    length, rest = (
        np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
        for x in (vertices, template.vertices)
    )
    squared = np.square(length / rest - 1)
    at = edges.ravel()
    degree = np.maximum(np.bincount(at, minlength=count), 1)
    mean = np.bincount(at, np.repeat(squared, 2), count) / degree
    for _ in range(_ROUNDS):
        near = np.bincount(at, mean[edges[:, ::-1]].ravel(), count) / degree
        mean = (mean + near) / 2
    return np.sqrt(mean)
