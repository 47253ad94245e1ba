"""Meshes in and out: PLY with uv, templates from OBJ and PLY in the file's own vertex order, and what a template must be.

Texture coordinates are those of OBJ files: (0, 0) is the texture's bottom left, v goes up.
"""

import logging
import os
import warnings

import numpy as np

from .errors import InputError
from .files import aside


def write_ply(path, vertices, faces, uv=None):
    """Write a triangle mesh as binary PLY: vertices (N, 3) as float32, faces (F, 3), uv (N, 2) as the properties ``s``, ``t``.

    Blender, MeshLab, trimesh and Mitsuba read uv under these names. Raises OSError where the file cannot be written.
    """
    columns = np.asarray(vertices, dtype="<f4")
    names = ["x", "y", "z"]
    if uv is not None:
        columns, names = np.hstack([columns, np.asarray(uv, dtype="<f4")]), names + ["s", "t"]
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    corners["count"], corners["vertices"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"element vertex {len(columns)}"] + [f"property float {name}" for name in names]
    header += [f"element face {len(corners)}", "property list uchar int vertex_indices", "end_header", ""]
    with aside(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(columns.tobytes())
        file.write(corners.tobytes())


def read_template(path):
    """``(vertices (N, 3) float64, faces (F, 3) int64, uv (N, 2) float64 or None)`` of an OBJ or PLY file.

    Vertices keep the file's order. Polygons of an OBJ file become fans of triangles around their first corner, in the file's
    order; those of a PLY file triangles in trimesh's order. uv is None where the file has none for some corner, or several for
    one vertex (a seam). Raises InputError in one line.
    """
    path = os.fspath(path)
    extension = os.path.splitext(path)[1].lower()
    if extension not in (".obj", ".ply"):
        raise InputError(f"{path}: template of type '{extension}'; .obj or .ply is needed")
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file; a template is an .obj or .ply file")
    return _read_obj(path) if extension == ".obj" else _read_ply(path)


def _read_obj(path):
    """By hand, because trimesh reorders the triangles of quads, drops loose vertices, and loses uv beside normals."""
    vertices, coordinates, triangles, corner_uv = [], [], [], []
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, start=1):
                words = line.split()
                if not words:
                    continue
                if words[0] == "v":
                    x, y, z = words[1:4]
                    vertices.append((float(x), float(y), float(z)))
                elif words[0] == "vt":
                    coordinates.append((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
                elif words[0] == "f":
                    corners = [_corner(word, len(vertices), len(coordinates)) for word in words[1:]]
                    if len(corners) < 3:
                        raise ValueError("a face of fewer than three vertices")
                    for k in range(1, len(corners) - 1):
                        fan = (corners[0], corners[k], corners[k + 1])
                        triangles.append([v for v, _ in fan])
                        corner_uv.append([t for _, t in fan])
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: line {number}: '{line.strip()[:60]}' is not OBJ ({error})") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    V = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    F = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    VT = np.array(coordinates, dtype=np.float64).reshape(-1, 2)
    T = np.array(corner_uv, dtype=np.int64).reshape(-1, 3)
    for what, index, count in (("vertices", F, len(V)), ("texture coordinates", T, len(VT))):
        if index.size and index.max() >= count:
            raise InputError(f"{path}: a face names number {index.max() + 1} of {count} {what}")
    return V, F, _uv_of_vertices(len(V), F, VT, T)


def _corner(word, vertices, coordinates):
    """(vertex, texture coordinate or -1) of ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, counted from 0."""
    v, t = (word.split("/") + [""])[:2]
    out = []
    for text, count in ((v, vertices), (t, coordinates)):
        index = int(text) if text or text is v else None
        if index is not None and (index == 0 or index < -count):
            raise ValueError(f"index {index}")
        out.append(-1 if index is None else index - 1 if index > 0 else count + index)
    return tuple(out)


def _uv_of_vertices(count, F, VT, T):
    """uv (N, 2) where every corner of a vertex agrees, else None. Vertices without a face get NaN."""
    if not T.size or T.min() < 0:
        return None
    uv = np.full((count, 2), np.nan)
    uv[F] = VT[T]
    return uv if np.allclose(uv[F], VT[T], rtol=0, atol=1e-9, equal_nan=True) else None


def _read_ply(path):
    import trimesh

    log = logging.getLogger("trimesh")
    was_disabled, log.disabled = log.disabled, True  # it prints a traceback where a TextureFile is missing
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = trimesh.load(path, file_type="ply", process=False, maintain_order=True)
    except Exception as error:  # trimesh lets everything through: KeyError, IndexError, UnicodeDecodeError, ...
        raise InputError(f"{path}: not a readable PLY file ({type(error).__name__}: {error})") from None
    finally:
        log.disabled = was_disabled
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"{path}: holds no faces; a triangle mesh is needed")
    V, F = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    uv = getattr(mesh.visual, "uv", None)
    if uv is None and {"s", "t"} <= set(mesh.vertex_attributes):
        uv = np.stack([mesh.vertex_attributes["s"], mesh.vertex_attributes["t"]], axis=1)
    if F.size and not 0 <= F.min() <= F.max() < len(V):
        raise InputError(f"{path}: faces name vertices {F.min()} to {F.max()}; 0 to {len(V) - 1} exist")
    return V, F, None if uv is None or len(uv) != len(V) else np.array(uv, dtype=np.float64)


def check_template(vertices, faces, uv, where="template"):
    """Raise InputError, in one line that starts with ``where``, unless the mesh can be a template.

    A template is one connected, consistently oriented manifold (closed or with a boundary) of at least three vertices, each of
    them in some face, with triangles of positive area and a finite texture coordinate a vertex.
    """
    V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    if len(V) < 3:
        raise InputError(f"{where}: {len(V)} vertices; a template has at least 3")
    if len(F) == 0:
        raise InputError(f"{where}: no faces; a template is a triangle mesh")
    if F.min() < 0 or F.max() >= len(V):
        raise InputError(f"{where}: faces name vertices {F.min()} to {F.max()}; 0 to {len(V) - 1} exist")
    _refuse(~np.isfinite(V).all(axis=1), where, "vertices have coordinates that are not finite", "vertex")
    _refuse(np.bincount(F.ravel(), minlength=len(V)) == 0, where, "vertices are in no face", "vertex")
    if uv is None:
        raise InputError(f"{where}: no texture coordinates, or several at one vertex; one uv a vertex is needed")
    uv = np.asarray(uv, dtype=np.float64)
    if uv.shape != (len(V), 2):
        raise InputError(f"{where}: texture coordinates of shape {uv.shape}; ({len(V)}, 2) is needed")
    _refuse(~np.isfinite(uv).all(axis=1), where, "texture coordinates are not finite", "vertex")
    area = 0.5 * np.linalg.norm(np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]), axis=1)
    _refuse(area <= 1e-12 * np.ptp(V, axis=0).max() ** 2, where, "faces have no area", "face")
    _check_topology(V, F, where)


