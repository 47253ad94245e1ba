"""Polygons as triangles that cover them, concave ones too, wound as they are. NumPy."""

import numpy as np


def triangulated(V: np.ndarray, corner: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of polygons, each corner by its place in ``corner``, in the polygons' order.

    ``corner`` (C,): the vertices of ``V`` (N, 3) at the polygons' corners, one polygon after the
    other; ``sizes`` (P,): how many corners each has, at least 3. A polygon is a fan around its
    first corner where that covers it, so every convex one without three corners in a line; else
    ears are cut off it one by one, in the plane of its mean normal. One that crosses itself is a
    fan.
    """
    corner, sizes = np.asarray(corner, np.int64), np.asarray(sizes, np.int64)
    if not len(sizes):
        return np.empty((0, 3), np.int64)
    start = np.cumsum(sizes) - sizes
    first = np.cumsum(sizes - 2) - (sizes - 2)  # of the triangles
    within = np.arange((sizes - 2).sum()) - np.repeat(first, sizes - 2)
    origin = np.repeat(start, sizes - 2)
    triangles = np.stack([origin, origin + within + 1, origin + within + 2], axis=1)
    if sizes.max() == 3:
        return triangles
    with np.errstate(invalid="ignore", over="ignore"):  # coordinates that are not finite
        p = V[corner[triangles]]
        across = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        normal = np.add.reduceat(across, first)
        along = (across * np.repeat(normal, sizes - 2, axis=0)).sum(axis=1)
        least = np.minimum.reduceat(along, first)
        bad = (least <= 1e-9 * (normal**2).sum(axis=1)) & (sizes > 3)
    for polygon in np.flatnonzero(bad):
        ring = np.arange(start[polygon], start[polygon] + sizes[polygon])
        ears = _ears(V[corner[ring]], normal[polygon])
        if ears is not None:
            triangles[first[polygon] : first[polygon] + len(ears)] = ring[ears]
    return triangles


def _ears(points: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """Triangles (K - 2, 3) of one simple polygon, points (K, 3), that is wound about ``normal``
    (3,); None where there are none, as for one that crosses itself.
    """
    points = points - points.mean(axis=0)
    size = np.abs(points).max(initial=0.0)
    length = float(np.linalg.norm(normal))
    if not (np.isfinite(size) and length > 1e-12 * size**2):
        return None
    n = normal / length
    u = np.cross(np.eye(3)[np.abs(n).argmin()], n)
    u /= np.linalg.norm(u)
    x = np.stack([points @ u, points @ np.cross(n, u)], axis=1) / size
    ring, ears = list(range(len(x))), []
    while len(ring) > 3:
        ear = _best_ear(x[ring])
        if ear is None:
            return None
        ears.append((ring[ear - 1], ring[ear], ring[(ear + 1) % len(ring)]))
        del ring[ear]
    return np.array([*ears, tuple(ring)])


def _best_ear(x: np.ndarray) -> int | None:
    """The corner of a polygon x (K, 2), wound left, that can be cut off with the largest smallest
    angle; None where none can.
    """
    before, after = np.roll(x, 1, axis=0), np.roll(x, -1, axis=0)
    area = _cross(x - before, after - x)
    sides = [np.hypot(*side.T) for side in (x - before, after - x, before - after)]
    longest = np.sort(np.stack(sides), axis=0)[1:].prod(axis=0)
    sine = area / np.maximum(longest, 1e-300)  # of the smallest angle
    for k in np.argsort(-sine, kind="stable"):
        if area[k] <= 1e-12:
            return None
        a, b, c = before[k], x[k], after[k]
        inside = np.minimum.reduce(
            [_cross(q - p, x - p) / max(float(np.hypot(*(q - p))), 1e-300)
             for p, q in ((a, b), (b, c), (c, a))]
        )  # fmt: skip
        blocks = (inside > -1e-9) & (np.abs(x[:, None] - [a, b, c]).max(axis=2) > 1e-9).all(axis=1)
        if not blocks.any():
            return int(k)
    return None


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
