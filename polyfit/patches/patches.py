"""Patches: a mesh cut into connected clusters by ACVD (Valette & Chassery 2004; paper, section
"PolyFit" and supplement).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from polyfit import mesh
from polyfit.errors import InputError, as_number

from .clusters import clusters, plain, split_in_two

# Vertices that a mesh should have before it is cut: enough for the patches' outlines and jets
_VERTICES_PER_PATCH = 100
_MIN_VERTICES = 10_000  # of the whole mesh


def patch_count(area: float) -> int:
    """The paper's number of patches K for a surface of ``area`` [m^2]: max(100, min(400, floor(area
    / 0.008))).
    """
    return max(100, min(400, int(area / 0.008)))


@dataclass(frozen=True)
class Patches:
    """A mesh and its cut.

    The cut is made on the mesh after ``levels`` subdivisions, ``vertices`` (M, 3) float64 [m] and
    ``faces`` (G, 3); the first N vertices are those given, the ``given`` faces (F, 3) become the
    rows 4^levels f onwards. ``sheets`` (G, 3) are the same faces on vertices that are split where
    the surface is no manifold (:func:`polyfit.mesh.sheets`), S of them, and ``label`` (S,) is the
    patch of each. ``side`` (G,) is -1 where a face is wound against most of its part, else 1.

    A patch's *chart* holds all vertices of the faces that touch the patch, so that the charts of
    neighbours overlap by one row of faces. One vertex in one chart is an *entry*: ``entry_patch``
    (E,), rising, and ``entry_vertex`` (E,). ``face_entries`` (G, 3, 3): entry [g, j, i] is that of
    vertex i of face g in the chart of the patch of its corner j.
    """

    vertices: np.ndarray
    faces: np.ndarray
    given: np.ndarray
    levels: int
    sheets: np.ndarray
    label: np.ndarray
    side: np.ndarray
    entry_patch: np.ndarray
    entry_vertex: np.ndarray
    face_entries: np.ndarray

    def __len__(self) -> int:
        """K, the number of patches."""
        return int(self.entry_patch[-1]) + 1

    @classmethod
    def cut(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        count: int | None = None,
        *,
        density: int = _VERTICES_PER_PATCH,
        levels: int | None = None,
        acvd: bool = False,
        where: str = "mesh",
    ) -> "Patches":
        """Cut the mesh (N, 3) [m], (F, 3) into ``count`` connected patches; by default
        :func:`patch_count` of them.

        The mesh is subdivided until it has about ``density`` vertices a patch, and 10,000; or
        ``levels`` times. ``acvd``: by plain ACVD, of positions alone, as in the paper. Separate
        components, and sheets that meet in an edge of three or more faces, share no patch: each has
        at least one, and the default count is raised where that needs more. Raises InputError for a
        mesh that :func:`polyfit.mesh.checked` refuses, and for a count that its components or its
        vertices do not allow. Vertices in no face are left out.
        """
        V, given = mesh.checked(vertices, faces, where, drop_loose=True)
        split = mesh.sheets(given)
        side = mesh.winding(split)
        part = _components_of_faces(split)
        parts = int(part.max()) + 1
        area = mesh.areas(V, given)
        if count is None:
            count = max(parts, min(len(V), patch_count(area.sum())))
        if as_number(count) % 1:
            raise InputError(f"{where}: {count} patches; a whole number is needed")
        count = int(count)
        if not 1 <= count <= len(V):
            raise InputError(
                f"{where}: {count} patches; 1 to {len(V)}, the number of its vertices, are possible"
            )
        if count < parts:
            raise InputError(
                f"{where}: {count} patches, but it has {parts} separate parts, and each needs one"
            )
        if levels is None:
            levels = _levels(len(V), area, count, density)
        F = given
        for _ in range(levels):
            F, edges = mesh.subdivided(F)
            V = np.concatenate([V, V[edges].mean(axis=1)])
            split = mesh.subdivided(split)[0]
        part, side = np.repeat(part, 4**levels), np.repeat(side, 4**levels)
        label = _cluster(V, F, split, part, side, count, acvd)
        return cls(V, F, given, levels, split, label, side, *_entries(len(V), F, label[split]))

    def relabelled(self, label: np.ndarray) -> "Patches":
        """The same mesh cut otherwise: ``label`` (S,), each of 0 .. K - 1 used and connected."""
        entries = _entries(len(self.vertices), self.faces, label[self.sheets])
        return Patches(
            self.vertices,
            self.faces,
            self.given,
            self.levels,
            self.sheets,
            label,
            self.side,
            *entries,
        )

    @cached_property
    def corner_patch(self) -> np.ndarray:
        """The patch of each corner of each face, (G, 3)."""
        return self.label[self.sheets]

    @cached_property
    def vertex_entry(self) -> np.ndarray:
        """The entry of each vertex in its own patch, (M,). Where sheets meet, the first of them has
        the vertex.
        """
        out = np.full(len(self.vertices), -1)
        j = np.arange(3)
        out[self.faces[::-1].ravel()] = self.face_entries[::-1, j, j].ravel()
        return out

    @property
    def vertex_patch(self) -> np.ndarray:
        """The patch of each vertex, (M,)."""
        return self.entry_patch[self.vertex_entry]

    @cached_property
    def on_boundary(self) -> np.ndarray:
        """Which faces touch several patches, (G,) bool."""
        return (self.corner_patch != self.corner_patch[:, :1]).any(axis=1)

    @cached_property
    def entry_weight(self) -> np.ndarray:
        """The area around each entry that its patch has a share in, (E,) [m^2]; all together they
        are the surface's area.

        A face that touches several patches is shared by them in proportion to their corners.
        """
        share = np.repeat(mesh.areas(self.vertices, self.faces) / 9, 9)
        return np.bincount(self.face_entries.ravel(), share, minlength=len(self.entry_patch))

    @cached_property
    def direction(self) -> np.ndarray:
        """Mean normals of the patches by the winding of most faces, as long as the area they speak
        for, (K, 3) [m^2].
        """
        n = np.repeat(
            self.side[:, None] * mesh.face_vectors(self.vertices, self.faces) / 6, 3, axis=0
        )
        return np.stack(
            [
                np.bincount(self.corner_patch.ravel(), n[:, k], minlength=len(self))
                for k in range(3)
            ],
            axis=1,
        )

    @cached_property
    def boundary(self) -> np.ndarray:
        """Pairs of entries (B, 2) that are the same point of the surface in the charts of two
        patches, the lower patch first.
        """
        order = np.argsort(
            self.entry_vertex, kind="stable"
        )  # entries of one vertex, patches rising
        vertex, pairs, step = self.entry_vertex[order], [], 1
        while True:
            same = vertex[step:] == vertex[:-step]
            if not same.any():
                break
            pairs.append(np.stack([order[:-step][same], order[step:][same]], axis=1))
            step += 1
        return np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int64)

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Pairs of patches (N, 2) that meet, each once, the lower first."""
        return np.unique(self.entry_patch[self.boundary], axis=0)

    @cached_property
    def padded(self) -> tuple[np.ndarray, np.ndarray]:
        """The entries of each patch, (K, P), padded with the patch's first entry, and which of them
        exist, (K, P) bool.
        """
        counts = np.bincount(self.entry_patch)
        first = np.cumsum(counts) - counts
        column = np.arange(counts.max())
        exists = column < counts[:, None]
        return np.where(exists, first[:, None] + column, first[:, None]), exists

    def locate(self, face: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points on the given mesh, by face (P,) and barycentric coordinates (P, 3), as points on
        ``faces``. Raises InputError for a face that is not there, and for other shapes.
        """
        if barycentric.shape != (*face.shape, 3):
            raise InputError(
                f"faces {face.shape}, barycentric {barycentric.shape}; (P,) and (P, 3) are needed"
            )
        numbers = all(x.dtype.kind in "iuf" for x in (face, barycentric))
        if not numbers or (face % 1 != 0).any():
            raise InputError("faces: whole numbers, which name those of the mesh, are needed")
        if not np.allclose(barycentric.sum(-1), 1, rtol=0, atol=1e-3):
            raise InputError("barycentric: rows of finite numbers that sum to 1 are needed")
        if len(face) and not 0 <= face.min() <= face.max() < len(self.given):
            raise InputError(
                f"faces {face.min()} to {face.max()}; 0 to {len(self.given) - 1} exist"
            )
        return mesh.child(face, barycentric, self.levels)


def _components_of_faces(F: np.ndarray) -> np.ndarray:
    """Number of the connected component of each face, (F,)."""
    edges, _ = mesh.edges_of(F)
    return mesh.components(int(F.max()) + 1, edges)[F[:, 0]]


def _levels(vertices: int, area: np.ndarray, count: int, density: int) -> int:
    """Subdivisions until there are vertices enough, and no face is larger than a tenth of a patch
    (or until there are some million faces)."""
    few = np.log(max(density * count, _MIN_VERTICES) / vertices) / np.log(4)
    large = np.log(10 * count * area.max() / area.sum()) / np.log(4)
    most = np.log(4e6 / len(area)) / np.log(4)
    return max(0, min(int(np.ceil(max(few, large))), int(most)))


def _cluster(
    V: np.ndarray,
    F: np.ndarray,
    split: np.ndarray,
    part: np.ndarray,
    side: np.ndarray,
    count: int,
    acvd: bool,
) -> np.ndarray:
    """The patch of each vertex of ``split`` (G, 3): clusters of each part of the surface, ``part``
    (G,), as many as its share of the area."""
    size = int(split.max()) + 1
    points, of_vertex = np.empty((size, 3)), np.empty(size, dtype=np.int64)
    points[split], of_vertex[split] = V[F], part[:, None]
    vectors = side[:, None] * mesh.face_vectors(points, split)
    normals = np.stack(
        [np.bincount(split.ravel(), np.repeat(x, 3), minlength=size) for x in vectors.T], axis=1
    )
    area = np.bincount(split.ravel(), np.repeat(mesh.areas(points, split) / 3, 3), minlength=size)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    area = np.maximum(area, 1e-9 * area.mean())
    edges = mesh.edges_of(split)[0]
    shares = _shares(np.bincount(of_vertex, area), np.bincount(of_vertex), count)
    label, local = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
    faces_by_part, edges_by_part = (
        np.argsort(x, kind="stable") for x in (part, of_vertex[edges[:, 0]])
    )
    face_ends, edge_ends = (
        np.cumsum(np.bincount(part)),
        np.cumsum(np.bincount(of_vertex[edges[:, 0]])),
    )
    for k, (share, first) in enumerate(zip(shares, np.cumsum(shares) - shares)):
        faces = split[faces_by_part[face_ends[k - 1] if k else 0 : face_ends[k]]]
        inside = np.unique(faces)
        label[inside] = first
        if share > 1:
            local[inside] = np.arange(len(inside))
            sides = local[edges[edges_by_part[edge_ends[k - 1] if k else 0 : edge_ends[k]]]]
            at, weight, corners = points[inside], area[inside], local[faces]
            found = (
                plain(at, weight, corners, sides, share)
                if acvd
                else clusters(at, normals[inside], weight, corners, sides, share)
            )
            while found.max() + 1 < share:
                several = np.bincount(found) > 1
                found = split_in_two(
                    found,
                    np.where(several, np.bincount(found, area[inside]), -1).argmax(),
                    points[inside],
                    sides,
                    area[inside],
                )
                found = np.unique(found, return_inverse=True)[1]
            label[inside] += found
    return label


def _shares(area: np.ndarray, vertices: np.ndarray, count: int) -> np.ndarray:
    """``count`` patches dealt out to the parts, by area, at least one and at most as many as it has
    vertices each.
    """
    wanted = area / area.sum() * count
    share = np.clip(np.floor(wanted).astype(int), 1, vertices)
    while share.sum() != count:
        more = share.sum() < count
        gain = (
            np.where(share < vertices, wanted - share, -np.inf)
            if more
            else np.where(share > 1, share - wanted, -np.inf)
        )
        share[gain.argmax()] += 1 if more else -1
    return share


def _entries(
    size: int, F: np.ndarray, corner_patch: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``entry_patch``, ``entry_vertex`` and ``face_entries`` of :class:`Patches`."""
    keys = corner_patch[:, :, None] * size + F[:, None, :]
    on_boundary = (corner_patch != corner_patch[:, :1]).any(axis=1)
    entries = np.unique(np.concatenate([keys[~on_boundary, 0].ravel(), keys[on_boundary].ravel()]))
    return entries // size, entries % size, np.searchsorted(entries, keys)
