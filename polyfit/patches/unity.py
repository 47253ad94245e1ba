"""The partition of unity by which overlapping patches are blended. NumPy only."""

import numpy as np

LAYERS = 4  # patches that hold a vertex, at most


def shares(vertex: np.ndarray, weight: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Of entries (E,), each a ``vertex`` in a patch with a ``weight``, those that are kept, at most
    :data:`LAYERS` of each of ``count`` vertices, the heaviest, and their shares, whose sum is 1 at
    each vertex. Returns indices (L,), by vertex and falling share, and shares (L,).
    """
    order = np.lexsort((-weight, vertex))
    row = vertex[order]
    rank = np.arange(len(row)) - np.searchsorted(row, row)
    kept = order[(rank < LAYERS) & (weight[order] > 0)]
    total = np.bincount(vertex[kept], weight[kept], minlength=count)
    return kept, weight[kept] / total[vertex[kept]]
