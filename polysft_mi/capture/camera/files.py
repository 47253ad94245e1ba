"""Camera files in the forms that people have, recognised by what is in them.

Ours (JSON), OpenCV's FileStorage (YAML, XML or JSON), COLMAP's ``cameras.txt`` and nerfstudio's
``transforms.json``. COLMAP and nerfstudio count pixels as we do: (0.5, 0.5) is the centre of the
first one. OpenCV counts from that centre; half a pixel is added to its principal point.
"""

import json
import math

import cv2
import numpy as np

from polyfit.files import silent_decoders
from polysft_mi.camera import LARGEST, Intrinsics, check_pinhole
from polysft_mi.errors import InputError

from .lens import Lens


def read_lens(path, width, height):
    """The :class:`Lens` of a camera file, for frames of this size [pixels]. Raises InputError."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            text = file.read()
    except OSError as error:
        raise InputError(
            f"{path}: {'no such file' if isinstance(error, FileNotFoundError) else error.strerror};"
            f" a camera file is needed: {_FORMS}"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; a camera file is needed: {_FORMS}") from None
    try:
        camera, distortion = _parsed(text, (width, height))
        lens = Lens(camera, tuple(distortion), str(path))
    except InputError as error:
        message = str(error)
        raise InputError(
            message if message.startswith(str(path)) else f"{path}: {message}"
        ) from None
    return lens.resized(width, height)


_FORMS = (
    "JSON with fx, fy, cx, cy, width, height; OpenCV's YAML or XML; COLMAP's cameras.txt; or"
    " nerfstudio's transforms.json"
)


def _parsed(text, size):
    """(Intrinsics, distortion) of a camera file's text; ``size`` of the frames, where the file has
    none.
    """
    start = text.lstrip()
    if start.startswith(("%YAML", "<?xml", "<opencv_storage")):
        return _opencv(text, size)
    if start.startswith("{"):
        try:
            values = json.loads(text)
        except json.JSONDecodeError as error:
            raise InputError(f"not JSON ({error})") from None
        if any(K in values for K, _ in _OPENCV):
            return _opencv(text, size)
        if any(key in values for key in ("fl_x", "camera_angle_x", "frames")):
            return nerfstudio_camera(values, size)
        return own_camera(values)
    lines = [x.split() for x in text.splitlines() if x.strip() and not x.lstrip().startswith("#")]
    if lines and all(len(x) > 4 and x[0].isdigit() and x[1].isupper() for x in lines):
        return _colmap(lines)
    raise InputError(f"not a camera file in a known form; the known forms are: {_FORMS}")


def _numbers(values, names, default=None):
    """The numbers of these names in a mapping. Raises InputError where one is missing, or none."""
    found = []
    for name in names:
        value = values.get(name, default)
        if value is None:
            raise InputError(f"{name} is missing; {', '.join(names)} are needed")
        known = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (known and abs(value) <= LARGEST):
            raise InputError(f"{name} = {value!r:.40}; a number, at most {LARGEST:g}, is needed")
        found.append(float(value))
    return found


def own_camera(values):
    """(Intrinsics, distortion) of a camera file of ours. Raises InputError."""
    check_pinhole(values, distortion=True)
    *pinhole, width, height = _numbers(values, ("fx", "fy", "cx", "cy", "width", "height"))
    distortion = values.get("distortion") or []
    try:
        distortion = [float(x) for x in distortion]
    except (TypeError, ValueError):
        raise InputError(
            f"distortion = {distortion!r}; a list of 4, 5, 8, 12 or 14 numbers, in OpenCV's order,"
            " is needed"
        ) from None
    return Intrinsics(*pinhole, int(width), int(height)), distortion


# what calibrations by OpenCV call their matrix and their distortion
_OPENCV = (
    ("camera_matrix", "distortion_coefficients"),
    ("cameraMatrix", "distCoeffs"),
    ("Camera_Matrix", "Distortion_Coefficients"),
    ("mtx", "dist"),
)


def _opencv(text, size):
    """A file as OpenCV's calibration program writes it."""
    with silent_decoders():
        try:
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            there = set(storage.root().keys())
            named = next((names for names in _OPENCV if names[0] in there), _OPENCV[0])
            K, distortion = (storage.getNode(name).mat() for name in named)
            nodes = [storage.getNode(name) for name in ("image_width", "image_height")]
            sizes = [int(n.real()) if n.isInt() else k for n, k in zip(nodes, size)]
        except (cv2.error, SystemError) as error:
            reason = " ".join(str(getattr(error, "err", None) or "unreadable").split())
            raise InputError(f"not a file of OpenCV's FileStorage ({reason})") from None
    if K is None:
        raise InputError(
            f"no matrix {' or '.join(K for K, _ in _OPENCV)}; it has {', '.join(sorted(there))}"
        )
    c = Intrinsics.from_matrix(K, *sizes, where=named[0])
    camera = Intrinsics(c.fx, c.fy, c.cx + 0.5, c.cy + 0.5, c.width, c.height)
    return camera, [] if distortion is None else np.ravel(distortion).astype(float).tolist()


