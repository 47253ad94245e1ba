"""From a sewing pattern to cloth: the panels are cut into triangles, and joined where they are
stitched.

Two edges that are sewn together have as many vertices as each other, evenly along each, so that one
of them may be longer: it is gathered. A vertex of a seam is one, though it has a place in each
panel; so the lengths at rest are those of the faces in their panels.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from onefit.garment.binding import cotangent_laplacian, smoother
from onefit.objective import crossings
from polyfit import mesh
from polyfit.errors import InputError

from .loose import Cut
from .specification import Pattern

_APART = 0.6  # of the spacing, that vertices inside a panel keep from its edges
_ROUND = 40  # times that vertices inside go to the middle of their neighbours
_BENT = 0.10  # [m] from a seam, over which panels bend towards it before they fall
_SHOULDER, _ASIDE = np.array([0.18, 0.0, 1.37]), 0.25  # [m] of the left one; beyond it are sleeves
_DRAWN_OUT = 0.0, 0.03, 0.06, 0.09, 0.12, 0.15  # [m], along the arms
_FINER = 5  # times that edges that are near to each other are cut, in ever more parts
_BETWEEN = 0.05  # [m] of panels that are laid out flat
_NARROW = 1e-3  # [m] that the mean width of no panel is below


def joined(pattern: Pattern, count: int, where: str) -> Iterator[Cut]:
    """The :class:`Cut` of about ``count`` vertices of a pattern, in place around the body that it
    is made for, which stands on z = 0. Its panels are laid out side by side. Sleeves are drawn out
    along the arms, in each cut that is asked for farther, so that the cloth does not pass through
    itself. Raises InputError, in one line that starts with ``where``.
    """
    some = False
    for far in _DRAWN_OUT:
        cut = _joined(_drawn_out(pattern, far), count, where)
        if not crossings(cut.start, cut.faces):
            some = True
            yield cut
    if not some:
        yield cut


def _drawn_out(pattern, far):
    panels = []
    for panel in pattern.panels:
        centre = panel.placed(np.concatenate(panel.edges)).mean(0)
        way = (centre - _SHOULDER * [np.sign(centre[0]), 1, 1]) * [1, 0, 1]
        way *= far * (abs(centre[0]) > _ASIDE) / np.linalg.norm(way)
        panels.append(replace(panel, place=panel.place + way))
    return replace(pattern, panels=tuple(panels))


def _joined(pattern, count, where):
    areas = [_area(np.concatenate([e[:-1] for e in p.edges])) for p in pattern.panels]
    for panel, area in zip(pattern.panels, areas):
        if 2 * area < _NARROW * sum(_length(edge) for edge in panel.edges):
            raise InputError(
                f"{where}: panel {panel.name}: its edges lie on each other, or cross; it is"
                f" narrower than {1000 * _NARROW:g} mm"
            )
    spacing = np.sqrt(2 / np.sqrt(3) * sum(areas) / count)
    parts = _parts(pattern, spacing)
    partner = {one: two for s in pattern.stitches for one, two in ((s.one, s.two), (s.two, s.one))}
    for _ in range(_FINER):
        made = [_triangulated(panel, n, spacing) for panel, n in zip(pattern.panels, parts)]
        missed = [(k, e) for k, (_, _, edges) in enumerate(made) for e in edges]
        if not missed:
            break
        for panel, edge in set(missed) | {partner[m] for m in missed if m in partner}:
            parts[panel][edge] *= 2  # what comes near to another edge
    else:
        name = pattern.panels[missed[0][0]].name
        raise InputError(f"{where}: panel {name}: its edges cross each other")
    flat, faces, places, rims, first, beside = [], [], [], {}, 0, 0.0
    for k, (panel, (points, triangles, _)) in enumerate(zip(pattern.panels, made)):
        starts = np.concatenate([[0], np.cumsum(parts[k])])
        for e, n in enumerate(parts[k]):
            rims[k, e] = first + (starts[e] + np.arange(n + 1)) % starts[-1]
        flat.append(points + [beside, 0] - points.min(0))
        beside = flat[-1][:, 0].max() + _BETWEEN
        places.append(panel.placed(points))
        faces.append(first + triangles)
        first += len(points)
    pairs = [
        np.stack([rims[s.one], rims[s.two][:: 1 if s.along else -1]], axis=1)
        for s in pattern.stitches
    ]
    pairs = np.concatenate([np.zeros((0, 2), int), *pairs])
    return _welded(np.concatenate(flat), np.concatenate(places), faces, pairs, where)


def _parts(pattern, spacing):
    """Of each panel the number of parts of each edge; the same on both sides of a stitch."""
    parts = [[max(1, round(_length(e) / spacing)) for e in p.edges] for p in pattern.panels]
    for stitch in pattern.stitches:
        (p, e), (q, f) = stitch.one, stitch.two
        # a dart's legs meet in its tip: with one part each, they would be one edge
        parts[p][e] = parts[q][f] = max(parts[p][e], parts[q][f], 2 if p == q else 1)
    return parts


def _evenly(curve, count):
    """Points (count + 1, 2) at even lengths of a ``curve`` (n, 2), its ends the first and last."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at = np.linspace(0, along[-1], count + 1)
    return np.stack([np.interp(at, along, x) for x in curve.T], axis=1)


