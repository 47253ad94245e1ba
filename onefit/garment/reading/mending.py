"""Meshes of garments made clean, or refused: one layer of cloth, at most two faces an edge, wound
alike, with openings. NumPy.

The rules, in this order; whatever is changed is told in a sentence, and what is left out goes along
as a part of the garment's :class:`onefit.garment.RenderMesh`:

1. Faces whose corners coincide, faces that repeat others (the other side of a double-sided mesh),
   and vertices in no face are dropped.
2. Where edges of the boundary lie on one another (a seam of the texture, a soup of triangles),
   their vertices are merged. Along seams of panels that were meshed each for itself, edges are cut
   where vertices of the other panel lie on them (:mod:`onefit.garment.reading.zip`).
3. At an edge of three or more faces the two that continue each other straightest stay joined; parts
   that touch in a point come apart.
4. Of separate parts, those below 5 % of the area (buttons, labels, pockets) are no cloth; the
   others stay, each for itself. Refused if less than 80 % of the area would be left.
5. Faces wound against the others of their part are turned. A part with a single side is refused (a
   Moebius strip). Faces whose corners lie in a line are flipped with the next one, or dropped at
   the boundary (:mod:`onefit.garment.reading.flat`).
6. Of cloth with a thickness the outer side is taken (:mod:`onefit.garment.reading.thickness`); a
   solid is refused.
7. Holes of less than 10 cm around are filled.
"""

import contextlib

import numpy as np

from polyfit import mesh
from polyfit.errors import InputError
from polyfit.mesh import loops

from .flat import without_flat
from .thickness import outer_side
from .zip import zipped

_COINCIDENT = 2e-5  # vertices closer than this lie on one another [m]
# Shares of the area: parts that are no cloth, and what has to be left
SMALL_PART_SHARE, _LEAST_SHARE = 0.05, 0.80
_SMALL_HOLE_LENGTH = 0.10  # around [m]


def mended(V, F, where="garment", body=None):
    """``(vertices (N', 3), faces (F', 3), sentences)`` of a mesh in metres around a ``body``, its
    :class:`onefit.body.ClosestSurface`; without one, cloth with a thickness is refused. Raises
    InputError, in one line that starts with ``where``.
    """
    V, F = np.asarray(V, dtype=np.float64), np.asarray(F, dtype=np.int64)
    check(V, F, where)
    told = []
    V, F = _without_slivers(V, F, where, told)
    V, F, merged = _sewn(V, F)
    W, G, cuts = zipped(V, F)
    if cuts or not np.array_equal(W, V):
        W, G, more = _sewn(W, G)
        with contextlib.suppress(InputError):  # boundaries that are near each other may be no seam
            return _one_layer(W, G, merged + more, cuts, body, where, told)
    return _one_layer(V, F, merged, 0, body, where, told)


def _one_layer(V, F, merged, cuts, body, where, told):
    """:func:`mended` from the third rule on; ``merged`` and ``cuts``: what the second did."""
    told = [*told]
    if cuts:
        told.append(f"cut the boundary at {cuts} places where vertices of another one lie on it")
    if merged:
        told.append(f"merged {merged} vertices of the boundary with others that lie on them")
    V, F = _without_slivers(V, F, where, told)
    V, F = _cut_apart(V, F, told)
    V, F = _large_parts(V, F, where, told)
    F = _wound_alike(V, F, where, told)
    F, flat = without_flat(V, F)
    if flat:
        told.append(f"flipped or dropped {flat} faces whose corners lie in a line")
        V, F = _without_slivers(V, F, where, told)
    V, F = _outer_sides(V, F, body, where, told)
    if (count := parts(F).max() + 1) > 1:
        told.append(f"has {count} separate parts, which move each for itself")
    V, F = _filled(V, F, told)
    return V, F, tuple(told)


