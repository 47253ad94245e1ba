"""How often a surface passes through itself."""

import numpy as np
from scipy.spatial import cKDTree


def crossings(vertices: np.ndarray, faces: np.ndarray) -> int:
    """How many :func:`crossing_faces` there are."""
    return len(crossing_faces(vertices, faces))


def crossing_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of faces (F, 3) without a common corner that pass through each other, of a
    surface with its vertices at (N, 3) [m]: a side of one pierces the other.
    """
    corners = np.asarray(vertices, dtype=float)[faces]
    centre = corners.mean(1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(1)
    # the wider face of a pair reaches the other's centre within twice its radius
    found = cKDTree(centre).query_ball_point(centre, 2 * radius, return_sorted=False)
    one = np.repeat(np.arange(len(faces)), [len(x) for x in found])
    two = np.concatenate(found).astype(np.int64) if len(faces) else one
    first = (radius[one] > radius[two]) | ((radius[one] == radius[two]) & (one < two))
    one, two = one[first], two[first]
    low, high = corners.min(1), corners.max(1)
    near = ((low[one] <= high[two]) & (low[two] <= high[one])).all(1)
    one, two = one[near], two[near]
    apart = ~(faces[one][:, :, None] == faces[two][:, None]).any((1, 2))
    one, two = np.minimum(one, two)[apart], np.maximum(one, two)[apart]
    through = _pierces(corners[one], corners[two]) | _pierces(corners[two], corners[one])
    return np.column_stack([one, two])[through]


def _pierces(one, two):
    """Whether a side of triangle ``one`` (P, 3, 3) passes through ``two`` (P, 3, 3), (P,)."""
    a, b, c = (two[:, k, None] for k in range(3))
    start, end = one, np.roll(one, -1, axis=1)
    volume = lambda p, q, r, s: np.einsum("pki,pki->pk", np.cross(q - p, r - p), s - p)
    through = volume(a, b, c, start) * volume(a, b, c, end) < 0
    around = np.stack([volume(start, end, p, q) for p, q in ((a, b), (b, c), (c, a))])
    return (through & ((around > 0).all(0) | (around < 0).all(0))).any(1)
