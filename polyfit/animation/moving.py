"""What all writers of a moving mesh need: axes, normals, checks, and the texture's image.

Shapes and units are those of :mod:`polyfit.animation`.
"""

import io

import numpy as np

from polyfit.errors import InputError, as_number
from polyfit.files import silent_decoders
from polyfit.mesh import TexCoords, as_arrays, vertex_normals

# Rotations from OpenCV's camera axes to axes with y or z up
AXES_FROM_CAMERA = {
    "y": np.diag([1.0, -1.0, -1.0]),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}


def from_camera(points, up="y"):
    """Points (..., 3) of an OpenCV camera frame (x right, y down, z forward) in a frame with y up,
    (x, -y, -z), or with z up, (x, z, -y).

    Both are rotations about x: nothing is mirrored. The camera stays at the origin; with y up it
    looks along -z, as the cameras of glTF and USD do.
    """
    check_up(up)
    return np.asarray(points) @ AXES_FROM_CAMERA[up].T.astype(np.asarray(points).dtype)


def check_up(up):
    """Raises InputError where ``up`` is neither "y" nor "z"."""
    if up not in AXES_FROM_CAMERA:
        raise InputError(f"animation: up = {up!r}; y or z is needed")


def normals(vertices, faces):
    """Unit normals (T, N, 3) of the vertices, each the mean of its faces' normals by area; zero
    where there is none.
    """
    V = np.asarray(vertices, np.float64)
    return np.array([vertex_normals(v, faces) for v in V], np.float32).reshape(V.shape)


def checked(vertices, faces, uv, fps):
    """(V, F, :class:`polyfit.mesh.TexCoords` or None): the arguments of a writer, in their types.
    Raises InputError.
    """
    V = np.asarray(vertices, np.float32)
    if V.ndim != 3 or V.shape[2] != 3 or not V.size or not np.size(faces):
        raise InputError(
            f"animation: vertices {V.shape}, faces {np.shape(faces)}; (T, N, 3) and (F, 3), neither"
            " empty, are needed"
        )
    _, F = as_arrays(V[0], faces, "animation")
    if not np.isfinite(V).all():
        raise InputError("animation: positions that are not finite")
    if not 0 < as_number(fps) < np.inf:
        raise InputError(f"animation: {fps} frames a second; a positive number is needed")
    if uv is not None:
        if not isinstance(uv, TexCoords):
            uv = np.asarray(uv, np.float32)
            if uv.shape != (V.shape[1], 2):
                raise InputError(f"animation: uv {uv.shape}; ({V.shape[1]}, 2) is needed")
            uv = TexCoords(uv, F)
        uv.check(len(F), "animation")
        coordinates = np.nan_to_num(np.asarray(uv.coordinates, np.float32))
        bare = uv.faces < 0  # corners without a coordinate take (0, 0)
        if bare.any():
            coordinates = np.concatenate([coordinates, np.zeros((1, 2), np.float32)])
        uv = TexCoords(coordinates, np.where(bare, len(coordinates) - 1, uv.faces))
    return V, F, uv


def encoded(texture):
    """``(bytes, extension)`` of an image file as PNG or JPEG, which is what USD and glTF take: as
    it is where it is one, else as PNG.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with silent_decoders(), Image.open(texture) as image:
            image.load()  # the whole file, which may be cut off
            if image.format in ("PNG", "JPEG"):
                with open(texture, "rb") as file:
                    return file.read(), {"PNG": "png", "JPEG": "jpg"}[image.format]
            data = io.BytesIO()
            image.convert("RGB").save(data, "PNG")
            return data.getvalue(), "png"
    except FileNotFoundError:
        raise InputError(f"{texture}: no such file; the image of the texture is needed") from None
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise InputError(
            f"{texture}: not an image that can be embedded ({error}); PNG, JPEG, TIFF, BMP or WebP"
            " is needed"
        ) from None