def check(V, F, where="garment"):
    """Raises InputError where there are no faces, or vertices of theirs that are not finite or all
    in one place.
    """
    if len(V) == 0 or len(F) == 0:
        raise InputError(f"{where}: no faces; a garment is a mesh of triangles or quads")
    used = np.unique(F)
    if not (finite := np.isfinite(V[used]).all(axis=1)).all():
        first = used[finite.argmin()]
        count = f"{(~finite).sum()} vertices have coordinates that are not finite"
        raise InputError(f"{where}: {count} (the first is vertex {first}, counted from 0)")
    if not np.ptp(V[used], axis=0).max() > 0:
        raise InputError(f"{where}: its faces have no area")


def parts(F):
    """The number of the connected part that each face is in (F,)."""
    return mesh.components(int(F.max()) + 1, np.concatenate([F[:, :2], F[:, 1:]]))[F[:, 0]]


def _without_slivers(V, F, where, told):
    loose = len(V) - len(np.unique(F))
    if loose:
        told.append(f"dropped {loose} vertices that are in no face")
    V, F = mesh.in_use(V, F)
    e = mesh.edges_of(F)[0]
    short = e[np.linalg.norm(V[e[:, 0]] - V[e[:, 1]], axis=1) < _COINCIDENT]
    V, G = _merged(V, F, short)
    whole = (np.roll(G, 1, axis=1) != G).all(axis=1)
    place = mesh.components(len(V), _coinciding(V))
    _, first = np.unique(np.sort(place[G], axis=1), axis=0, return_index=True)
    once = np.zeros(len(G), dtype=bool)
    once[first] = True
    if (~whole).any():
        told.append(f"dropped {(~whole).sum()} faces without area")
    if (whole & ~once).any():
        told.append(f"dropped {(whole & ~once).sum()} faces that repeat others")
    G = G[whole & once]
    if not len(G) or not mesh.areas(V, G).sum() > 1e-8:
        raise InputError(f"{where}: its faces have no area")
    return mesh.in_use(V, G)


def _coinciding(V):
    """Pairs (P, 2) of vertices that lie on one another."""
    from scipy.spatial import cKDTree

    return cKDTree(V).query_pairs(_COINCIDENT, output_type="ndarray").reshape(-1, 2)


def _merged(V, F, pairs):
    """The mesh with the vertices of each of ``pairs`` (P, 2) made one, the one that comes first."""
    label = mesh.components(len(V), pairs)
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    return V[first], label[F]


def _uses(F):
    edges, side = mesh.edges_of(F)
    return edges, np.bincount(side.ravel(), minlength=len(edges))


