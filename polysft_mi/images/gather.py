"""What the pixels say of a surface, brought to its vertices: sums over the pixels of each triangle
become a gradient at each vertex and a curvature for each pair of neighbours.

Everything is a gather in a fixed order, in double precision: one thread a vertex, or a pair of
neighbours, adds up what its triangles have. So a run repeats bit for bit. Import only after a
Mitsuba variant is set.
"""

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.render import frozen

from .pixels import CORNERS, CURVATURES, FIGURES, SLOPES, packed

# Silhouette pixels add to vertices in any order, which must not show: they do so in integers, in
# units of 2^-40 (of alpha a pixel, and its square).
_UNIT, _MOST = 2.0**40, 1e4
_PAIR = np.array(
    [
        next(k for k, pair in enumerate(CORNERS) if set(pair) == {a, b})
        for a in range(3)
        for b in range(3)
    ]
)  # of corners (a, b), by 3 a + b
_WIDTH = CURVATURES + SLOPES


@dataclass
class Tables:
    """A :class:`polysft_mi.surface.pattern.Pattern` on the device, UInt32 unless told otherwise.

    Lists of a vertex or a pair of neighbours are the entries from ``*_start[k]`` to ``*_start[k +
    1]`` of another array. The U pairs i <= j, upper half of the pattern: ``i``, ``j``, and
    ``pair_start`` (N + 1) of those with each i. ``share``: 9 f + 3 a + b, for each pair, where it
    is the corners a and b of the triangle f; ``curvature``: the first of their three sums,
    likewise. ``corner``: 3 f + a, for each vertex. ``a``, ``b``: the edges' ends; ``edge`` (Int32):
    of each pair, -1 where i = j; ``end``: 2 e, or 2 e + 1 for its second end, for each vertex.
    ``neighbour``: j of each vertex in the whole pattern, ``half``: 2 p, or 2 p + 1 where the pair p
    is j <= i.
    """

    i: mi.UInt32
    j: mi.UInt32
    pair_start: mi.UInt32
    share_start: mi.UInt32
    share: mi.UInt32
    curvature: mi.UInt32
    corner_start: mi.UInt32
    corner: mi.UInt32
    a: mi.UInt32
    b: mi.UInt32
    edge: mi.Int32
    end_start: mi.UInt32
    end: mi.UInt32
    neighbour_start: mi.UInt32
    neighbour: mi.UInt32
    half: mi.UInt32

    @classmethod
    def of(cls, pattern):
        i, j = pattern.row[pattern.upper], pattern.column[pattern.upper]
        faces, edges, count = pattern.faces, pattern.edges, pattern.count
        a, b = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
        first, second = faces[:, a].ravel(), faces[:, b].ravel()
        kept = np.flatnonzero(first <= second)
        edge = np.full(len(i), -1)
        edge[pattern.half_edges] = np.arange(len(edges))
        share_start, share = _listed(pattern.find_half(first[kept], second[kept]), kept, len(i))
        curvature = _WIDTH * (share // 9) + 3 * _PAIR[share % 9]
        corner_start, corner = _listed(faces.ravel(), np.arange(faces.size), count)
        end_start, end = _listed(edges.ravel(), np.arange(edges.size), count)
        pair_start = np.searchsorted(i, np.arange(count + 1))
        lists = pair_start, share_start, share, curvature, corner_start, corner
        of_edges = *edges.T, edge, end_start, end
        arrays = i, j, *lists, *of_edges, pattern.start, pattern.column, pattern.half
        return cls(*(on_device(x, f.type) for f, x in zip(fields(cls), arrays)))


def _listed(keys, values, count):
    """Values in the order of their keys, and where each of ``count`` keys begins, (count + 1,)."""
    order = np.argsort(keys, kind="stable")
    return np.searchsorted(keys[order], np.arange(count + 1)), values[order]


@dataclass
class Images:
    """What a frame's images say at the vertices: ``gradient`` Float64 of 3N [1/m]; ``second``
    Float64 of 4U: Gauss-Newton's curvature, 2 x 2, of each pair of neighbours, in their projections
    [1/pixel^2]."""

    gradient: mi.Float64
    second: mi.Float64

    def __add__(self, other):
        return Images(self.gradient + other.gradient, self.second + other.second)


def add(start, index, value, count):
    """Sums of value(entry), a list of ``count`` Float64, over the entries of each list."""
    k = dr.arange(mi.UInt32, dr.width(start) - 1)
    begin, end = dr.gather(mi.UInt32, start, k), dr.gather(mi.UInt32, start, k + 1)

    def step(k, *before):
        return k + 1, *(x + y for x, y in zip(before, value(dr.gather(mi.UInt32, index, k))))

    zeros = (dr.zeros(mi.Float64, dr.width(k)) for _ in range(count))
    return list(dr.while_loop((begin, *zeros), lambda k, *_: k < end, step, label="lists")[1:])


def numbers_of(array, index, count):
    """``count`` numbers in a row, from an array of such rows."""
    return [dr.gather(mi.Float64, array, index * count + k) for k in range(count)]


def projection(camera, vertices, index):
    """Derivatives, 2 rows of 3, of vertices' projections [pixels of the video] by their positions.
    ``camera``: Float64 of 12, the inverse of :class:`polysft_mi.render.pinhole.Pinhole`'s basis row
    by row, and its origin."""
    numbers = [dr.gather(mi.Float64, camera, k) for k in range(12)]
    inverse, d = (
        (mi.Vector3d(*numbers[3 * k : 3 * k + 3]) for k in range(3)),
        dr.gather(mi.Vector3d, vertices, index) - mi.Vector3d(*numbers[9:]),
    )
    x, y, z = inverse
    depth = dr.rcp(dr.dot(z, d))
    return [(row - z * (dr.dot(row, d) * depth)) * depth for row in (x, y)]


def congruence(left, matrix, right):
    """left^T matrix right, of lists of rows: (p, q), (p, p), (p, r)."""
    half = [
        [sum(row[m] * right[m][b] for m in range(len(right))) for b in range(len(right[0]))]
        for row in matrix
    ]
    return [
        [sum(left[k][a] * half[k][b] for k in range(len(left))) for b in range(len(right[0]))]
        for a in range(len(left[0]))
    ]


def flattened(rows):
    """The entries of rows, one after the other."""
    return [x for row in rows for x in row]


def rows_of(numbers, width):
    """Rows of ``width`` entries; the reverse of :func:`flattened`."""
    return [numbers[k : k + width] for k in range(0, len(numbers), width)]


def _at_vertices(tables, table, figures, vertices, camera, numbers, silhouette):
    """:class:`Images` of the sums ``table`` (Float of 27F) and ``figures`` (Float of 4F) of the
    triangles.

    ``vertices`` Float64 of 3N [m]; ``numbers`` Float64: weights of all pixels and of a mask's
    pixel, how many are all (0: as many as are seen), and 1 over the grid's stride; ``silhouette``:
    of each pixel there the edge's ends i and j, derivatives ci and cj, excess and share, as
    :func:`polysft_mi.images.pixels.silhouette_terms` gives them, or None.
    """
    weight, mask_weight, area, scale = (dr.gather(mi.Float64, numbers, k) for k in range(4))
    face = dr.arange(mi.UInt32, dr.width(figures) // FIGURES)
    count = dr.sum(mi.Float64(dr.gather(mi.Float, figures, FIGURES * face + 1)))
    weight = weight / dr.select(area > 0, area, dr.maximum(count, 1))
    vertex, pair = (
        dr.arange(mi.UInt32, dr.width(vertices) // 3),
        dr.arange(mi.UInt32, dr.width(tables.i)),
    )

    def slope(entry):
        face = entry // 3
        return three_floats(face * _WIDTH + CURVATURES + 3 * (entry - 3 * face))

    def three_floats(first):
        return [mi.Float64(dr.gather(mi.Float, table, first + k)) for k in range(3)]

    gradient = [weight * x for x in add(tables.corner_start, tables.corner, slope, 3)]
    xx, xy, yy = (
        weight * scale * scale * x
        for x in add(tables.share_start, tables.curvature, three_floats, 3)
    )
    second = [xx, xy, xy, yy]
    if silhouette is not None:
        pull, block = _silhouette(tables, silhouette, dr.width(vertex), dr.width(pair))
        rows = projection(camera, vertices, vertex)
        pull, block = (
            lambda k, x=x: mi.Float64(mi.Int64(dr.gather(mi.UInt64, x, k))) / _UNIT
            for x in (pull, block)
        )
        pull = [2 * mask_weight * scale * pull(2 * vertex + k) for k in range(2)]
        gradient = [x + pull[0] * rows[0][k] + pull[1] * rows[1][k] for k, x in enumerate(gradient)]
        second = [
            x + 2 * mask_weight * scale * scale * block(4 * pair + k) for k, x in enumerate(second)
        ]
    return Images(packed(gradient, vertex), packed(second, pair))


def _silhouette(tables, silhouette, vertices, pairs):
    """Sums over the silhouette's pixels: of excess c at the vertices, 2N, and of share c c^T at the
    pairs of neighbours, 4U; both UInt64 that hold signed numbers of 1 / ``_UNIT`` (unsigned ones
    are what every device can add up atomically)."""
    i, j, ci, cj, excess, share = silhouette
    swapped = i > j
    low, high = dr.select(swapped, j, i), dr.select(swapped, i, j)
    first, second = (mi.Vector2d(dr.select(swapped, *x)) for x in ((cj, ci), (ci, cj)))
    excess, share = mi.Float64(excess), mi.Float64(share)
    begin = dr.gather(mi.UInt32, tables.pair_start, low)
    across = dr.while_loop(
        (begin,),
        lambda k: dr.gather(mi.UInt32, tables.j, k) < high,
        lambda k: (k + 1,),
        label="pair",
    )[0]
    pull, block = dr.zeros(mi.UInt64, 2 * vertices), dr.zeros(mi.UInt64, 4 * pairs)

    def scatter(target, value, index):
        whole = mi.Int64(dr.round(_UNIT * dr.clip(value, -_MOST, _MOST)))
        dr.scatter_add(target, mi.UInt64(whole), index, mode=dr.ReduceMode.Local)

    for at, c in ((low, first), (high, second)):
        own = dr.gather(mi.UInt32, tables.pair_start, at)  # the first pair of a vertex is itself
        for k in range(2):
            scatter(pull, excess * c[k], 2 * at + k)
            for m in range(2):
                scatter(block, share * c[k] * c[m], 4 * own + 2 * k + m)
    for k in range(2):
        for m in range(2):
            scatter(block, share * first[k] * second[m], 4 * across + 2 * k + m)
    return pull, block


class Gather:
    """Sums of pixels brought to the vertices of a mesh with the ``pattern``
    (:class:`polysft_mi.surface.pattern.Pattern`), seen by a ``camera``
    (:class:`polysft_mi.render.pinhole.Pinhole`). The kernels are recorded once.
    """

    def __init__(self, pattern, camera):
        self.tables = Tables.of(pattern)
        self.camera = flat(np.concatenate([camera.inverse.ravel(), camera.origin]))
        self._at_vertices = frozen(_at_vertices)

    def images(self, table, figures, vertices, weight, mask_weight, area, stride, silhouette):
        """:class:`Images` of the triangles' sums and a silhouette. Arguments as the
        kernel takes them; vertices (N, 3) [m]; ``area``: of the mask [pixels of the grid], or None.
        """
        numbers = flat([weight, mask_weight, area or 0, 1 / stride])
        return self._at_vertices(
            self.tables, table, figures, flat(vertices), self.camera, numbers, silhouette
        )


def flat(array):
    """An array as one Float64 on the device, row by row."""
    return on_device(array, mi.Float64)
