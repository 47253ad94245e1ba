"""Texture coordinates of a mesh, which may have seams: vertices with several of them. NumPy."""

from dataclasses import dataclass

import numpy as np

from polyfit.errors import InputError


@dataclass(frozen=True)
class TexCoords:
    """``coordinates`` (M, 2), (0, 0) at the image's bottom left, v up; ``faces`` (F, 3): the one of
    each corner of each face, -1 for a corner that has none.
    """

    coordinates: np.ndarray
    faces: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """The coordinates of the faces' corners, (F, 3, 2); NaN for those without."""
        return self._at(self.faces)

    def check(self, count: int, where: str) -> None:
        """Raises InputError, which starts with ``where``, unless they are of ``count`` faces and
        name coordinates that are there.
        """
        coordinates, faces = np.shape(self.coordinates), np.asarray(self.faces)
        fits = coordinates[1:] == (2,) and faces.shape == (count, 3)
        if not fits or faces.dtype.kind not in "iu":
            raise InputError(
                f"{where}: texture coordinates {coordinates} of faces {faces.shape}; (M, 2) and"
                f" ({count}, 3) of whole numbers are needed"
            )
        if count and not -1 <= faces.min() <= faces.max() < coordinates[0]:
            raise InputError(
                f"{where}: faces name texture coordinates {faces.min()} to {faces.max()}; 0 to"
                f" {coordinates[0] - 1}, or -1, exist"
            )

    def _at(self, index: np.ndarray) -> np.ndarray:
        """The coordinates (..., 2) with the numbers ``index`` (...,)."""
        if not (index < 0).any():
            return self.coordinates[index]
        missing = np.full((1, 2), np.nan)
        return np.concatenate([self.coordinates, missing])[index]

    def split(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices split along the seams, for files that take one coordinate a vertex.

        ``faces`` (F, 3): of the mesh. Returns (source (V,), uv (V, 2), faces (F, 3)): the mesh's
        vertex of each of the V new ones, its coordinate, and the faces on them. Without seams the
        vertices stay as they are.
        """
        per_vertex = self.of_vertices(faces)
        if per_vertex is not None:
            return np.arange(len(per_vertex)), per_vertex, faces
        pairs = np.stack([faces.ravel(), self.faces.ravel()], 1)
        found, index = np.unique(pairs, axis=0, return_inverse=True)
        return found[:, 0], self._at(found[:, 1]), index.reshape(faces.shape)

    def of_vertices(self, faces: np.ndarray, count: int | None = None) -> np.ndarray | None:
        """(N, 2), one a vertex of the mesh with ``faces`` (F, 3) and N = ``count`` vertices, NaN
        for one without a face; None where there is a seam.
        """
        uv = np.full((count or int(faces.max()) + 1, 2), np.nan)
        uv[faces] = self.corners
        same = np.allclose(uv[faces], self.corners, rtol=0, atol=1e-9, equal_nan=True)
        return uv if same else None
