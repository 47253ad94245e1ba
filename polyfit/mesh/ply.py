"""PLY files, in the file's own order of vertices and faces."""

import struct
from typing import Any

import numpy as np

from polyfit.errors import InputError
from polyfit.files import text_encoding

from .polygons import triangulated
from .texcoords import TexCoords

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_FACES = ("vertex_indices", "vertex_index")

# An element's properties: (name, type, type of the list's length or None)
_Properties = list[tuple[str, str, str | None]]


def read_ply(path: str) -> tuple[np.ndarray, np.ndarray, TexCoords | None]:
    """``(vertices (N, 3) float64, faces (F, 3) int64, texcoords or None)`` of an ASCII or binary
    PLY; texture coordinates are properties of the vertices (``s t``, ``u v``, ``texture_u
    texture_v``), or lists ``texcoord`` of the faces; corners without one have -1.

    Textures that it names are not looked for. Raises InputError in one line.
    """
    try:
        with open(path, "rb") as file:
            raw = file.read()
        encoding = text_encoding(path)
        if encoding == "utf-8-sig":
            raw = raw[3:]
        elif encoding != "utf-8":
            raw = raw.decode(encoding).encode()
        form, elements, body = _header(raw)
        data = _ascii(elements, body) if form == "ascii" else _binary(elements, body, form)
        V, corner, sizes, uv, uv_corner = _mesh(data)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, IndexError, struct.error) as error:
        text = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path}: not a readable PLY file ({text})") from None
    if not len(sizes):
        raise InputError(f"{path}: holds no faces; a triangle mesh is needed")
    if not 0 <= corner.min() <= corner.max() < len(V):
        raise InputError(
            f"{path}: faces name vertices {corner.min()} to {corner.max()}; 0 to {len(V) - 1} exist"
        )
    triangles = triangulated(V, corner, sizes)
    texcoords = None if uv is None else TexCoords(uv, uv_corner[triangles])
    return V, corner[triangles], texcoords


def _header(raw: bytes) -> tuple[str, list[tuple[str, int, _Properties]], bytes]:
    """(format, elements, what follows the header)."""
    head, end, body = raw.partition(b"end_header")
    lines = head.decode("utf-8", errors="replace").splitlines()
    if not lines or lines[0].strip() != "ply" or not end:
        raise ValueError("it begins with ply, and its header ends with end_header")
    body = body.lstrip(b" \t")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    form = ""
    elements: list[tuple[str, int, _Properties]] = []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and words[1] == "list":
            elements[-1][2].append((words[4], _type(words[3]), _type(words[2])))
        elif words[0] == "property":
            elements[-1][2].append((words[2], _type(words[1]), None))
        else:
            raise ValueError(f"'{line.strip()[:60]}' in its header")
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError(f"format {form or 'missing'}")
    return form, elements, body


def _type(name: str) -> str:
    if name not in _TYPES:
        raise ValueError(f"a property of type {name}")
    return _TYPES[name]


def _ascii(elements: Any, body: bytes) -> dict[str, dict[str, Any]]:
    """Element name to property name to array (n,), or for a list (lengths (n,), items)."""
    numbers = np.array(body.split(), dtype=np.float64)
    data, at = {}, 0
    for name, count, properties in elements:
        if all(kind is None for _, _, kind in properties):
            size = count * len(properties)
            if at + size > len(numbers):
                raise ValueError(f"it ends among the {count} elements {name}")
            columns = numbers[at : at + size].reshape(count, len(properties))
            data[name] = {p[0]: columns[:, k] for k, p in enumerate(properties)}
            at += size
            continue
        rows: dict[str, list[Any]] = {p[0]: [] for p in properties}
        for _ in range(count):
            for p, _, kind in properties:
                size = 1
                if kind is not None:
                    size, at = int(numbers[at]), at + 1
                rows[p].append(numbers[at : at + size])
                if size < 0 or len(rows[p][-1]) < size:
                    raise ValueError(f"it ends among the {count} elements {name}")
                at += size
        data[name] = _columns(rows, properties)
    return data


