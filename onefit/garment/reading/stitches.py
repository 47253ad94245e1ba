"""What holds cloth together where no face does: a button through two layers, a buckle between a
strap and a bib. NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from onefit.body import ClosestSurface
from polyfit import mesh

from .mending import SMALL_PART_SHARE
from .render_mesh import RenderMesh

_TOUCHING = 0.01  # [m]: a small part that is so near to cloth is sewn to it
_TOGETHER = 0.005  # [m]: small parts that are so near to each other are one
_AROUND = 0.03  # [m] beyond a small part: pieces of cloth that do not meet there are two


@dataclass(frozen=True)
class Stitches:
    """Threads of a garment: from the vertex ``start`` (S,) to the point ``barycentric`` (S, 3) of a
    face's ``corners`` (S, 3), ``lengths`` (S,) [m] at rest.
    """

    start: np.ndarray
    corners: np.ndarray
    barycentric: np.ndarray
    lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.start)

    def edges(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Each thread between two of the ``vertices`` (N, 3) [m], those nearest to its ends:
        (S, 2), and how long it is there (S,) [m].
        """
        end = np.take_along_axis(self.corners, self.barycentric.argmax(1)[:, None], 1)[:, 0]
        pairs = np.stack([self.start, end], axis=1)
        return pairs, np.linalg.norm(vertices[self.start] - vertices[end], axis=1)


def stitched(render_mesh: RenderMesh, V: np.ndarray, F: np.ndarray) -> Stitches:
    """The threads of cloth, V (N, 3) [m], F (F, 3), by the small parts of the file's mesh, buttons
    and buckles: each is sewn to the pieces of cloth that it touches, and so they are to each other.
    """
    threads = []
    centre = V[F].mean(axis=1)
    size = np.linalg.norm(V[F] - centre[:, None], axis=2).max(axis=1, initial=0)
    for trim in _trims(render_mesh.carried(V, F), render_mesh):
        middle = trim.mean(axis=0)
        reach = np.linalg.norm(trim - middle, axis=1).max() + _AROUND
        around = np.flatnonzero(np.linalg.norm(centre - middle, axis=1) - size < reach)
        touched = sorted(_touched(trim, V, F[around]), key=lambda found: found[0])
        for _, corners, barycentric in touched[1:]:
            start = touched[0][1][touched[0][2].argmax()]
            length = np.linalg.norm(V[start] - barycentric @ V[corners])
            threads.append((start, corners, barycentric, length))
    start, corners, barycentric, lengths = zip(*threads) if threads else ((), (), (), ())
    return Stitches(
        np.array(start, dtype=int),
        np.array(corners, dtype=int).reshape(-1, 3),
        np.array(barycentric, dtype=float).reshape(-1, 3),
        np.array(lengths, dtype=float),
    )


def _trims(vertices, render_mesh):
    """The vertices (K, 3) [m] of each small part, parts that touch each other together."""
    kept, faces = render_mesh.welded(vertices)
    vertices = vertices[kept]
    part = mesh.components(len(vertices), mesh.edges_of(faces)[0])
    area = np.bincount(part[faces[:, 0]], mesh.areas(vertices, faces), minlength=part.max() + 1)
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    of_trims = np.flatnonzero(used & (area < SMALL_PART_SHARE * area.sum())[part])
    if not len(of_trims):
        return []
    near = cKDTree(vertices[of_trims]).query_pairs(_TOGETHER, output_type="ndarray")
    joined = mesh.components(part.max() + 1, part[of_trims[near.reshape(-1, 2)]])[part[of_trims]]
    return [vertices[of_trims[joined == k]] for k in np.unique(joined)]


def _touched(trim, V, F):
    """Of each piece of cloth that a part with vertices ``trim`` (K, 3) [m] touches: how far away it
    is, and where: a face's corners (3,) and barycentric (3,).
    """
    piece = mesh.components(len(V), mesh.edges_of(F)[0])[F[:, 0]] if len(F) else np.empty(0, int)
    for k in np.unique(piece):
        faces = F[piece == k]
        at = ClosestSurface(V, faces)(trim)
        nearest = np.abs(at.distance).argmin()
        distance = abs(float(at.distance[nearest]))
        if distance < _TOUCHING:
            yield distance, faces[at.face[nearest]], at.barycentric[nearest].astype(float)
