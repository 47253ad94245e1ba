"""The quadratic model of an objective around a state: normal equations in the unknowns of an atlas,
accumulated on the device.

In: what the images say at the vertices (:mod:`polysft_mi.images.gather`), residuals of the edges'
lengths, quadratic models of the triangles. Out: :class:`NormalEquations`, for the linear algebra of
:mod:`polysft_mi.solvers.linear`. Kernels are recorded once and launched again without tracing.
Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse as sp

from polyfit.device import on_device
from polysft_mi.images import packed
from polysft_mi.images.gather import (
    add,
    congruence,
    flat,
    flattened,
    numbers_of,
    projection,
    rows_of,
)
from polysft_mi.render import frozen

if TYPE_CHECKING:
    from polysft_mi.images import Appearance, Evaluation, Images
    from polysft_mi.surface import State, Surface

    from .context import FrameContext, Stage


@dataclass
class NormalEquations:
    """Curvature and gradient by the unknowns of a frame, whose local ones are d of each vertex and
    whose G global ones are the jets' and the motions', patch by patch: ``local`` (B, d, d), the
    blocks of a pattern, ``cross`` (dN, G), ``glob`` (G, G), ``local_gradient`` (N, d),
    ``gradient`` (G,).
    """

    local: np.ndarray
    cross: np.ndarray
    glob: np.ndarray
    local_gradient: np.ndarray
    gradient: np.ndarray


@dataclass
class EdgeRows:
    """Residuals of the edges: squared differences to ``lengths`` (E,) [m], times ``stiffness``
    [1/m^2]. From the strain ``give`` on, a stretched edge hardly pulls harder: an excess e > 0 over
    the length L costs 2 c^2 ((1 + e^2 / c^2)^1/2 - 1), c = give L (Charbonnier). A compressed
    edge costs the same, with ``shrink`` for ``give``.
    """

    lengths: np.ndarray
    stiffness: float = 0.0
    give: float = math.inf
    shrink: float = math.inf


@dataclass
class TriangleForms:
    """Quadratic models of the triangles in the positions of their corners: ``gradient`` (F, 3, 3)
    [1/m], corner by axis, and ``curvature`` (F, 3, 3, 3, 3) [1/m^2], corner by corner by axis by
    axis.
    """

    gradient: np.ndarray
    curvature: np.ndarray

    @classmethod
    def of_residuals(
        cls, residual: np.ndarray, factor: np.ndarray, by_corner: np.ndarray
    ) -> TriangleForms:
        """Of half the sum of ``factor`` (F,) times ``residual`` (F,) squared, whose derivatives by
        the corners are ``by_corner`` (F, 3, 3) [1/m].
        """
        pull = factor[:, None, None] * by_corner
        curvature = np.einsum("fak,fbm->fabkm", pull, by_corner)
        return cls(residual[:, None, None] * pull, curvature)

    def __add__(self, other: TriangleForms | None) -> TriangleForms:
        if other is None:
            return self
        return TriangleForms(self.gradient + other.gradient, self.curvature + other.curvature)


@dataclass
class Linearisation:
    """Where terms add what they know to second order, at a ``state`` whose vertices are of
    ``surface``.

    First in space, where one kernel sums it up: ``evaluation`` holds what the images say,
    ``images`` is that, and terms add what other cameras' say, each with its camera as
    :class:`polysft_mi.images.gather.Gather` has it; they set ``edges`` and ``at_rest``, and add to
    ``triangles``.
    Then in the unknowns: ``normal``, in whose local
    blocks ``diagonal`` (N,) are those of the vertices; ``edge_energy`` is that of the edges,
    ``energies`` those of the terms that act on triangles or images. ``d``: local unknowns of a
    vertex (3 with
    its relief, or 2).
    """

    state: State
    surface: Surface
    context: FrameContext
    stage: Stage
    d: int
    diagonal: np.ndarray
    evaluation: Evaluation
    edges: EdgeRows
    appearance: Appearance | None = None
    images: list = field(default_factory=list)
    triangles: TriangleForms | None = None
    at_rest: RestForms | None = None
    edge_energy: float = 0.0
    energies: dict[str, float] = field(default_factory=dict)
    normal: NormalEquations = field(init=False)

    def add_to_images(self, name: str, energy: float, images: Images) -> None:
        """Add what the term ``name``, whose energy is ``energy``, says in the scene's camera."""
        self.energies[name] = energy
        (first, camera), *others = self.images
        self.images = [(first + images, camera), *others]

    def add_to_triangles(self, name: str, energy: float, forms: TriangleForms) -> None:
        """Add the quadratic models of the term ``name``, whose energy is ``energy``."""
        self.energies[name] = energy
        self.triangles = forms + self.triangles


