"""Faces whose corners lie in a line, as triangulated polygons and T-junctions have them: cloth
without an area there is infinitely stiff for its weight. NumPy.
"""

import numpy as np

from polyfit import mesh

_FLAT = 0.002  # height of a flat face over its longest side
_LEAST = 1e-6  # what is lower is a line, but for rounding
_ROUNDS = 50  # of flips, for many vertices in one line


def without_flat(V, F):
    """``(faces (F', 3), how many flat ones are gone)`` of V (N, 3) [m], F (F, 3) wound alike, at
    most two at an edge. The longest side of a flat face is flipped, where that makes the flatter
    one of the two faces at it half as flat; at the boundary the face is dropped.
    """
    F, kept, counts = F.copy(), np.ones(len(F), dtype=bool), []
    for _ in range(_ROUNDS):
        height, longest = _heights(V, F)
        flat = np.flatnonzero(kept & (height < _FLAT))
        counts.append(len(flat))
        if not len(flat):
            break
        other = _across(F)
        there = set(map(tuple, mesh.edges_of(F[kept])[0].tolist()))
        touched = set()
        for f in flat[np.argsort(height[flat], kind="stable")].tolist():
            k = longest[f]
            g = other[f, k] // 3 if other[f, k] >= 0 else f
            if f in touched or g in touched:
                continue
            if g == f or not kept[g]:
                kept[f] = False
            else:
                a, b, c = (F[f, (k + i) % 3] for i in range(3))
                d = F[g, (other[f, k] + 2) % 3]
                new, made = (min(c, d), max(c, d)), np.array([(c, a, d), (d, b, c)])
                least = max(2 * height[[f, g]].min(), _LEAST)
                if c == d or new in there or _heights(V, made)[0].min() < least:
                    continue
                F[f], F[g] = made
                there.add(new)
            touched |= {f, g}
        if not touched:
            break
    return F[kept], counts[0] - counts[-1]


def _heights(V, F):
    """Of each face the height over its longest side, as a share of that (F,), and which side (F,)
    that is, from corner k to the next.
    """
    side = np.linalg.norm(V[np.roll(F, -1, axis=1)] - V[F], axis=2)
    return 2 * mesh.areas(V, F) / np.maximum(side.max(axis=1), 1e-300) ** 2, side.argmax(axis=1)


def _across(F):
    """For the side from corner k of each face (F, 3) the corner, 3 face + k, from which the other
    face at it walks it; -1 where there is none.
    """
    edge = mesh.edges_of(F)[1].ravel()
    order = np.argsort(edge, kind="stable")
    first = np.flatnonzero(np.diff(edge[order]) == 0)
    other = np.full(F.size, -1)
    other[order[first]], other[order[first + 1]] = order[first + 1], order[first]
    return other.reshape(F.shape)