def _length(curve):
    return np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()


def _area(polygon):
    x, y = polygon.T
    return abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2


def _triangulated(panel, parts, spacing):
    """``(points (n, 2), triangles (F, 3), missed)``: even triangles in a panel whose edges have so
    many ``parts``, wound with the angle; the points of the rim come first. ``missed``: the numbers
    of the edges that the triangles do not keep.
    """
    from matplotlib.path import Path
    from scipy.spatial import Delaunay, cKDTree

    rim = np.concatenate([_evenly(e, n)[:-1] for e, n in zip(panel.edges, parts)])
    low, high = rim.min(0), rim.max(0)
    rows = np.arange(low[1], high[1], spacing * np.sqrt(3) / 2)
    steps = np.arange(low[0], high[0] + spacing, spacing)
    grid = [np.stack([steps + spacing / 2 * (k % 2), 0 * steps + y], 1) for k, y in enumerate(rows)]
    inside = np.concatenate([np.zeros((0, 2)), *grid])
    outline = Path(np.concatenate([rim, rim[:1]]))
    inside = inside[outline.contains_points(inside)]
    inside = inside[cKDTree(rim).query(inside)[0] > _APART * spacing] if len(inside) else inside
    points = np.concatenate([rim, inside])
    own = np.arange(len(rim))
    for last in (False, True):
        F = Delaunay(points).simplices
        F = F[outline.contains_points(points[F].mean(1)) & (_angles(points, F) > 1e-4)]
        F = np.where(mesh.signed_areas(points, F)[:, None] < 0, F[:, ::-1], F)
        if not last:
            mean = mesh.neighbour_mean(F, len(points))
            for _ in range(_ROUND):
                points[len(rim) :] = (mean @ points)[len(rim) :]
    sides = {tuple(sorted(e)) for e in mesh.boundary_edges(F).tolist()} if len(F) else set()
    of = np.repeat(np.arange(len(parts)), parts)
    ends = np.sort(np.stack([own, np.roll(own, -1)], 1), axis=1)
    missed = {int(e) for e, end in zip(of, ends.tolist()) if tuple(end) not in sides}
    return points, F, missed if len(sides) <= len(ends) else set(of.tolist())


def _angles(points, F):
    """The least angle of each face (F,) [rad]."""
    side = np.roll(points[F], -1, axis=1) - points[F]
    side /= np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-300)
    return np.arccos(np.clip(-(side * np.roll(side, 1, axis=1)).sum(2), -1, 1)).min(1)


def _welded(flat, places, faces, pairs, where):
    F = np.concatenate(faces)
    label = mesh.components(len(flat), pairs)
    label = np.unique(label, return_inverse=True)[1]
    G = label[F]
    times = np.bincount(label)
    middle = np.stack([np.bincount(label, x) for x in places.T], 1) / times[:, None]
    sewn = (times > 1)[label]
    area, stiffness = cotangent_laplacian(places, F)
    bent = smoother(np.where(sewn, 1e6, 1) * area, stiffness, _BENT)
    start = places + bent(np.where(sewn[:, None], middle[label] - places, 0))
    start = np.stack([np.bincount(label, x) for x in start.T], 1) / times[:, None]
    if (np.roll(G, 1, axis=1) == G).any():
        raise InputError(f"{where}: a stitch sews a face to itself: mesh it with more vertices")
    if (np.bincount(mesh.edges_of(G)[1].ravel()) > 2).any():
        raise InputError(f"{where}: more than two panels meet along a seam")
    turned = mesh.winding(G) < 0
    corners = flat[F]
    G = np.where(turned[:, None], G[:, ::-1], G)
    corners = np.where(turned[:, None, None], corners[:, ::-1], corners)
    return Cut(start, G, start, corners)
