"""How sure each vertex is, from the curvature of the whole objective at a minimum."""

import numpy as np
from scipy.linalg import LinAlgError

_UNDAMPED = 1e-9


def along_rays(descent, model, origin):
    """Standard deviation (N,) [m, float32] of each vertex along its ray from ``origin`` (3,) [m]:
    NaN where the curvatures are singular.
    """
    surface, local = model.surface, model.normal.local.shape[-1]
    atlas = descent.objective.atlas
    ray = surface.vertices - origin
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    by_global = atlas.global_columns(surface, ray)
    by_local = np.einsum("nk,nka->na", ray, surface.offset_jacobian)[:, :local]
    try:
        variance = descent.reduced(model.normal, _UNDAMPED).variance(by_local, by_global)
    except (LinAlgError, np.linalg.LinAlgError):
        variance = np.full(len(ray), np.nan)
    return np.sqrt(model.evaluation.noise * variance).astype(np.float32)
