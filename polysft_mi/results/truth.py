"""What a reconstruction is compared with: surfaces and ground truth, read and checked.

Ground truth is ``gt.npz`` (vertices of every frame), an .npz of depth points, a folder of
``cloud_*.npz``, or a sequence's folder that holds one of them.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from polyfit.files import NOT_NPZ
from polyfit.mesh import TexCoords
from polysft_mi.errors import InputError


@dataclass(frozen=True)
class Truth:
    """Ground truth of some frames, [m, camera frame].

    ``kind``: "mesh" (vertices (N, 3) in each frame, with common ``faces`` (F, 3)), "points" (depth
    points (P, 3), with ``K`` (3, 3) or None) or "clouds" (points (P, 3) without an order).
    ``places``: what each frame holds; for clouds the path of its file. ``seen``: of a mesh, the
    vertices (N,) bool that the camera sees, by frame, where that is known. ``path``: where all of
    it was read.
    """

    path: str
    kind: str
    places: dict
    faces: np.ndarray | None = None
    K: np.ndarray | None = None
    seen: dict | None = None

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Truth:
        """The truth in ``path``, a file or a folder as :func:`find_truth` takes it. Raises
        InputError.
        """
        path = find_truth(path)
        if os.path.isdir(path):
            clouds = {}
            for name in sorted(os.listdir(path)):
                if number := re.fullmatch(r"cloud_(\d+)\.npz", name):
                    clouds[int(number[1])] = os.path.join(path, name)
            return cls(path, "clouds", clouds)
        arrays = load_npz(path)
        if "points" in arrays and "frames" in arrays:
            points, frames, K = arrays["points"], arrays["frames"], arrays.get("K", np.eye(3))
            if (
                points.ndim != 3
                or points.shape[2] != 3
                or not points.size
                or frames.shape != points.shape[:1]
                or K.shape != (3, 3)
            ):
                raise InputError(
                    f"{path}: points {points.shape}, frames {frames.shape}, K {K.shape}; (T,P,3),"
                    " (T,) and (3,3) with T > 0 and P > 0 are needed"
                )
            places = {int(k): P for k, P in zip(frames, points)}
            return cls(path, "points", places, K=arrays.get("K"))
        if "vertices" in arrays and "faces" in arrays:
            counted = {"frames": np.arange(len(np.atleast_1d(arrays["vertices"])))}
            surface = counted | arrays
            check_surface(surface, str(path))
            numbers = [int(k) for k in surface["frames"]]
            places = dict(zip(numbers, surface["vertices"]))
            visible, seen = arrays.get("seen"), None
            if visible is not None:
                if visible.shape != arrays["vertices"].shape[:2] or not visible.any(1).all():
                    raise InputError(
                        f"{path}: seen {visible.shape}; {arrays['vertices'].shape[:2]}, with a"
                        " vertex that is seen in every frame, is needed"
                    )
                seen = dict(zip(numbers, visible.astype(bool)))
            return cls(path, "mesh", places, arrays["faces"].astype(np.int64), seen=seen)
        raise InputError(
            f"{path}: holds {', '.join(arrays)}; vertices and faces, or points and frames, are"
            " needed"
        )

    def at(self, frame: int) -> np.ndarray:
        """The vertices or points (N, 3) [m] of a frame, float64."""
        place = self.places[frame]
        if self.kind == "clouds":
            arrays = load_npz(place)
            if "points" not in arrays:
                raise InputError(f"{place}: holds {', '.join(arrays)}; points are needed")
            place = arrays["points"]
        return place.astype(np.float64)


def find_truth(path: str | os.PathLike[str]) -> str:
    """The ground truth in ``path``: a file as it is, a folder of clouds as it is, else what a
    sequence's folder holds.
    """
    path = os.fspath(path)
    if not os.path.isdir(path):
        return path
    if glob.glob(os.path.join(glob.escape(path), "cloud_*.npz")):
        return path
    for name in ("gt.npz", "gt_points.npz", "points.npz"):
        if os.path.exists(os.path.join(path, name)):
            return os.path.join(path, name)
    clouds = os.path.join(path, "clouds")
    if glob.glob(os.path.join(glob.escape(clouds), "cloud_*.npz")):
        return clouds
    raise InputError(
        f"{path}: holds no ground truth; gt.npz, gt_points.npz or clouds/cloud_*.npz is needed"
    )


def read_surface(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of a ``surface.npz``, or of a run's folder that holds one. Raises InputError where
    it is not of that form.
    """
    if os.path.isdir(path):
        if not os.path.exists(os.path.join(path, "surface.npz")):
            raise InputError(
                f"{path}: holds no surface.npz; the folder of a run, or a surface.npz, is needed"
            )
        path = os.path.join(path, "surface.npz")
    surface = load_npz(path)
    check_surface(surface, str(path))
    return surface


