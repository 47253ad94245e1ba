"""The mesh of a garment's file, as it is to be seen, carried by the cloth that was made of it.

Mending drops, merges and cuts: buttons, the inner side of thick cloth, vertices along a seam of the
texture. What drapes is clean cloth. What is handed back is the file's own mesh, with its vertices
in their order, its faces and its texture coordinates: each vertex is held by the nearest point of
the cloth, in the frame there (a *wrap deformer*). The cloth's triangles are rounded between their
corners' planes (Boubekeur and Alexa 2008, "Phong tessellation"), so that a fine mesh stays smooth
on coarse cloth. NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from onefit.body import ClosestSurface
from polyfit.mesh import TexCoords, vertex_normals, welded

_ROUND = 0.75  # of the way to the mean of the corners' planes


@dataclass(frozen=True)
class RenderMesh:
    """``faces`` (G, 3) of a garment's file and its ``texcoords`` (or None). Vertex m hangs on the
    cloth's ``face`` (M,), at ``barycentric`` (M, 3), ``offset`` (M, 3) [m] from there in the frame
    of the cloth's normal and of the face's first side.
    """

    faces: np.ndarray
    texcoords: TexCoords | None
    face: np.ndarray
    barycentric: np.ndarray
    offset: np.ndarray

    @classmethod
    def bound(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        texcoords: TexCoords | None,
        cloth: np.ndarray,
        cloth_faces: np.ndarray,
    ) -> RenderMesh:
        """The mesh of a file, vertices (M, 3) [m], held by ``cloth`` (N, 3) [m] with
        ``cloth_faces`` (F, 3) as it lies there. Vertices that are not finite lie at the origin.
        """
        held = cls(faces, texcoords, np.empty(0, int), np.empty((0, 3)), np.empty((0, 3)))
        return held._hung(np.nan_to_num(vertices, posinf=0, neginf=0), cloth, cloth_faces)

    def rebound(
        self, cloth: np.ndarray, cloth_faces: np.ndarray, other: np.ndarray, other_faces: np.ndarray
    ) -> RenderMesh:
        """The same mesh, held by the ``other`` cloth in place of ``cloth``, on which it lay."""
        return self._hung(self.carried(cloth, cloth_faces), other, other_faces)

    def _hung(self, vertices, cloth, cloth_faces):
        at = ClosestSurface(cloth, cloth_faces)(vertices, 1e9)  # wherever loose ones lie
        barycentric = at.barycentric.astype(np.float64)
        on_cloth = replace(
            self, face=at.face, barycentric=barycentric, offset=np.zeros((len(vertices), 3))
        )
        point, frame = on_cloth._frames(cloth, cloth_faces)
        away = vertices - point
        away[np.linalg.norm(away, axis=1) < 1e-6] = 0  # what single precision leaves
        return replace(on_cloth, offset=np.einsum("mij,mi->mj", frame, away))

    def carried(self, cloth: np.ndarray, cloth_faces: np.ndarray) -> np.ndarray:
        """The mesh's vertices (M, 3) [m] where the cloth is at (N, 3) [m]."""
        point, frame = self._frames(np.asarray(cloth, dtype=np.float64), cloth_faces)
        return point + np.einsum("mij,mj->mi", frame, self.offset)

    def _frames(self, cloth, cloth_faces):
        """The points that hold the vertices (M, 3), and the frames there (M, 3, 3), axes in
        columns.
        """
        corners = cloth_faces[self.face]
        mixed = lambda x: np.einsum("mk,mkd->md", self.barycentric, x)
        unit = lambda x: x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
        x, n = cloth[corners], vertex_normals(cloth, cloth_faces)[corners]
        flat, normal = mixed(x), unit(mixed(n))
        beyond = np.einsum("mkd,mkd->mk", flat[:, None] - x, n)  # the planes of the corners
        point = flat - _ROUND * mixed(beyond[..., None] * n)
        side = x[:, 1] - x[:, 0]
        along = unit(side - (side * normal).sum(axis=1, keepdims=True) * normal)
        return point, np.stack([along, np.cross(normal, along), normal], axis=2)

    def welded(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(kept (K,), faces (G', 3))``: which of the ``vertices`` (M, 3) [m] lie apart from each
        other, and the faces on these: without the seams that some formats cut.
        """
        kept, faces = welded(vertices, self.faces, grid=2e-5)
        return kept, faces[(np.roll(faces, 1, axis=1) != faces).all(axis=1)]
