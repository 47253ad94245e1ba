"""Templates in (OBJ and PLY, in the file's own vertex order) and what a template must be;
:mod:`polyfit.mesh` reads and writes the files.

Texture coordinates are those of OBJ files: (0, 0) is the texture's bottom left, v goes up.
"""

import numpy as np

from polyfit import mesh
from polyfit.mesh import TexCoords, read_mesh, read_textured
from polysft_mi.errors import InputError

_UV_MARGIN = 0.02  # how far beyond the image texture coordinates may reach, the edge repeated


def read_template(path):
    """:func:`polyfit.read_mesh` of a template."""
    return read_mesh(path, what="template")


def read_textured_template(path):
    """:func:`polyfit.mesh.read_textured` of a template, as :func:`cleaned` leaves it."""
    vertices, faces, texcoords, _, _ = cleaned(*read_textured(path, what="template"))
    return vertices, faces, texcoords


def cleaned(vertices, faces, texcoords):
    """``(vertices, faces, texcoords, kept (F,), note)`` without faces that have no area and
    vertices in no face: which faces were kept, and what was left out, in words, or None. The others
    keep their order. ``texcoords``: :class:`polyfit.mesh.TexCoords` or None.
    """
    kept = np.ones(len(faces), dtype=bool)
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces, texcoords, kept, None  # :func:`check_template` says what is wrong
    used = vertices[np.unique(faces)]
    with np.errstate(invalid="ignore"):  # coordinates that are not finite
        kept = ~(mesh.areas(vertices, faces) <= 1e-12 * np.ptp(used, axis=0).max() ** 2)
    if not kept.any():
        return vertices, faces, texcoords, np.ones(len(faces), dtype=bool), None
    V, F = mesh.in_use(vertices, faces[kept])
    counts = (~kept).sum(), len(vertices) - len(V)
    if not any(counts):
        return vertices, faces, texcoords, kept, None
    if texcoords is not None:
        texcoords = TexCoords(texcoords.coordinates, texcoords.faces[kept])
    note = f"left out {counts[0]} faces without area and {counts[1]} vertices in no other face"
    return V, F, texcoords, kept, note


def write_obj(path, vertices, faces, uv):
    """Write a mesh as OBJ: vertices (N, 3), faces (F, 3), uv (N, 2) with v up, or
    :class:`polyfit.mesh.TexCoords`.
    """
    texcoords = uv if isinstance(uv, TexCoords) else TexCoords(uv, faces)
    with open(path, "w", encoding="utf-8") as file:
        file.writelines("v {:.9g} {:.9g} {:.9g}\n".format(*p) for p in vertices)
        file.writelines("vt {:.9g} {:.9g}\n".format(*t) for t in texcoords.coordinates)
        corners = np.stack([faces, texcoords.faces], axis=2).reshape(len(faces), 6) + 1
        file.writelines("f {}/{} {}/{} {}/{}\n".format(*f) for f in corners)


def uv_note(texcoords, where="template"):
    """A line about texture coordinates far outside the image, :class:`polyfit.mesh.TexCoords`; None
    where they lie within 0 to 1, but for a margin.
    """
    used = texcoords.coordinates[np.unique(texcoords.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    if (low >= -_UV_MARGIN).all() and (high <= 1 + _UV_MARGIN).all():
        return None
    spans = " and ".join(f"{a:.4g} to {b:.4g}" for a, b in zip(low, high))
    return (
        f"{where}: texture coordinates from {spans}; the image fills 0 to 1, and there are no"
        " other tiles (UDIM)"
    )


def check_template(vertices, faces, uv, where="template"):
    """Raise InputError, in one line that starts with ``where``, unless the mesh can be a template.

    ``uv``: a finite texture coordinate a vertex, (N, 2), or :class:`polyfit.mesh.TexCoords`. A
    template has at least three vertices, each of them in some face, as :func:`cleaned` leaves it.
    It may be open or closed, of several components, with seams, and wound in any way.
    """
    V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    if len(V) < 3:
        raise InputError(f"{where}: {len(V)} vertices; a template has at least 3")
    if len(F) == 0:
        raise InputError(f"{where}: no faces; a template is a triangle mesh")
    if F.min() < 0 or F.max() >= len(V):
        raise InputError(
            f"{where}: faces name vertices {F.min()} to {F.max()}; 0 to {len(V) - 1} exist"
        )
    _refuse(
        ~np.isfinite(V).all(axis=1),
        where,
        "vertices have coordinates that are not finite",
        "vertex",
    )
    _refuse(
        np.bincount(F.ravel(), minlength=len(V)) == 0, where, "vertices are in no face", "vertex"
    )
    if uv is None:
        raise InputError(
            f"{where}: no texture coordinates; without uv the texture cannot be placed on it"
        )
    if not isinstance(uv, TexCoords):
        uv = np.asarray(uv, dtype=np.float64)
        if uv.shape != (len(V), 2):
            raise InputError(
                f"{where}: texture coordinates of shape {uv.shape}; ({len(V)}, 2) is needed"
            )
        uv = TexCoords(uv, F)
    bare = (uv.faces < 0).any(axis=1)
    _refuse(bare, where, "faces have no texture coordinates, as others have", "face")
    bad = ~np.isfinite(uv.coordinates).all(axis=1)
    _refuse(bad, where, "texture coordinates are not finite", "coordinate")
    if not (mesh.areas(V, F) > 1e-12 * np.ptp(V, axis=0).max() ** 2).any():
        raise InputError(f"{where}: its faces have no area")


def _refuse(bad, where, what, element):
    if bad.any():
        raise InputError(
            f"{where}: {bad.sum()} {what} (the first is {element} {int(np.argmax(bad))}, counted"
            " from 0)"
        )
