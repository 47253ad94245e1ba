"""Meshes in and out: OBJ and PLY in the file's own vertex order, glTF with all of its meshes as
one, and PLY with uv.

Texture coordinates are those of OBJ files: (0, 0) is the texture's bottom left, v goes up.
"""

import os

import numpy as np
from numpy.typing import ArrayLike

from polyfit.errors import InputError
from polyfit.files import as_path, aside

from .obj import read_obj
from .ply import read_ply
from .texcoords import TexCoords

_TexturedMesh = tuple[np.ndarray, np.ndarray, TexCoords | None]  # vertices, faces, coordinates
_MeshArrays = tuple[np.ndarray, np.ndarray, np.ndarray | None]  # vertices, faces, uv


def write_ply(
    path: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike, uv: ArrayLike | None = None
) -> None:
    """Write a triangle mesh as binary PLY: vertices (N, 3) as float32, faces (F, 3), uv (N, 2) as
    the properties ``s``, ``t``.

    Blender, MeshLab and Mitsuba read uv under these names. Raises InputError for what is no mesh,
    and OSError where the file cannot be written.
    """
    from .triangles import as_arrays  # SciPy is slow to load

    V, F = as_arrays(vertices, faces, os.fspath(path))
    columns, names = V.astype("<f4"), ["x", "y", "z"]
    if uv is not None:
        of_vertices = np.asarray(uv, dtype="<f4")
        if of_vertices.shape != (len(V), 2):
            raise InputError(f"{path}: uv of shape {of_vertices.shape}; ({len(V)}, 2) is needed")
        columns, names = np.hstack([columns, of_vertices]), names + ["s", "t"]
    corners = np.empty(len(F), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    corners["count"], corners["vertices"] = 3, F
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"element vertex {len(columns)}"] + [f"property float {name}" for name in names]
    header += [
        f"element face {len(corners)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    with aside(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(columns.tobytes())
        file.write(corners.tobytes())


def read_mesh(path: str | os.PathLike[str], what: str = "mesh") -> _MeshArrays:
    """``(vertices (N, 3) float64, faces (F, 3) int64, uv (N, 2) float64 or None)`` of an OBJ, PLY
    or glTF file (.glb, .gltf).

    Vertices keep the file's order, and polygons become triangles in the file's order
    (:mod:`polyfit.mesh.polygons`). The meshes of a glTF file are one, each in its place in the
    scene (:mod:`polyfit.mesh.gltf`); their axes stay, y up. uv is None where the file has none for
    some corner, or several for one vertex (a seam). Raises InputError in one line, in which the
    mesh is called ``what``.
    """
    vertices, faces, texcoords = read_textured(path, what)
    count = len(vertices)
    if texcoords is None or texcoords.faces.min() < 0:
        return vertices, faces, None
    return vertices, faces, texcoords.of_vertices(faces, count)


def read_textured(path: str | os.PathLike[str], what: str = "mesh") -> _TexturedMesh:
    """As :func:`read_mesh`, with a :class:`polyfit.mesh.TexCoords`, seams included, or None where
    the file has no texture coordinates at all. Corners without any name the coordinate -1.
    """
    path = as_path(path, what)
    extension = os.path.splitext(path)[1].lower()
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; a {what} is an .obj, .ply or .glb file")
    if extension not in (".obj", ".ply", ".glb", ".gltf"):
        raise InputError(f"{path}: {what} of type '{extension}'; .obj, .ply or .glb is needed")
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file; a {what} is an .obj, .ply or .glb file")
    if extension == ".obj":
        return read_obj(path)
    if extension == ".ply":
        return read_ply(path)
    from .gltf import read_gltf  # SciPy is slow to load

    return read_gltf(path)
