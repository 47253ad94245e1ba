"""Normal equations accumulated on the device: per triangle, per vertex and pair of neighbours, per
unknown.

What images say comes as sums over the pixels of each triangle (:mod:`polysft_mi.images.pixels`);
gathered at the vertices, in the image plane, it is joined by the edges' lengths and by shading, in
space, and turned into the unknowns of a jet patch. What is left is for the host's linear algebra
(:mod:`polysft_mi.solvers.normal_equations`). Everything is a gather, in a fixed order: a thread a
vertex, or a pair of neighbours, adds up what its triangles and edges have; double precision.
Kernels are recorded once and launched again without tracing. Import only after a Mitsuba variant is
set.
"""

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.images.pixels import CORNERS, CURVATURES, FIGURES, SLOPES, packed
from polysft_mi.render.device import frozen, on_device
from polysft_mi.solvers.normal_equations import Normal

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
    """A :class:`polysft_mi.solvers.normal_equations.Pattern` on the device, UInt32 unless told
    otherwise.

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
        half = np.empty(len(pattern.row), dtype=np.int64)
        half[pattern.upper], half[pattern.lower] = 2 * np.arange(len(i)), 2 * pattern.mirrored + 1
        share_start, share = _listed(pattern.find_half(first[kept], second[kept]), kept, len(i))
        curvature = _WIDTH * (share // 9) + 3 * _PAIR[share % 9]
        corner_start, corner = _listed(faces.ravel(), np.arange(faces.size), count)
        end_start, end = _listed(edges.ravel(), np.arange(edges.size), count)
        pair_start = np.searchsorted(i, np.arange(count + 1))
        arrays = (
            i,
            j,
            pair_start,
            share_start,
            share,
            curvature,
            corner_start,
            corner,
            *edges.T,
            edge,
            end_start,
            end,
            pattern.start,
            pattern.column,
            half,
        )
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


def _add(start, index, value, count):
    """Sums of value(entry), a list of ``count`` Float64, over the entries of each list."""
    k = dr.arange(mi.UInt32, dr.width(start) - 1)
    begin, end = dr.gather(mi.UInt32, start, k), dr.gather(mi.UInt32, start, k + 1)

    def step(k, *before):
        return k + 1, *(x + y for x, y in zip(before, value(dr.gather(mi.UInt32, index, k))))

    zeros = (dr.zeros(mi.Float64, dr.width(k)) for _ in range(count))
    return list(dr.while_loop((begin, *zeros), lambda k, *_: k < end, step, label="lists")[1:])


def _numbers(array, index, count):
    """``count`` numbers in a row, from an array of such rows."""
    return [dr.gather(mi.Float64, array, index * count + k) for k in range(count)]


def _projection(camera, vertices, index):
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


def _between(left, matrix, right):
    """left^T matrix right, of lists of rows: (p, q), (p, p), (p, r)."""
    half = [
        [sum(row[m] * right[m][b] for m in range(len(right))) for b in range(len(right[0]))]
        for row in matrix
    ]
    return [
        [sum(left[k][a] * half[k][b] for k in range(len(left))) for b in range(len(right[0]))]
        for a in range(len(left[0]))
    ]


def _rows(numbers, width):
    return [numbers[k : k + width] for k in range(0, len(numbers), width)]


def at_vertices(tables, table, figures, vertices, camera, numbers, silhouette):
    """:class:`Images` of the sums ``table`` (Float of 27F) and ``figures`` (Float of 4F) of the
    triangles.

    ``vertices`` Float64 of 3N [m]; ``numbers`` Float64: weights of all pixels and of a mask's
    pixel, how many are all (0: as many as are seen), and 1 over the grid's stride; ``silhouette``:
    of each pixel there the edge's ends i and j, derivatives ci and cj, excess and share, as
    :func:`polysft_mi.pixels.outline` gives them, or None.
    """
    weight, mask_weight, area, scale = (dr.gather(mi.Float64, numbers, k) for k in range(4))
    count = dr.sum(
        mi.Float64(
            dr.gather(
                mi.Float, figures, FIGURES * dr.arange(mi.UInt32, dr.width(figures) // FIGURES) + 1
            )
        )
    )
    weight = weight / dr.select(area > 0, area, dr.maximum(count, 1))
    vertex, pair = (
        dr.arange(mi.UInt32, dr.width(vertices) // 3),
        dr.arange(mi.UInt32, dr.width(tables.i)),
    )

    def slope(entry):
        face = entry // 3
        return three(face * _WIDTH + CURVATURES + 3 * (entry - 3 * face))

    def three(first):
        return [mi.Float64(dr.gather(mi.Float, table, first + k)) for k in range(3)]

    gradient = [weight * x for x in _add(tables.corner_start, tables.corner, slope, 3)]
    xx, xy, yy = (
        weight * scale * scale * x for x in _add(tables.share_start, tables.curvature, three, 3)
    )
    second = [xx, xy, xy, yy]
    if silhouette is not None:
        pull, block = _silhouette(tables, silhouette, dr.width(vertex), dr.width(pair))
        rows = _projection(camera, vertices, vertex)
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


def _edges(tables, vertices, lengths, numbers):
    """What lengths cost: energy of each edge without its weight, and packed, a row an edge: the
    pull on its first end (3), and the curvature, 6 of a symmetric 3 x 3, of either end."""
    stiffness, give = (dr.gather(mi.Float64, numbers, k) for k in range(2))
    a, b = (dr.gather(mi.Vector3d, vertices, k) for k in (tables.a, tables.b))
    edge = a - b
    length = dr.maximum(dr.norm(edge), 1e-9)
    direction, excess = edge / length, length - lengths
    over = dr.square(dr.maximum(excess, 0) / (give * lengths))
    heavy = 2 * stiffness / dr.sqrt(1 + over)
    x, y, z = direction
    columns = [heavy * excess * d for d in direction] + [
        heavy * d for d in (x * x, x * y, x * z, y * y, y * z, z * z)
    ]
    return dr.square(excess) * 2 / (1 + dr.sqrt(1 + over)), packed(
        columns, dr.arange(mi.UInt32, dr.width(tables.a))
    )


_SYMMETRIC = (0, 1, 2, 1, 3, 4, 2, 4, 5)  # a symmetric 3 x 3, row by row, from its upper half


def in_unknowns(
    tables,
    images,
    vertices,
    camera,
    lengths,
    numbers,
    by_offset,
    by_motion,
    basis,
    entry,
    size,
    triangles,
):
    """Normal equations of the images, the edges and the triangles' residuals, in the unknowns of a
    jet patch.

    ``vertices`` Float64 of 3N [m]; ``lengths`` Float64 of E [m], ``numbers`` Float64: stiffness
    [1/m^2], give; ``by_offset`` Float64 of 9N, ``by_motion`` of 18N, ``basis`` of A N: of
    :class:`polysft_mi.solvers.normal_equations.Surface`; ``entry``: 0, 1, ... of A N, and ``size``:
    A, UInt32; ``triangles``: None, or Float64: r h of F, h of F and derivatives of 9F, as
    :meth:`Assembly.normal` takes them. Returns Float64: energies of the edges without their weight
    (E), gradient (3N) in space; by (Δu, Δv, Δw): gradient (3N), curvature (9U) of the pairs; with
    the motion, cross curvature (18N); and with the coefficients (3 of A N each); curvature of
    positions and the motion (18N).
    """
    vertex, pair = (
        dr.arange(mi.UInt32, dr.width(vertices) // 3),
        dr.arange(mi.UInt32, dr.width(tables.i)),
    )
    energy, edges = _edges(tables, vertices, lengths, numbers)

    def ends(entry):
        edge = entry // 2
        sign = dr.select(entry == 2 * edge, mi.Float64(1), -1)
        row = _numbers(edges, edge, 9)
        return [*(sign * x for x in row[:3]), *row[3:]]

    *pull, xx, xy, xz, yy, yz, zz = _add(tables.end_start, tables.end, ends, 9)
    gradient = [x + y for x, y in zip(_numbers(images.gradient, vertex, 3), pull)]
    around = packed([xx, xy, xz, yy, yz, zz], vertex)
    if triangles is not None:
        pulls, factors, by_corner = triangles

        def corner(entry):
            factor = dr.gather(mi.Float64, pulls, entry // 3)
            return [factor * x for x in _numbers(by_corner, entry, 3)]

        gradient = [
            x + y for x, y in zip(gradient, _add(tables.corner_start, tables.corner, corner, 3))
        ]

    # curvature in the positions, of each pair of neighbours: of the images by their projections
    left, right = (_projection(camera, vertices, k) for k in (tables.i, tables.j))
    space = [
        x for row in _between(left, _rows(_numbers(images.second, pair, 4), 2), right) for x in row
    ]
    same = tables.i == tables.j
    own = _numbers(around, tables.i, 6)
    other = [
        dr.gather(mi.Float64, edges, 9 * mi.UInt32(tables.edge) + 3 + k, ~same) for k in range(6)
    ]
    space = [x + dr.select(same, own[k], -other[k]) for x, k in zip(space, _SYMMETRIC)]
    if triangles is not None:

        def share(entry):
            face = entry // 9
            a = (entry - 9 * face) // 3
            factor = dr.gather(mi.Float64, factors, face)
            one, two = (
                _numbers(by_corner, 3 * face + a, 3),
                _numbers(by_corner, 3 * face + entry - 9 * face - 3 * a, 3),
            )
            return [factor * x * y for x in one for y in two]

        space = [x + y for x, y in zip(space, _add(tables.share_start, tables.share, share, 9))]

    # each vertex moves by its own (u, v), by a height, which is its own and that of all
    # coefficients there, and by the motion
    left, right = (_rows(_numbers(by_offset, k, 9), 3) for k in (tables.i, tables.j))
    local = packed([x for row in _between(left, _rows(space, 3), right) for x in row], pair)
    space = packed(space, pair)
    own = _rows(_numbers(by_offset, vertex, 9), 3)

    def places(entry):  # of the 3 x 3 of one of a vertex's pairs, row by row
        half = dr.gather(mi.UInt32, tables.half, entry)
        first, flipped = 9 * (half // 2), (half & 1) != 0
        return [
            [first + dr.select(flipped, 3 * b + a, 3 * a + b) for b in range(3)] for a in range(3)
        ]

    def motion(entry):
        m = _rows(_numbers(by_motion, dr.gather(mi.UInt32, tables.neighbour, entry), 18), 6)
        h = [[dr.gather(mi.Float64, space, k) for k in row] for row in places(entry)]
        return [sum(row[k] * m[k][c] for k in range(3)) for row in h for c in range(6)]

    every = dr.arange(mi.UInt32, dr.width(tables.neighbour))
    moved = _add(tables.neighbour_start, every, motion, 18)
    by_all = [
        sum(own[k][a] * moved[6 * k + c] for k in range(3)) for a in range(3) for c in range(6)
    ]
    along = [sum(own[k][a] * gradient[k] for k in range(3)) for a in range(3)]

    row = (
        entry // size
    )  # an argument, in memory: this kernel's size is that of what it reads elementwise
    coefficient = entry - row * size
    begin, end = (dr.gather(mi.UInt32, tables.neighbour_start, row + k) for k in (0, 1))

    def lift(k, *before):
        value = dr.gather(
            mi.Float64, basis, dr.gather(mi.UInt32, tables.neighbour, k) * size + coefficient
        )
        heights = [dr.gather(mi.Float64, local, row[2]) for row in places(k)]
        return k + 1, *(x + h * value for x, h in zip(before, heights))

    zeros = (dr.zeros(mi.Float64, dr.width(basis)) for _ in range(3))
    lifted = dr.while_loop((begin, *zeros), lambda k, *_: k < end, lift, label="coefficients")[1:]
    return (
        energy,
        packed(gradient, vertex),
        packed(along, vertex),
        local,
        packed(by_all, vertex),
        *lifted,
        packed(moved, vertex),
    )


class Assembly:
    """Normal equations of frames, of a mesh with the ``pattern``
    (:class:`polysft_mi.solvers.normal_equations.Pattern`), seen by a ``camera``
    (:class:`polysft_mi.render.pinhole.Pinhole`)."""

    def __init__(self, pattern, camera):
        self.pattern, self.tables = pattern, Tables.of(pattern)
        self._within = None
        self._camera = _flat(np.concatenate([camera.inverse.ravel(), camera.origin]))
        self._at_vertices, self._in_unknowns = frozen(at_vertices), frozen(in_unknowns)

    def images(self, table, figures, vertices, weight, mask_weight, area, stride, silhouette):
        """:class:`Images` of the triangles' sums and a silhouette. Arguments as :func:`at_vertices`
        takes them; vertices (N, 3) [m]; ``area``: of the mask [pixels of the grid], or None."""
        numbers = _flat([weight, mask_weight, area or 0, 1 / stride])
        return self._at_vertices(
            self.tables, table, figures, _flat(vertices), self._camera, numbers, silhouette
        )

    def normal(self, surface, images, lengths, stiffness, wide=None, give=np.inf, triangles=None):
        """:class:`polysft_mi.solvers.normal_equations.Normal` of the images, the edges and further
        residuals of triangles, and the edges' energy.

        ``surface``: :class:`polysft_mi.solvers.normal_equations.Surface`; ``lengths`` (E,) [m]: of
        the template's edges; ``stiffness`` [1/m^2]: weight of the squared differences to them;
        ``wide``: a :class:`polysft_mi.solvers.normal_equations.Pattern` that holds this one, where
        the relief is an unknown too (d = 3) and the local block is to have that pattern; ``give``:
        the strain from which on a stretched edge hardly pulls harder. An excess e > 0 over the
        length L costs 2 c^2 ((1 + e^2 / c^2)^1/2 - 1), c = give L (Charbonnier): cloth that hangs
        from a point is stretched there by a tenth, and by squares that would turn the whole sheet.
        What is compressed buckles; its costs are squares. ``triangles``: residuals r (F,), factors
        h (F,), and derivatives (F, 3, 3) [1/m] of r by the corners; half the sum of h r^2 is added.
        """
        pattern, count, basis = self.pattern, self.pattern.count, surface.basis
        size, d = basis.shape[1], 2 if wide is None else 3
        if triangles is not None:
            residual, factor, by_corner = triangles
            triangles = tuple(_flat(x) for x in (residual * factor, factor, by_corner))
        found = self._in_unknowns(
            self.tables, images, _flat(surface.vertices), self._camera, _flat(lengths),
            _flat([stiffness, give]), _flat(surface.by_offset), _flat(surface.by_motion),
            _flat(basis), dr.arange(mi.UInt32, basis.size), dr.opaque(mi.UInt32, size), triangles,
        )  # fmt: skip
        energy, gradient, along, local, by_motion, *lifted, moved = (np.array(x) for x in found)
        gradient, by_motion = gradient.reshape(-1, 3), by_motion.reshape(-1, 3, 6)
        local = local.reshape(-1, 3, 3)[:, :d, :d]
        if wide is None:
            blocks = pattern.whole(local)
        else:
            blocks = np.zeros((len(wide.row), 3, 3))
            blocks[self._places(wide)] = pattern.whole(local)
        glob = np.empty((size + 6, size + 6))
        glob[:size, :size] = basis.T @ lifted[2].reshape(-1, size)
        glob[:size, size:] = basis.T @ by_motion[:, 2]
        glob[size:, :size] = glob[:size, size:].T
        glob[size:, size:] = surface.by_motion.reshape(-1, 6).T @ moved.reshape(-1, 6)
        cross = np.empty((count, d, size + 6))
        for k in range(d):
            cross[:, k, :size] = lifted[k].reshape(-1, size)
        cross[:, :, size:] = by_motion[:, :d]
        right = np.concatenate(
            [basis.T @ (gradient @ surface.up), np.einsum("nk,nkm->m", gradient, surface.by_motion)]
        )
        normal = Normal(
            blocks,
            cross.reshape(-1, size + 6),
            glob,
            np.ascontiguousarray(along.reshape(-1, 3)[:, :d]),
            right,
        )
        return normal, stiffness * float(energy.sum())

    def _places(self, wide):
        """Where the blocks of the pattern are among those of one that holds it."""
        if self._within is None or self._within[0] is not wide:
            self._within = wide, wide.find(self.pattern.row, self.pattern.column)
        return self._within[1]


def _flat(array):
    return on_device(array, mi.Float64)
