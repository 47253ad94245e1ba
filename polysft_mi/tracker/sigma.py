"""How sure each vertex is.

``sigma`` is what the normal equations say: the curvature of the whole objective at a minimum, by
the noise of the images, and on a body how well the edges' lengths are known as a whole, for they
tell depth. It knows nothing of a wrong model. Where the surface strains its edges to
follow the images, it is at odds with them, and by how much says more of its error: the ``score``,
which is fitted to errors.
"""

import numpy as np
from scipy.linalg import LinAlgError

from polysft_mi.solvers import Reduced

_UNDAMPED = 1e-9
_ROUNDS = 4  # of the mean over neighbours
# of the score, fitted to the errors of ten sequences: its factor, and where no pixel sees a vertex
SCORE, SCORE_UNSEEN = 6.0, 3.3


def along_rays(objective, model, nat, origin):
    """Standard deviation (N,) [m, float32] of each vertex along its ray from ``origin`` (3,) [m]:
    the root of ``nat``, what one unit of log-likelihood costs, times the inverse of the curvature.
    NaN where that is singular. On a body also the distance times what lengths may all be too long.
    """
    surface, local = model.surface, model.normal.local.shape[-1]
    atlas = objective.atlas
    ray = surface.vertices - origin
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    ray /= distance
    by_global = atlas.global_columns(surface, ray)
    by_local = surface.by_offset(ray)[:, :local]
    try:
        patterns = objective.inputs.operators.patterns
        reduced = Reduced.of(patterns, model.normal, _UNDAMPED)
        variance = reduced.variance(by_local, by_global)
    except (LinAlgError, np.linalg.LinAlgError):
        variance = np.full(len(ray), np.nan)
    carrier, known = atlas.carrier, 0.0
    if carrier is not None and carrier.length_errors is not None:
        known = carrier.length_errors[model.state.pose.frame] * distance[:, 0]
    return np.sqrt(nat * variance + known**2).astype(np.float32)


def score(objective, vertices, sigma):
    """How far off each of the ``vertices`` (N, 3) [m] may be along its ray, (N,) [m, float32], from
    its ``sigma`` (N,) [m].

    With s the root of the mean squared strain around, and r the template's scale, it is ``SCORE``
    (sigma s r)^1/2, times ``SCORE_UNSEEN`` where no pixel sees the vertex, and sigma at least: a
    regression of errors.
    """
    template = objective.problem.template
    found = SCORE * np.sqrt(sigma * _strain(template, vertices) * template.scale)
    found[~objective.seen(vertices)] *= SCORE_UNSEEN
    return np.maximum(found, sigma).astype(np.float32)


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