@dataclass
class QuadraticModel:
    """An objective around a ``state`` whose vertices are of ``surface``.

    ``terms``: name to energy; ``total``: their sum; ``measure``: the sum of those that are not
    mostly noise, what a gain is a share of; ``evaluation``: of the images; ``normal``: the
    equations of a step; ``appearance``: the sheet's that was used.
    """

    state: State
    surface: Surface
    evaluation: Evaluation
    normal: NormalEquations
    terms: dict[str, float]
    total: float
    measure: float
    appearance: Appearance | None = None


@dataclass
class RestForms:
    """Quadratic models in the positions of N vertices before a body carries them: ``gradient`` (N,
    3) [1/m], and the curvature ``weight`` (N,) [1/m^2], the same along all axes.
    """

    gradient: np.ndarray
    weight: np.ndarray


def _edges(tables, vertices, lengths, numbers):
    """What lengths cost: energy of each edge without its weight, and packed, a row an edge: the
    pull on its first end (3), and the curvature, 6 of a symmetric 3 x 3, of either end."""
    stiffness, give, shrink = (dr.gather(mi.Float64, numbers, k) for k in range(3))
    a, b = (dr.gather(mi.Vector3d, vertices, k) for k in (tables.a, tables.b))
    edge = a - b
    length = dr.maximum(dr.norm(edge), 1e-9)
    direction, excess = edge / length, length - lengths
    over = dr.square(excess / (dr.select(excess > 0, give, shrink) * lengths))
    heavy = 2 * stiffness / dr.sqrt(1 + over)
    x, y, z = direction
    columns = [heavy * excess * d for d in direction] + [
        heavy * d for d in (x * x, x * y, x * z, y * y, y * z, z * z)
    ]
    return dr.square(excess) * 2 / (1 + dr.sqrt(1 + over)), packed(
        columns, dr.arange(mi.UInt32, dr.width(tables.a))
    )


_SYMMETRIC = (0, 1, 2, 1, 3, 4, 2, 4, 5)  # a symmetric 3 x 3, row by row, from its upper half


@dataclass
class Halo:
    """Which vertices an atlas' patches reach, on the device, UInt32: a vertex belongs to the halo
    of a patch where it, or a neighbour, is held by the patch. H pairs of patch and vertex, patch by
    patch.

    ``start`` (H + 1): of each pair's list of the neighbours that the patch holds; of the L in all
    lists, ``block``: which of the mesh's blocks, 2 p or 2 p + 1 as
    :class:`polysft_mi.images.gather.Tables` has them, ``entry``: the neighbour's
    in :class:`polysft_mi.surface.atlas.Atlas`, ``patch``.
    """

    start: mi.UInt32
    block: mi.UInt32
    entry: mi.UInt32
    patch: mi.UInt32