def _binary(elements: Any, body: bytes, form: str) -> dict[str, dict[str, Any]]:
    """As :func:`_ascii`."""
    order = "<" if form == "binary_little_endian" else ">"
    data, at = {}, 0
    for name, count, properties in elements:
        rows = _alike(properties, order, body, at, count)
        if rows is not None:
            at += rows.nbytes
            data[name] = {
                p: rows[p] if kind is None else (rows[f"{p} length"].astype(int), rows[p].ravel())
                for p, _, kind in properties
            }
            continue
        loose: dict[str, list[Any]] = {p[0]: [] for p in properties}
        for _ in range(count):
            for p, kind, length in properties:
                size = 1
                if length is not None:
                    size = int(np.frombuffer(body, order + length, 1, at)[0])
                    at += np.dtype(length).itemsize
                loose[p].append(np.frombuffer(body, order + kind, size, at) if size else ())
                at += size * np.dtype(kind).itemsize
        data[name] = _columns(loose, properties)
    return data


def _alike(properties: _Properties, order: str, body: bytes, at: int, count: int) -> Any:
    """The rows of an element whose lists all are as long as those of the first; else None."""
    fields: list[Any] = []
    place = at
    for name, kind, length in properties:
        if length is None or not count:
            fields.append((name, order + kind))
        else:
            size = int(np.frombuffer(body, order + length, 1, place)[0])
            if size < 1:
                return None
            fields += [(f"{name} length", order + length), (name, order + kind, (size,))]
        place = at + np.dtype(fields).itemsize
    if count and all(length is None for _, _, length in properties):
        return np.frombuffer(body, np.dtype(fields), count, at)
    whole = np.dtype(fields)
    if not count or at + whole.itemsize * count > len(body):
        return None if count else np.empty(0, whole)
    rows = np.frombuffer(body, whole, count, at)
    lengths = [rows[f"{p} length"] for p, _, length in properties if length is not None]
    return rows if all((x == x[0]).all() for x in lengths) else None


def _columns(rows: dict[str, list[Any]], properties: _Properties) -> dict[str, Any]:
    joined = lambda parts: np.concatenate(parts) if len(parts) else np.empty(0)
    return {
        p: joined(rows[p])
        if length is None
        else (np.array([len(x) for x in rows[p]], dtype=np.int64), joined(rows[p]))
        for p, _, length in properties
    }


def _mesh(data: dict[str, dict[str, Any]]) -> Any:
    """(vertices, corners, sizes of the faces, uv or None, the uv of each corner)."""
    points = data["vertex"]
    V = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    face = data.get("face", {})
    lists = next((face[name] for name in _FACES if name in face), None)
    if not isinstance(lists, tuple):
        return V, np.empty(0, np.int64), np.empty(0, np.int64), None, None
    sizes, corner = lists[0], np.asarray(lists[1], dtype=np.int64)
    if len(sizes) and sizes.min() < 3:
        raise ValueError("a face of fewer than three vertices")
    names = next((pair for pair in _UV if set(pair) <= set(points)), None)
    if names is not None:
        uv = np.stack([points[name] for name in names], axis=1).astype(np.float64)
        return V, corner, sizes, uv, corner
    if not isinstance(face.get("texcoord"), tuple):
        return V, corner, sizes, None, None
    lengths, values = face["texcoord"]
    has = lengths == 2 * sizes  # the others have none
    values = np.asarray(values, dtype=np.float64)[np.repeat(has, lengths)].reshape(-1, 2)
    if not has.any():
        return V, corner, sizes, None, None
    uv, index = np.unique(values, axis=0, return_inverse=True)
    uv_corner = np.full(len(corner), -1)
    uv_corner[np.repeat(has, sizes)] = index.ravel()
    return V, corner, sizes, uv, uv_corner
