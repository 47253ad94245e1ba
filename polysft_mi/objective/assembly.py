"""Normal equations of a frame in the unknowns of a jet patch, accumulated on the device.

In: what the images say at the vertices (:mod:`polysft_mi.images.gather`), the lengths of the edges,
and further residuals of the triangles. Out: :class:`Normal`, for the linear algebra of
:mod:`polysft_mi.solvers.linear`. Kernels are recorded once and launched again without tracing.
Import only after a Mitsuba variant is set.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.images.gather import (
    add,
    congruence,
    flat,
    flattened,
    numbers_of,
    projection,
    rows_of,
)
from polysft_mi.images.pixels import packed
from polysft_mi.render.device import frozen


@dataclass
class Normal:
    """Normal equations of a frame: ``local`` (B, d, d), ``cross`` (dN, G), ``glob`` (G, G) and the
    gradient ``local_gradient`` (N, d), ``gradient`` (G,).
    """

    local: np.ndarray
    cross: np.ndarray
    glob: np.ndarray
    local_gradient: np.ndarray
    gradient: np.ndarray


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
    offset_jacobian,
    motion_jacobian,
    basis,
    entry,
    size,
    triangles,
):
    """Normal equations of the images, the edges and the triangles' residuals, in the unknowns of a
    jet patch.

    ``vertices`` Float64 of 3N [m]; ``lengths`` Float64 of E [m], ``numbers`` Float64: stiffness
    [1/m^2], give; ``offset_jacobian`` Float64 of 9N, ``motion_jacobian`` of 18N, ``basis`` of A N:
    of :class:`polysft_mi.surface.chart.Surface`; ``entry``: 0, 1, ... of A N, and ``size``: A,
    UInt32; ``triangles``: None, or Float64: r h of F, h of F and derivatives of 9F, as
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
        row = numbers_of(edges, edge, 9)
        return [*(sign * x for x in row[:3]), *row[3:]]

    *pull, xx, xy, xz, yy, yz, zz = add(tables.end_start, tables.end, ends, 9)
    gradient = [x + y for x, y in zip(numbers_of(images.gradient, vertex, 3), pull)]
    around = packed([xx, xy, xz, yy, yz, zz], vertex)
    if triangles is not None:
        pulls, factors, by_corner = triangles

        def corner(entry):
            factor = dr.gather(mi.Float64, pulls, entry // 3)
            return [factor * x for x in numbers_of(by_corner, entry, 3)]

        gradient = [
            x + y for x, y in zip(gradient, add(tables.corner_start, tables.corner, corner, 3))
        ]

    # curvature in the positions, of each pair of neighbours: of the images by their projections
    left, right = (projection(camera, vertices, k) for k in (tables.i, tables.j))
    space = flattened(congruence(left, rows_of(numbers_of(images.second, pair, 4), 2), right))
    same = tables.i == tables.j
    own = numbers_of(around, tables.i, 6)
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
                numbers_of(by_corner, 3 * face + a, 3),
                numbers_of(by_corner, 3 * face + entry - 9 * face - 3 * a, 3),
            )
            return [factor * x * y for x in one for y in two]

        space = [x + y for x, y in zip(space, add(tables.share_start, tables.share, share, 9))]

    # each vertex moves by its own (u, v), by a height, which is its own and that of all
    # coefficients there, and by the motion
    left, right = (rows_of(numbers_of(offset_jacobian, k, 9), 3) for k in (tables.i, tables.j))
    local = packed(flattened(congruence(left, rows_of(space, 3), right)), pair)
    space = packed(space, pair)
    own = rows_of(numbers_of(offset_jacobian, vertex, 9), 3)

    def places(entry):  # of the 3 x 3 of one of a vertex's pairs, row by row
        half = dr.gather(mi.UInt32, tables.half, entry)
        first, flipped = 9 * (half // 2), (half & 1) != 0
        return [
            [first + dr.select(flipped, 3 * b + a, 3 * a + b) for b in range(3)] for a in range(3)
        ]

    def motion(entry):
        m = rows_of(
            numbers_of(motion_jacobian, dr.gather(mi.UInt32, tables.neighbour, entry), 18), 6
        )
        h = [[dr.gather(mi.Float64, space, k) for k in row] for row in places(entry)]
        return [sum(row[k] * m[k][c] for k in range(3)) for row in h for c in range(6)]

    every = dr.arange(mi.UInt32, dr.width(tables.neighbour))
    moved = add(tables.neighbour_start, every, motion, 18)
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
    """Normal equations of frames, from what ``gather`` (:class:`polysft_mi.images.gather.Gather`)
    brings to the vertices of a mesh with the ``pattern``
    (:class:`polysft_mi.surface.pattern.Pattern`).
    """

    def __init__(self, pattern, gather):
        self.pattern, self._gather, self._within = pattern, gather, None
        self._in_unknowns = frozen(in_unknowns)

    def normal(self, surface, images, lengths, stiffness, wide=None, give=np.inf, triangles=None):
        """:class:`Normal` of the images, the edges and further
        residuals of triangles, and the edges' energy.

        ``surface``: :class:`polysft_mi.surface.chart.Surface`; ``lengths`` (E,) [m]: of the
        template's edges; ``stiffness`` [1/m^2]: weight of the squared differences to them;
        ``wide``: a :class:`polysft_mi.surface.pattern.Pattern` that holds this one, where the
        relief is an unknown too (d = 3) and the local block is to have that pattern; ``give``: the
        strain from which on a stretched edge hardly pulls harder. An excess e > 0 over the length L
        costs 2 c^2 ((1 + e^2 / c^2)^1/2 - 1), c = give L (Charbonnier): cloth that hangs from a
        point is stretched there by a tenth, and by squares that would turn the whole sheet. What is
        compressed buckles; its costs are squares. ``triangles``: residuals r (F,), factors h (F,),
        and derivatives (F, 3, 3) [1/m] of r by the corners; half the sum of h r^2 is added.
        """
        pattern, count, basis = self.pattern, self.pattern.count, surface.basis
        size, d = basis.shape[1], 2 if wide is None else 3
        if triangles is not None:
            residual, factor, by_corner = triangles
            triangles = tuple(flat(x) for x in (residual * factor, factor, by_corner))
        found = self._in_unknowns(
            self._gather.tables,
            images,
            flat(surface.vertices),
            self._gather.camera,
            flat(lengths),
            flat([stiffness, give]),
            flat(surface.offset_jacobian),
            flat(surface.motion_jacobian),
            flat(basis),
            dr.arange(mi.UInt32, basis.size),
            dr.opaque(mi.UInt32, size),
            triangles,
        )
        energy, gradient, along, local, by_motion, *lifted, moved = (np.array(x) for x in found)
        gradient, by_motion = gradient.reshape(-1, 3), by_motion.reshape(-1, 3, 6)
        local = local.reshape(-1, 3, 3)[:, :d, :d]
        if wide is None:
            blocks = pattern.all_blocks(local)
        else:
            blocks = np.zeros((len(wide.row), 3, 3))
            blocks[self._places(wide)] = pattern.all_blocks(local)
        glob = np.empty((size + 6, size + 6))
        glob[:size, :size] = basis.T @ lifted[2].reshape(-1, size)
        glob[:size, size:] = basis.T @ by_motion[:, 2]
        glob[size:, :size] = glob[:size, size:].T
        glob[size:, size:] = surface.motion_jacobian.reshape(-1, 6).T @ moved.reshape(-1, 6)
        cross = np.empty((count, d, size + 6))
        for k in range(d):
            cross[:, k, :size] = lifted[k].reshape(-1, size)
        cross[:, :, size:] = by_motion[:, :d]
        right = np.concatenate(
            [
                basis.T @ (gradient @ surface.up),
                np.einsum("nk,nkm->m", gradient, surface.motion_jacobian),
            ]
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
