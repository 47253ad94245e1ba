"""Points of a sheet's faces, for limbs show through between the vertices of large ones."""

import numpy as np


def samples(
    vertices: np.ndarray, faces: np.ndarray, spacing: float, once: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """``(corners (P, 4), weights (P, 4))`` of points of the ``faces`` (F, 3) and their edges that
    lie ``spacing`` [m] from each other and from the ``vertices`` (N, 3) [m], or nearer; triangles
    that are small enough have none. A point of an edge is there for each of its faces, or ``once``.
    """
    x = vertices[faces]
    longest = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1)
    parts = np.ceil(longest / spacing).astype(int)
    corners, weights = [np.zeros((0, 4), int)], [np.zeros((0, 4))]
    for n in np.unique(parts[parts > 1]):
        i, j = (k.ravel() for k in np.mgrid[: n + 1, : n + 1])
        grid = np.stack([i, j, n - i - j, 0 * i], 1) / n
        grid = grid[(grid.min(1) >= 0) & (grid.max(1) < 1)]
        chosen = faces[parts == n]
        corners.append(np.repeat(chosen[:, [0, 1, 2, 2]], len(grid), axis=0))
        weights.append(np.tile(grid, (len(chosen), 1)))
    found = np.concatenate(corners), np.concatenate(weights)
    return _distinct(*found) if once else found


def _distinct(corners, weights):
    """Of points (P, C) those that differ."""
    order = np.argsort(np.where(weights > 0, corners, -1), axis=1)
    corners, weights = (np.take_along_axis(a, order, axis=1) for a in (corners, weights))
    key = np.concatenate([np.where(weights > 0, corners, -1), np.rint(1e6 * weights)], axis=1)
    first = np.unique(key, axis=0, return_index=True)[1]
    return corners[first], weights[first]
