"""A moving mesh as a folder with one OBJ or PLY file a frame."""

import json
import os

import numpy as np

from polyfit.errors import InputError, number
from polyfit.files import folder_aside
from polyfit.mesh import write_ply

from .moving import check_up, checked, encoded

_ABOUT = "frames.json"


def write_frames(folder, kind, vertices, faces, uv=None, texture=None, *, labels=None, up="y"):
    """Write one mesh a frame into a new or empty ``folder``: ``kind`` "obj", with a material file
    and the texture, or "ply", with uv as ``s``, ``t``, its vertices split along seams; and
    frames.json, which says what they are.

    ``labels`` (T,): the frames' numbers in the file names, by default 0 to T - 1. A folder that
    this function wrote is replaced, if nothing was added to it.
    """
    vertices, faces, uv = checked(vertices, faces, uv, 1)
    check_up(up)
    labels = range(len(vertices)) if labels is None else labels
    labels = [number("animation: label", k, 0, whole=True) for k in labels]
    if kind not in ("obj", "ply"):
        raise InputError(f"animation: kind = {kind!r}; obj or ply is needed")
    if not len(labels) == len(set(labels)) == len(vertices):
        raise InputError(f"animation: {len(vertices)} labels, each another number, are needed")
    ours = lambda name: (
        name in (_ABOUT, "surface.mtl", "texture.png", "texture.jpg")
        or (name.endswith(f".{kind}") and name[: -len(kind) - 1].isdigit())
    )
    data, image = (
        encoded(texture)
        if kind == "obj" and texture is not None and uv is not None
        else (None, None)
    )
    source = np.arange(vertices.shape[1])
    if kind == "ply" and uv is not None:
        source, uv, faces = uv.split(faces)
        uv = np.nan_to_num(uv)
    with folder_aside(folder, ours, _ABOUT) as place:
        with open(os.path.join(place, _ABOUT), "w", encoding="ascii") as file:
            json.dump({"up": up, "unit": "metre", "frames": labels}, file)
        if data:
            with open(os.path.join(place, f"texture.{image}"), "wb") as file:
                file.write(data)
        if kind == "obj":
            with open(os.path.join(place, "surface.mtl"), "w", encoding="ascii") as file:
                file.write(
                    "newmtl surface\nKd 1 1 1\nKs 0 0 0\nillum 1\n"
                    + (f"map_Kd texture.{image}\n" if data else "")
                )
        for label, V in zip(labels, vertices):
            name = os.path.join(place, f"{label:03d}.{kind}")
            if kind == "ply":
                write_ply(name, V[source], faces, uv)
            else:
                _write_obj(name, V, faces, uv, up)


def _write_obj(path, V, F, uv, up):
    corner, corners = ("{}/{}" if uv is not None else "{}").format, F if uv is None else uv.faces
    with open(path, "w", encoding="ascii") as file:
        file.write(f"# metres, {up} up\nmtllib surface.mtl\no surface\n")
        file.writelines("v {:.9g} {:.9g} {:.9g}\n".format(*p) for p in V.tolist())
        if uv is not None:
            file.writelines("vt {:.9g} {:.9g}\n".format(*t) for t in uv.coordinates.tolist())
        file.write("usemtl surface\ns 1\n")
        file.writelines(
            "f " + " ".join(corner(k + 1, t + 1) for k, t in zip(face, at)) + "\n"
            for face, at in zip(F.tolist(), corners.tolist())
        )
