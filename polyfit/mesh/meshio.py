"""Meshes in and out: OBJ and PLY in the file's own vertex order, glTF with all of its meshes as
one, and PLY with uv.

Texture coordinates are those of OBJ files: (0, 0) is the texture's bottom left, v goes up.
"""

import logging
import os
import warnings

import numpy as np
from numpy.typing import ArrayLike

from polyfit.errors import InputError
from polyfit.files import aside

from .texcoords import TexCoords

_TexturedMesh = tuple[np.ndarray, np.ndarray, TexCoords | None]  # vertices, faces, coordinates
_MeshArrays = tuple[np.ndarray, np.ndarray, np.ndarray | None]  # vertices, faces, uv


def write_ply(
    path: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike, uv: ArrayLike | None = None
) -> None:
    """Write a triangle mesh as binary PLY: vertices (N, 3) as float32, faces (F, 3), uv (N, 2) as
    the properties ``s``, ``t``.

    Blender, MeshLab, trimesh and Mitsuba read uv under these names. Raises OSError where the file
    cannot be written.
    """
    columns = np.asarray(vertices, dtype="<f4")
    names = ["x", "y", "z"]
    if uv is not None:
        columns, names = np.hstack([columns, np.asarray(uv, dtype="<f4")]), names + ["s", "t"]
    F = np.asarray(faces)
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

    Vertices keep the file's order. Polygons of an OBJ file become fans of triangles around their
    first corner, in the file's order; those of a PLY file triangles in trimesh's order. The meshes
    of a glTF file are one, each in its place in the scene, without the vertices that seams of the
    texture split; their axes stay, y up. uv is None where the file has none for some corner, or
    several for one vertex (a seam). Raises InputError in one line, in which the mesh is called
    ``what``.
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
    path = os.fspath(path)
    extension = os.path.splitext(path)[1].lower()
    if extension not in (".obj", ".ply", ".glb", ".gltf"):
        raise InputError(f"{path}: {what} of type '{extension}'; .obj, .ply or .glb is needed")
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file; a {what} is an .obj, .ply or .glb file")
    return _read_obj(path) if extension == ".obj" else _read_by_trimesh(path, extension[1:])


def _read_obj(path: str) -> _TexturedMesh:
    """By hand, because trimesh reorders the triangles of quads, drops loose vertices, and loses uv
    beside normals.
    """
    vertices, coordinates, triangles, corner_uv = [], [], [], []
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, start=1):  # noqa: B007 (named in an error below)
                words = line.split()
                if not words:
                    continue
                if words[0] == "v":
                    x, y, z = words[1:4]
                    vertices.append((float(x), float(y), float(z)))
                elif words[0] == "vt":
                    coordinates.append(
                        (float(words[1]), float(words[2]) if len(words) > 2 else 0.0)
                    )
                elif words[0] == "f":
                    corners = [_corner(word, len(vertices), len(coordinates)) for word in words[1:]]
                    if len(corners) < 3:
                        raise ValueError("a face of fewer than three vertices")
                    for k in range(1, len(corners) - 1):
                        fan = (corners[0], corners[k], corners[k + 1])
                        triangles.append([v for v, _ in fan])
                        corner_uv.append([t for _, t in fan])
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: line {number}: '{line.strip()[:60]}' is not OBJ ({error})"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    V = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    F = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    VT = np.array(coordinates, dtype=np.float64).reshape(-1, 2)
    T = np.array(corner_uv, dtype=np.int64).reshape(-1, 3)
    for what, index, count in (("vertices", F, len(V)), ("texture coordinates", T, len(VT))):
        if index.size and index.max() >= count:
            raise InputError(f"{path}: a face names number {index.max() + 1} of {count} {what}")
    return V, F, TexCoords(VT, T) if T.size and T.max() >= 0 else None


def _corner(word: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """(vertex, texture coordinate or -1) of ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, counted from
    0.
    """
    v, t = (word.split("/") + [""])[:2]
    return _from_zero(int(v), vertices), _from_zero(int(t), coordinates) if t else -1


def _from_zero(index: int, count: int) -> int:
    """An OBJ file's index, counted from 1 or backwards from the ``count``-th, counted from 0."""
    if index == 0 or index < -count:
        raise ValueError(f"index {index}")
    return index - 1 if index > 0 else count + index


def _read_by_trimesh(path: str, kind: str) -> _TexturedMesh:
    import trimesh

    from .triangles import welded  # SciPy is slow to load

    log = logging.getLogger("trimesh")
    was_disabled = log.disabled
    log.disabled = True  # it prints a traceback where a TextureFile is missing
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = trimesh.load(path, file_type=kind, process=False, maintain_order=True)
            if isinstance(mesh, trimesh.Scene):
                mesh = mesh.to_geometry()
    except Exception as error:  # trimesh raises anything: KeyError, UnicodeDecodeError, ...
        raise InputError(
            f"{path}: not a readable {kind.upper()} file ({type(error).__name__}: {error})"
        ) from None
    finally:
        log.disabled = was_disabled
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"{path}: holds no faces; a triangle mesh is needed")
    V, F = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    uv = getattr(mesh.visual, "uv", None)
    if uv is None and {"s", "t"} <= set(mesh.vertex_attributes):
        uv = np.stack([mesh.vertex_attributes["s"], mesh.vertex_attributes["t"]], axis=1)
    if F.size and not 0 <= F.min() <= F.max() < len(V):
        raise InputError(
            f"{path}: faces name vertices {F.min()} to {F.max()}; 0 to {len(V) - 1} exist"
        )
    texcoords = None
    if uv is not None and len(uv) == len(V):
        texcoords = TexCoords(np.array(uv, dtype=np.float64), F)
    if kind == "ply":
        return V, F, texcoords
    kept, F = welded(V, F)  # glTF splits vertices along seams of the texture
    return V[kept], F, texcoords