def _colmap(lines):
    """Lines of CAMERA_ID, MODEL, WIDTH, HEIGHT, parameters."""
    if len({tuple(line[1:]) for line in lines}) > 1:
        raise InputError(
            f"{len(lines)} cameras that differ; keep the line of the one that took the frames"
        )
    return colmap_camera(lines[0][1], lines[0][2:])


def colmap_camera(model, words):
    """(Intrinsics, distortion) of a camera of COLMAP: the name of its model; width, height, and the
    model's parameters, as words or numbers. Raises InputError.
    """
    parameters = {
        "SIMPLE_PINHOLE": "f cx cy",
        "PINHOLE": "fx fy cx cy",
        "SIMPLE_RADIAL": "f cx cy k1",
        "RADIAL": "f cx cy k1 k2",
        "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    }
    if model not in parameters:
        raise InputError(f"camera model {model}; {', '.join(parameters)} can be used")
    names = parameters[model].split()
    try:
        values = [float(word) for word in words]
        width, height = int(words[0]), int(words[1])
    except ValueError:
        raise InputError(
            f"{model} {' '.join(map(str, words))}: a word that is not a number"
        ) from None
    if len(values) != len(names) + 2:
        raise InputError(
            f"{len(values) - 2} parameters of the model {model}; {', '.join(names)} are needed"
        )
    named = dict(zip(names, values[2:]))
    focal = named.get("f")
    camera = Intrinsics(
        named.get("fx", focal), named.get("fy", focal), named["cx"], named["cy"], width, height
    )
    distortion = [named.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")]
    return camera, distortion if any(distortion) else []


def nerfstudio_camera(values, size):
    """(Intrinsics, distortion) of ``transforms.json``, or of one of its frames; ``size`` of the
    frames, where it has none. Raises InputError.
    """
    model = values.get("camera_model", "OPENCV")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE") or values.get("is_fisheye"):
        raise InputError(
            f"camera_model {'OPENCV_FISHEYE' if values.get('is_fisheye') else model}; OPENCV and"
            " PINHOLE can be used"
        )
    width, height = (
        int(_numbers(values, (name,), default)[0]) for name, default in zip("wh", size)
    )
    cx, cy = (_numbers(values, (n,), side / 2)[0] for n, side in zip(("cx", "cy"), (width, height)))
    if "fl_x" in values:
        fx = _numbers(values, ("fl_x",))[0]
        fy = _numbers(values, ("fl_y",), fx)[0]
    elif "camera_angle_x" in values:
        angle = _numbers(values, ("camera_angle_x",))[0]
        if not 0 < angle < math.pi:
            raise InputError(f"camera_angle_x = {angle:g}; 0 to pi radians can be used")
        fx = fy = width / (2 * math.tan(angle / 2))
    else:
        raise InputError("no fl_x and no camera_angle_x for all frames; one of them is needed")
    k1, k2, k3, k4, p1, p2 = _numbers(values, ("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    if k4:
        raise InputError(f"k4 = {k4:g}; k1, k2, k3, p1 and p2 can be used")
    distortion = [k1, k2, p1, p2] + ([k3] if k3 else [])
    return Intrinsics(fx, fy, cx, cy, width, height), distortion if any(distortion) else []