def _vertex_sums_in_unknowns(
    tables,
    halo,
    images,
    vertices,
    lengths,
    numbers,
    offset_jacobian,
    up,
    motion_jacobian,
    basis,
    index,
    size,
    triangles,
    carried,
):
    """Normal equations of the images, the edges and the triangles, in the unknowns of an atlas.

    ``halo``: :class:`Halo`; ``images``: pairs of :class:`polysft_mi.images.gather.Images` and their
    camera; ``vertices`` Float64 of 3N [m]; ``lengths`` Float64 of E [m], ``numbers`` Float64:
    stiffness [1/m^2], give, shrink; ``offset_jacobian`` Float64 of 9N, ``up`` of 3K,
    ``motion_jacobian`` of 18 and ``basis`` of A an entry: of
    :class:`polysft_mi.surface.atlas.Surface`; ``index``: 0, 1, ... of A H, and ``size``: A,
    UInt32; ``triangles``: Float64 of 9F and 81F, of :class:`TriangleForms`, or None; ``carried``:
    of a surface that a body carries Float64 of 9N, its ``linear``, and of 3N and N, of
    :class:`RestForms`, or None. Returns
    Float64: energies of the edges without their weight (E), gradient (3N) in space; by (Δu, Δv,
    Δw): gradient (3N), curvature (9U) of the pairs; of positions at rest and, over the halo, the
    motions (18H) and the coefficients (3 of A H each); and the curvature (9U) of the pairs in
    space, None where the surface is not carried.
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
    gradient = pull
    for image, _ in images:
        gradient = [x + y for x, y in zip(numbers_of(image.gradient, vertex, 3), gradient)]
    around = packed([xx, xy, xz, yy, yz, zz], vertex)
    if triangles is not None:
        of_corners = add(
            tables.corner_start, tables.corner, lambda entry: numbers_of(triangles[0], entry, 3), 3
        )
        gradient = [x + y for x, y in zip(gradient, of_corners)]

    # curvature in the positions, of each pair of neighbours: of the images by their projections
    space = None
    for image, camera in images:
        left, right = (projection(camera, vertices, k) for k in (tables.i, tables.j))
        second = congruence(left, rows_of(numbers_of(image.second, pair, 4), 2), right)
        added = flattened(second)
        space = added if space is None else [x + y for x, y in zip(space, added)]
    same = tables.i == tables.j
    own = numbers_of(around, tables.i, 6)
    other = [
        dr.gather(mi.Float64, edges, 9 * mi.UInt32(tables.edge) + 3 + k, ~same) for k in range(6)
    ]
    space = [x + dr.select(same, own[k], -other[k]) for x, k in zip(space, _SYMMETRIC)]
    if triangles is not None:
        of_pairs = add(
            tables.share_start, tables.share, lambda entry: numbers_of(triangles[1], entry, 9), 9
        )
        space = [x + y for x, y in zip(space, of_pairs)]

    # a body carries each vertex from where it is at rest
    at_rest, in_world = gradient, None
    if carried is not None:
        linear, pulls, weights = carried
        in_world = packed(space, pair)
        left, right = (rows_of(numbers_of(linear, k, 9), 3) for k in (tables.i, tables.j))
        space = flattened(congruence(left, rows_of(space, 3), right))
        own = rows_of(numbers_of(linear, vertex, 9), 3)
        pull, weight = numbers_of(pulls, vertex, 3), dr.gather(mi.Float64, weights, tables.i, same)
        at_rest = [sum(own[k][a] * gradient[k] for k in range(3)) + pull[a] for a in range(3)]
        space = [x + weight if k in (0, 4, 8) else x for k, x in enumerate(space)]

    # each vertex moves by its own (u, v) and height, and by the jets and the motions that hold it
    left, right = (rows_of(numbers_of(offset_jacobian, k, 9), 3) for k in (tables.i, tables.j))
    local = packed(flattened(congruence(left, rows_of(space, 3), right)), pair)
    space = packed(space, pair)
    own = rows_of(numbers_of(offset_jacobian, vertex, 9), 3)
    along = [sum(own[k][a] * at_rest[k] for k in range(3)) for a in range(3)]

    def in_space(block):
        """The 3 x 3 of a neighbour in a halo, its rows."""
        flipped, first = (block & 1) != 0, 9 * (block // 2)
        at = lambda a, b: first + dr.select(flipped, 3 * b + a, 3 * a + b)
        return [[dr.gather(mi.Float64, space, at(a, b)) for b in range(3)] for a in range(3)]

    h = in_space(halo.block)  # times its patch's up
    direction = numbers_of(up, halo.patch, 3)
    raised = packed(
        [sum(row[k] * direction[k] for k in range(3)) for row in h],
        dr.arange(mi.UInt32, dr.width(halo.block)),
    )

    def motion(k):
        h = in_space(dr.gather(mi.UInt32, halo.block, k))
        m = rows_of(numbers_of(motion_jacobian, dr.gather(mi.UInt32, halo.entry, k), 18), 6)
        return [sum(row[k] * m[k][c] for k in range(3)) for row in h for c in range(6)]

    every = dr.arange(mi.UInt32, dr.width(halo.block))
    moved = add(halo.start, every, motion, 18)

    row = index // size  # an argument, in memory: this kernel's size is that of what it reads
    coefficient = index - row * size
    begin, end = (dr.gather(mi.UInt32, halo.start, row + k) for k in (0, 1))

    def lift(k, *before):
        at = dr.gather(mi.UInt32, halo.entry, k) * size + coefficient
        value = dr.gather(mi.Float64, basis, at)
        return k + 1, *(x + h * value for x, h in zip(before, numbers_of(raised, k, 3)))

    zeros = (dr.zeros(mi.Float64, dr.width(index)) for _ in range(3))
    lifted = dr.while_loop((begin, *zeros), lambda k, *_: k < end, lift, label="coefficients")[1:]
    return (
        energy,
        packed(gradient, vertex),
        packed(along, vertex),
        local,
        packed(moved, dr.arange(mi.UInt32, dr.width(halo.start) - 1)),
        *lifted,
        in_world,
    )


class Assembly:
    """Normal equations of frames, from what ``gather`` (:class:`polysft_mi.images.gather.Gather`)
    brings to the vertices of a mesh with the ``pattern``
    (:class:`polysft_mi.surface.pattern.Pattern`), in the unknowns of an ``atlas``
    (:class:`polysft_mi.surface.atlas.Atlas`).
    """

    def __init__(self, pattern, gather, atlas):
        self.pattern, self._tables, self._atlas = pattern, gather.tables, atlas
        self._in_unknowns = frozen(_vertex_sums_in_unknowns)
        self._list_halo()

    def _list_halo(self):
        pattern, atlas = self.pattern, self._atlas
        entries = sp.csr_matrix(
            (np.arange(len(atlas.entry_vertex)) + 1, (atlas.entry_vertex, atlas.entry_patch)),
            (pattern.count, len(atlas)),
        )
        # of each block (i, j), the patches that hold j
        held = entries[pattern.column].tocoo()
        order = np.lexsort((pattern.row[held.row], held.col))
        block, patch, entry = held.row[order], held.col[order], held.data[order] - 1
        key = patch * pattern.count + pattern.row[block]
        pairs, first = np.unique(key, return_index=True)
        halo_patch, vertex = np.divmod(pairs, pattern.count)
        ends = np.searchsorted(halo_patch, np.arange(len(atlas) + 1))
        #: the vertices of each patch's halo, and its rows
        self._reached = [(vertex[a:b], slice(a, b)) for a, b in itertools.pairwise(ends)]
        arrays = np.append(first, len(key)), pattern.half[block], entry, patch
        self._halo = Halo(*(on_device(x, mi.UInt32) for x in arrays))
        self._index = len(pairs)
        # of the patches that meet: the entries of one that the other's halo has, and where
        self._meetings = []
        for k, (reached, rows) in enumerate(self._reached):
            place = np.full(pattern.count, -1)
            place[reached] = np.arange(rows.start, rows.stop)
            for other, part in enumerate(atlas.entries):
                at = place[atlas.entry_vertex[part]]
                kept = np.flatnonzero(at >= 0)
                if len(kept):
                    self._meetings.append((other, k, part.start + kept, at[kept]))

    def normal(self, surface, images, edges, triangles=None, wide=None, d=2, at_rest=None):
        """(:class:`NormalEquations`, the edges' energy) of what ``images`` (pairs of
        :class:`polysft_mi.images.gather.Images` and their camera), :class:`EdgeRows` and
        :class:`TriangleForms` say at the vertices of a ``surface``, and :class:`RestForms` before a
        body carries them.

        ``d``: local unknowns of a vertex; ``wide``: a pattern that holds this one, which the local
        block is to have.
        """
        pattern, count, basis = self.pattern, self.pattern.count, surface.basis
        size, patches = basis.shape[1], len(surface.up)
        forms = triangles and (flat(triangles.gradient), flat(triangles.curvature))
        of_edges = flat(edges.lengths), flat([edges.stiffness, edges.give, edges.shrink])
        pull, weight = np.zeros((count, 3)), np.zeros(count)
        if at_rest is not None:
            pull, weight = at_rest.gradient, at_rest.weight
        derivatives = surface.offset_jacobian, surface.up, surface.motion_jacobian, basis
        found = self._in_unknowns(
            *(self._tables, self._halo, images),
            *(flat(surface.vertices), *of_edges, *map(flat, derivatives)),
            *(dr.arange(mi.UInt32, size * self._index), dr.opaque(mi.UInt32, size), forms),
            None if surface.linear is None else tuple(map(flat, (surface.linear, pull, weight))),
        )
        *found, in_world = found
        energy, gradient, along, local, moved, *lifted = (np.array(x) for x in found)
        gradient, moved = gradient.reshape(-1, 3), moved.reshape(-1, 3, 6)
        lifted = [x.reshape(-1, size) for x in lifted]
        local = local.reshape(-1, 3, 3)[:, :d, :d]
        blocks = pattern.all_blocks(local)
        if wide is not None and wide is not pattern:
            inner, blocks = blocks, np.zeros((len(wide.row), d, d))
            blocks[wide.find(pattern.row, pattern.column)] = inner
        cross = np.zeros((count, d, patches, size + 6))
        for k, (reached, rows) in enumerate(self._reached):
            own = surface.offset_jacobian[reached][:, :, :d]
            for a in range(d):
                cross[reached, a, k, :size] = sum(
                    own[:, c, a, None] * lifted[c][rows] for c in range(3)
                )
            cross[reached, :, k, size:] = np.einsum("hca,hcm->ham", own, moved[rows])
        normal = NormalEquations(
            blocks,
            cross.reshape(count * d, -1),
            self._glob(surface, lifted, moved),
            np.ascontiguousarray(along.reshape(-1, 3)[:, :d]),
            self._atlas.to_globals(surface, gradient, None if at_rest is None else pull),
        )
        if surface.by_pose is not None:
            self._add_pose(normal, surface, np.array(in_world).reshape(-1, 3, 3), d)
        return normal, edges.stiffness * float(energy.sum())

    def _add_pose(self, normal, surface, pairs, d):
        """Add the curvatures by the body's pose, from those of the ``pairs`` (U, 3, 3) in space."""
        pattern, columns = self.pattern, surface.by_pose
        i, j = pattern.row[pattern.upper], pattern.column[pattern.upper]
        count, size = len(columns), columns.shape[2]
        upper = sp.bsr_matrix(
            (pairs, j, np.searchsorted(i, np.arange(count + 1))), (3 * count, 3 * count)
        )
        diagonal = np.zeros_like(pairs)
        diagonal[i == j] = pairs[i == j]
        own = sp.bsr_matrix((diagonal, j, upper.indptr), upper.shape)
        flat_columns = columns.reshape(3 * count, size)
        pulled = upper @ flat_columns + upper.T @ flat_columns - own @ flat_columns
        pulled = pulled.reshape(count, 3, size)
        at_rest = surface.linear.transpose(0, 2, 1) @ pulled
        cross = surface.offset_jacobian[:, :, :d].transpose(0, 2, 1) @ at_rest
        by_jets = []
        for k, part in enumerate(self._atlas.entries):
            of_patch = at_rest[self._atlas.entry_vertex[part]]
            by_jets.append(surface.basis[part].T @ (surface.up[k] @ of_patch))
            moving = surface.motion_jacobian[part].reshape(-1, 6)
            by_jets.append(moving.T @ of_patch.reshape(len(moving), size))
        by_jets = np.concatenate(by_jets)
        own = flat_columns.T @ pulled.reshape(3 * count, size)
        normal.cross = np.concatenate([normal.cross, cross.reshape(count * d, size)], 1)
        normal.glob = np.block([[normal.glob, by_jets], [by_jets.T, own]])

    def _glob(self, surface, lifted, moved):
        """The curvature (G, G) by the jets and the motions."""
        size, patches = surface.basis.shape[1], len(surface.up)
        glob = np.zeros((patches, size + 6, patches, size + 6))
        for one, other, entries, rows in self._meetings:
            basis, up = surface.basis[entries], surface.up[one]
            moving = surface.motion_jacobian[entries]
            raised = sum(up[c] * lifted[c][rows] for c in range(3))
            glob[one, :size, other, :size] = basis.T @ raised
            glob[one, :size, other, size:] = basis.T @ (up @ moved[rows])
            glob[one, size:, other, size:] = moving.reshape(-1, 6).T @ moved[rows].reshape(-1, 6)
        for one in range(patches):
            for other in range(patches):
                glob[other, size:, one, :size] = glob[one, :size, other, size:].T
        return glob.reshape(patches * (size + 6), -1)