def check_surface(surface: Mapping[str, ArrayLike], where: str) -> None:
    """Raise InputError, which begins with ``where``, where arrays are not those of a
    ``surface.npz``.
    """
    missing = [name for name in ("vertices", "faces", "frames") if name not in surface]
    if missing:
        raise InputError(
            f"{where}: holds no {', '.join(missing)}; vertices (T,N,3), faces (F,3) and frames (T,)"
            " are needed"
        )
    up = str(np.asarray(surface.get("up", "camera")))
    if up != "camera":
        raise InputError(
            f"{where}: an export with {up} up; the surface.npz of the run, in the camera"
            " frame, is needed, or an export by --up camera"
        )
    V, F, frames = (np.asarray(surface[name]) for name in ("vertices", "faces", "frames"))
    if (
        V.ndim != 3
        or V.shape[2] != 3
        or F.ndim != 2
        or F.shape[1] != 3
        or frames.shape != V.shape[:1]
        or not len(frames)
    ):
        raise InputError(
            f"{where}: vertices {V.shape}, faces {F.shape}, frames {frames.shape}; (T,N,3), (F,3)"
            " and (T,) with T > 0 are needed"
        )
    if V.dtype.kind not in "fiu" or F.dtype.kind not in "iu" or frames.dtype.kind not in "iu":
        raise InputError(
            f"{where}: types {V.dtype}, {F.dtype}, {frames.dtype} of vertices, faces, frames; a"
            " float and two integers are needed"
        )
    if F.size and not 0 <= F.min() <= F.max() < V.shape[1]:
        raise InputError(
            f"{where}: faces name vertices {F.min()} to {F.max()}; 0 to {V.shape[1] - 1} exist"
        )
    if not np.isfinite(V).all():
        raise InputError(f"{where}: vertices hold values that are not finite")
    numbers, count = np.unique(frames, return_counts=True)
    if len(numbers) < len(frames):
        twice = numbers[count > 1][0]
        raise InputError(f"{where}: frames holds {twice} more than once; each is needed once")


def uv_arrays(texcoords: TexCoords, faces: np.ndarray) -> dict[str, np.ndarray]:
    """Texture coordinates as a ``surface.npz`` has them: ``uv`` (N, 2), one a vertex of the mesh
    with ``faces`` (F, 3), or ``uv`` (M, 2) and ``uv_faces`` (F, 3) where there are seams.
    """
    per_vertex = texcoords.of_vertices(faces)
    if per_vertex is not None:
        return {"uv": per_vertex.astype(np.float32)}
    return {
        "uv": texcoords.coordinates.astype(np.float32),
        "uv_faces": texcoords.faces.astype(np.int32),
    }


def texcoords_of(surface: dict[str, np.ndarray], path: str) -> TexCoords:
    """The texture coordinates of a surface that :func:`read_surface` read from ``path``. Raises
    InputError where it has none of a form that :func:`uv_arrays` describes.
    """
    uv, faces, count = surface.get("uv"), surface["faces"], surface["vertices"].shape[1]
    corners = surface.get("uv_faces", faces)
    if (
        uv is None
        or uv.ndim != 2
        or uv.shape[1] != 2
        or corners.shape != faces.shape
        or ("uv_faces" not in surface and len(uv) != count)
        or corners.min() < 0
        or corners.max() >= len(uv)
    ):
        raise InputError(
            f"{path}: holds no uv of ({count}, 2), nor uv of (M, 2) with uv_faces {faces.shape}"
        )
    return TexCoords(uv.astype(np.float64), corners.astype(np.int64))


def load_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, a dict. Raises InputError where it is missing or not such a
    file.
    """
    try:
        with np.load(path) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; an .npz file is needed") from None
    except NOT_NPZ:
        raise InputError(f"{path}: not a readable .npz file, or a damaged one") from None