def _sewn(V, F):
    edges, uses = _uses(F)
    rim_edges = edges[uses == 1]
    rim = np.unique(rim_edges)
    if not len(rim) or not len(pairs := rim[_coinciding(V[rim])]):
        return V, F, 0
    # only where two edges of the boundary coincide: parts that touch in a point stay apart
    place = mesh.components(len(V), pairs)
    _, which, times = np.unique(
        np.sort(place[rim_edges], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    seam = np.unique(rim_edges[(times > 1)[which.ravel()]])
    pairs = pairs[np.isin(pairs, seam).all(axis=1)]
    W, G = _merged(V, F, pairs)
    return W, G, len(V) - len(W)


def _cut_apart(V, F, told):
    edges, side = mesh.edges_of(F)
    uses = np.bincount(side.ravel(), minlength=len(edges))
    order = np.argsort(side.ravel(), kind="stable")
    start = np.cumsum(uses) - uses
    two = start[uses == 2]
    pairs = [np.stack([order[two], order[two + 1]], axis=1)]
    for s, u in zip(start[uses > 2], uses[uses > 2]):
        corner = order[s : s + u]
        a, b, c = (V[F[corner // 3, (corner + k) % 3]] for k in range(3))
        along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        inward = (c - a) - ((c - a) * along).sum(axis=1, keepdims=True) * along
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-300)
        i, j = np.unravel_index(np.argmin(inward @ inward.T + 3 * np.eye(u)), (u, u))
        pairs.append(corner[None, [i, j]])
    one, two = np.concatenate(pairs).T
    after = lambda corner: corner - corner % 3 + (corner + 1) % 3
    alike = F.ravel()[one] == F.ravel()[two]
    joined = [
        (one, np.where(alike, two, after(two))),
        (after(one), np.where(alike, after(two), two)),
    ]
    label = mesh.components(F.size, np.concatenate([np.stack(p, axis=1) for p in joined]))
    if (uses > 2).any():
        told.append(f"cut apart at {(uses > 2).sum()} edges where more than two faces meet")
    count = label.max() + 1
    if count > len(V) and not (uses > 2).any():
        told.append(f"cut apart at {count - len(V)} vertices where parts touch in a point")
    if count == len(V):
        return V, F
    W = np.empty((count, 3))
    W[label] = V[F.ravel()]
    return W, label.reshape(-1, 3)


def _large_parts(V, F, where, told):
    part, area = parts(F), mesh.areas(V, F)
    share = np.bincount(part, area) / area.sum()
    keep = share >= SMALL_PART_SHARE
    if share[keep].sum() < _LEAST_SHARE:
        found = (
            f"falls apart into {len(share)} parts, {100 * share[~keep].sum():.0f} % of its area in"
            " small ones"
        )
        raise InputError(f"{where}: {found}; faces joined by common vertices are needed")
    if not keep.all():
        few = "a part" if (~keep).sum() == 1 else f"{(~keep).sum()} parts"
        told.append(
            f"{few} of {(~keep[part]).sum()} faces, {100 * share[~keep].sum():.2g} % of the area,"
            " go along with the cloth"
        )
    return mesh.in_use(V, F[keep[part]])


def _wound_alike(V, F, where, told):
    turned = mesh.winding(F) < 0
    F = np.where(turned[:, None], F[:, ::-1], F)
    walks = np.stack([F, np.roll(F, -1, axis=1)], axis=-1).reshape(-1, 2)
    if len(np.unique(walks, axis=0)) < len(walks):
        raise InputError(
            f"{where}: a surface with one side only (a Moebius strip); cloth with two sides is"
            " needed"
        )
    if turned.any():
        told.append(f"turned {turned.sum()} faces that were wound against their neighbours")
    return F


def _outer_sides(V, F, body, where, told):
    edges, uses = _uses(F)
    part = parts(F)
    open_parts = part[np.isin(F, edges[uses == 1]).any(axis=1)]
    keep, thickness = np.ones(len(F), dtype=bool), []
    for k in range(part.max() + 1):
        faces = np.flatnonzero(part == k)
        found = None if body is None else outer_side(*mesh.in_use(V, F[faces]), body)
        if found is None and k not in open_parts:
            raise InputError(
                f"{where}: a closed surface without openings, not cloth with a thickness below"
                " 2 cm; cloth is needed"
            )
        if found is not None:
            keep[faces] = found[0]
            thickness.append(found[1])
    if not thickness:
        return V, F
    told.append(
        f"took the outer side of cloth that is {1000 * max(thickness):.1f} mm thick, without"
        f" {(~keep).sum()} faces of the inner side"
    )
    V, F = mesh.in_use(V, F[keep])
    return _large_parts(V, F, where, [])


def _filled(V, F, told):
    extra, faces, filled = [], [F], 0
    for loop in loops(F):
        following = np.roll(loop, -1)
        if np.linalg.norm(V[following] - V[loop], axis=1).sum() >= _SMALL_HOLE_LENGTH:
            continue
        filled += 1
        if len(loop) == 3:
            faces.append(loop[None, ::-1])
            continue
        centre = len(V) + len(extra)
        extra.append(V[loop].mean(axis=0))
        faces.append(np.stack([following, loop, np.full(len(loop), centre)], axis=1))
    if not filled:
        return V, F
    told.append(
        f"filled {filled} hole{'s' if filled > 1 else ''} of less than"
        f" {100 * _SMALL_HOLE_LENGTH:.0f} cm around"
    )
    return np.concatenate([V, *[x[None] for x in extra]]), np.concatenate(faces)
