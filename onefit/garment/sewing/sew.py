"""From a pattern to a garment's mesh: the level set is cut open at neck, hem and cuffs, remeshed by
clusters (ACVD), and its triangles are evened out by sliding along the surface and along the loops.
Everything is deterministic.
"""

import numpy as np

from onefit.garment.remesh import remeshed

from .patterns import PATTERNS


def sewn(block, name, count=None, bumps=0.0, stretch=(1.0, 1.0, 1.0), **measures):
    """``(vertices (N, 3), faces (F, 3))`` of the pattern ``name``, with its own measures [m] but
    for those given.

    ``count`` of the vertices; ``bumps``: a field [m] on the block's grid that is added to the ease;
    ``stretch`` (3,): triangles are even in a space stretched so.
    """
    pattern, own = PATTERNS[name]
    field, inside = pattern(block, **measures)
    return meshed(block, field - bumps, inside, count or own, stretch)


def meshed(block, field, inside, count, stretch=(1.0, 1.0, 1.0)):
    """``(vertices (N, 3) [m], faces (F, 3))``, about ``count`` vertices, of the level set of
    ``field`` where ``inside`` (x, y, z) is positive; ``stretch`` as in :func:`sewn`.
    """
    V, F = _clipped(*block.mesh(field), inside)
    V, F = remeshed(V * stretch, F, count)
    return V / stretch, F


def _clipped(V, F, inside):
    """The largest part of the surface where ``inside`` (x, y, z) is positive, cut along its
    zeros.
    """
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(V, F)
    surface["inside"] = inside(*V.T)
    part = surface.clip_scalar(scalars="inside", value=0.0, invert=False).triangulate()
    part = part.clean(tolerance=1e-6, absolute=True).extract_largest()
    return np.array(part.points, dtype=np.float64), part.regular_faces.astype(np.int64)