def _check_topology(V, F, where):
    directed = np.stack([F, np.roll(F, -1, axis=1)], axis=2).reshape(-1, 2)  # edge k of face f is row 3 f + k
    edges, edge_of, uses = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    if (uses > 2).any():
        a, b = edges[uses > 2][0]
        raise InputError(f"{where}: {(uses > 2).sum()} edges have more than two faces (the first joins vertices {a} and {b})")
    _, ways = np.unique(directed, axis=0, return_counts=True)
    if (ways > 1).any():
        raise InputError(f"{where}: {(ways > 1).sum()} pairs of neighbouring faces are oriented against each other; one orientation is needed")
    parts = _count_components(len(V), directed)
    if parts > 1:
        raise InputError(f"{where}: {parts} separate components; one connected mesh is needed")
    fans = _count_fans(edge_of.ravel())
    if fans > len(V):
        raise InputError(f"{where}: {fans - len(V)} vertices join parts that share no edge there; a manifold is needed")


def _count_fans(edge_of):
    """How many fans the faces form around the vertices, one at each vertex of a manifold.

    ``edge_of`` (3 F,): the edge from each corner to the next of its face. Two corners belong to one fan where their faces,
    oriented alike, share an edge at the corners' vertex.
    """
    order = np.argsort(edge_of, kind="stable")
    shared = edge_of[order[:-1]] == edge_of[order[1:]]
    first, second = order[:-1][shared], order[1:][shared]  # the two sides of each inner edge, which run against each other
    after_first, after_second = (corner - corner % 3 + (corner + 1) % 3 for corner in (first, second))
    joined = np.concatenate([np.stack([first, after_second], axis=1), np.stack([after_first, second], axis=1)])
    return _count_components(len(edge_of), joined)


def _count_components(count, pairs):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[0]


def _refuse(bad, where, what, element):
    if bad.any():
        raise InputError(f"{where}: {bad.sum()} {what} (the first is {element} {int(np.argmax(bad))}, counted from 0)")
