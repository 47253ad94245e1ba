"""OBJ files, in the file's own order of vertices and faces."""

from collections.abc import Iterator

import numpy as np

from polyfit.errors import InputError
from polyfit.files import text_encoding

from .polygons import triangulated
from .texcoords import TexCoords


def read_obj(path: str) -> tuple[np.ndarray, np.ndarray, TexCoords | None]:
    """``(vertices (N, 3) float64, faces (F, 3) int64, texcoords or None)``; corners without a
    texture coordinate have -1.

    Keywords may be upper case, lines continued by ``\\``, comments stand behind them, and the text
    be UTF-8, UTF-16 or UTF-32, with a byte order mark or none. Raises InputError in one line.
    """
    vertices: list[tuple[float, float, float]] = []
    coordinates: list[tuple[float, float]] = []
    corners: list[tuple[int, int]] = []
    sizes: list[int] = []
    number, words = 0, [""]
    try:
        for number, words in _lines(path):  # noqa: B007 (named in an error below)
            if words[0] == "v":
                x, y, z = words[1:4]
                vertices.append((float(x), float(y), float(z)))
            elif words[0] == "vt":
                coordinates.append((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
            else:
                if len(words) < 4:
                    raise ValueError("a face of fewer than three vertices")
                counts = len(vertices), len(coordinates)
                corners.extend(_corner(word, *counts) for word in words[1:])
                sizes.append(len(words) - 1)
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: line {number}: '{' '.join(words)[:60]}' is not OBJ ({error})"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    V = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    VT = np.array(coordinates, dtype=np.float64).reshape(-1, 2)
    v, t = np.array(corners, dtype=np.int64).reshape(-1, 2).T
    for what, index, count in (("vertices", v, len(V)), ("texture coordinates", t, len(VT))):
        if index.size and index.max() >= count:
            raise InputError(f"{path}: a face names number {index.max() + 1} of {count} {what}")
    triangles = triangulated(V, v, np.array(sizes, dtype=np.int64))
    return V, v[triangles], TexCoords(VT, t[triangles]) if t.size and t.max() >= 0 else None


def _lines(path: str) -> Iterator[tuple[int, list[str]]]:
    """(number, words) of the lines that are read: vertices, texture coordinates, faces; the keyword
    in lower case.
    """
    with open(path, encoding=text_encoding(path), errors="replace") as file:
        numbered = enumerate(file, start=1)
        for number, line in numbered:
            words = line.partition("#")[0].split()
            if not words or words[0].lower() not in ("v", "vt", "f"):
                continue
            while words[-1].endswith("\\"):
                words[-1] = words[-1][:-1]
                more = next(numbered, (number, ""))[1].partition("#")[0].split()
                words = [word for word in words if word] + more
            yield number, [words[0].lower(), *words[1:]]


def _corner(word: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """(vertex, texture coordinate or -1) of ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, counted from
    0.
    """
    v, t = (word.split("/") + [""])[:2]
    return _from_zero(int(v), vertices), _from_zero(int(t), coordinates) if t else -1


def _from_zero(index: int, count: int) -> int:
    """An OBJ file's index, counted from 1 or backwards from the ``count``-th, counted from 0."""
    if index == 0 or not -count <= index < 2**31:
        raise ValueError(f"index {index}")
    return index - 1 if index > 0 else count + index
