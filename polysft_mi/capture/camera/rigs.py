"""Rigs of calibrated cameras as other programs write them, recognised by what is in them.

nerfstudio's and instant-ngp's ``transforms.json``, whose cameras look along -z; COLMAP's sparse
models, as text or binary; and a folder of cameras of ours.
"""

import json
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from polysft_mi.errors import InputError
from polysft_mi.scene import camera_names, rigid_pose

from .files import colmap_camera, nerfstudio_camera, own_camera
from .lens import Lens

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z back, to x right, y down, z forward
_FORMS = (
    "nerfstudio's transforms.json, the folder of a sparse model of COLMAP (cameras, images as .txt"
    " or .bin), or a folder of cameras with camera.json"
)
# COLMAP's models by their numbers in binary files: name, how many parameters
_MODELS = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
]


@dataclass(frozen=True)
class View:
    """An image of a rig: its ``name``, as the rig says it; ``world_to_camera`` (4, 4) [units of the
    rig, OpenCV's axes]; ``lens`` of frames of a (width, height); ``mask``: a name likewise, or
    None.
    """

    name: str
    world_to_camera: np.ndarray
    lens: Callable[[int, int], Lens]
    mask: str | None = None


@dataclass(frozen=True)
class Rig:
    """``views``; ``places``: the folders that their names may count from; ``unit``: what a length
    of the file is multiplied by for one of the rig; ``ours``: whether its world is the scene's.
    """

    views: list
    places: list
    unit: float = 1.0
    ours: bool = False


def read_rig(path):
    """The :class:`Rig` of a file or a folder. Raises InputError."""
    path = os.path.normpath(path)
    if os.path.isfile(path):
        if path.endswith(".json"):
            return _nerfstudio(path)
        path = os.path.dirname(path) or "."  # one of a model's files
    if not os.path.isdir(path):
        raise InputError(f"{path}: no such rig; {_FORMS} is needed")
    if os.path.isfile(transforms := os.path.join(path, "transforms.json")):
        return _nerfstudio(transforms)
    for model in (path, *(os.path.join(path, *names) for names in (("sparse",), ("sparse", "0")))):
        for read, ending in ((_colmap_binary, ".bin"), (_colmap_text, ".txt")):
            files = [os.path.join(model, name + ending) for name in ("cameras", "images")]
            if all(map(os.path.isfile, files)):
                return _colmap(model, *read(*files))
    if not any(os.path.isfile(os.path.join(path, n, "camera.json")) for n in os.listdir(path)):
        raise InputError(f"{path}: not a rig in a known form; the known forms are: {_FORMS}")
    return Rig([_own(path, name) for name in camera_names(path)], [path], ours=True)


def _own(folder, name):
    where = os.path.join(folder, name, "camera.json")
    values = _json(where)
    if "world_to_camera" not in values:
        raise InputError(f"{where}: world_to_camera is missing")
    pose = rigid_pose(values["world_to_camera"], f"{where}: world_to_camera")
    masks = os.path.join(name, "masks")
    masks = masks if os.path.isdir(os.path.join(folder, masks)) else None
    read = lambda width, height: own_camera(values)
    return View(os.path.join(name, "frames"), pose, _lens(where, read), masks)


def _nerfstudio(path):
    values = _json(path)
    frames = values.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: no frames; a rig has one for each camera, with its pose")
    views = []
    for k, frame in enumerate(frames):
        where = f"{path}: frames[{k}]"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{where}: file_path is missing")
        where = f"{path}: {frame['file_path']}"
        to_world = rigid_pose(frame.get("transform_matrix"), f"{where}: transform_matrix") @ _OPENGL
        own = {**values, **frame}
        read = lambda width, height, own=own: nerfstudio_camera(own, (width, height))
        pose = _inverse(to_world)
        views.append(View(frame["file_path"], pose, _lens(where, read), frame.get("mask_path")))
    scale = values.get("applied_scale", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0 < scale < np.inf:
        raise InputError(f"{path}: applied_scale = {scale!r}; a positive number is needed")
    return Rig(views, [os.path.dirname(path) or "."], 1 / scale)


def _colmap(model, cameras, images):
    views = []
    for quaternion, shift, camera, name in images:
        where = f"{model}: {name}"
        if camera not in cameras:
            raise InputError(f"{where}: its camera {camera} is not among the model's")
        turn = np.roll(quaternion, -1)  # SciPy's order is x, y, z, w
        if not np.isfinite([*turn, *shift]).all() or not np.linalg.norm(turn) > 0:
            raise InputError(f"{where}: its pose is not finite")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(turn).as_matrix(), shift
        read = lambda width, height, camera=camera: colmap_camera(*cameras[camera])
        views.append(View(name, pose, _lens(where, read)))
    if not views:
        raise InputError(f"{model}: a model without images")
    above = [os.path.normpath(os.path.join(model, *[os.pardir] * k)) for k in range(3)]
    return Rig(views, [os.path.join(a, b) for a in above for b in ("images", "")])


def _colmap_text(cameras, images):
    """({id: (model, words)}, [(quaternion w, x, y, z; translation, camera's id, name)])."""
    known, found, lines = {}, [], iter(_lines(images))
    try:
        for line in _lines(cameras):
            if line.strip():
                number, model, *words = line.split()
                known[int(number)] = model, words
    except ValueError:
        raise InputError(f"{cameras}: {line.strip()}: not a line of a camera") from None
    for line in lines:
        if line.strip():
            words = line.split(maxsplit=9)
            try:
                pose = np.array([float(word) for word in words[1:8]])
                found.append((pose[:4], pose[4:], int(words[8]), words[9].strip()))
            except (ValueError, IndexError):
                raise InputError(f"{images}: {line.strip()[:80]}: not a line of an image") from None
            next(lines, None)  # the line of its points, which may be empty
    return known, found


def _lines(path):
    try:
        with open(path, encoding="utf-8") as file:
            return [line for line in file if not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not readable ({error})") from None


def _colmap_binary(cameras, images):
    """As :func:`_colmap_text`."""
    known, found = {}, []
    with open(cameras, "rb") as file:
        data = _Binary(cameras, file.read())
    for _ in range(*data.take("Q")):
        number, model, width, height = data.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"{cameras}: camera model {model}, which is not known")
        name, count = _MODELS[model]
        known[number] = name, [width, height, *data.take(f"{count}d")]
    with open(images, "rb") as file:
        data = _Binary(images, file.read())
    for _ in range(*data.take("Q")):
        _, *pose, camera = data.take("i7di")
        name = data.text()
        (points,) = data.take("Q")
        data.skip(24 * points)
        found.append((np.array(pose[:4]), np.array(pose[4:]), camera, name))
    return known, found


class _Binary:
    """Numbers, little endian, one after the other."""

    def __init__(self, path, data):
        self._path, self._data, self._at = path, data, 0

    def take(self, form):
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self._data, self._at - size)

    def skip(self, size):
        self._at += size
        if self._at > len(self._data):
            raise InputError(f"{self._path}: breaks off; not a whole file of a model of COLMAP")

    def text(self):
        end = self._data.find(b"\0", self._at)
        start, size = self._at, (len(self._data) if end < 0 else end) - self._at
        self.skip(size + 1)
        return self._data[start : start + size].decode("utf-8", "replace")


def _lens(where, read):
    """A function of a size (width, height) that gives the :class:`Lens` for it."""

    def lens(width, height):
        try:
            camera, distortion = read(width, height)
            return Lens(camera, tuple(distortion), where).resized(width, height)
        except InputError as error:
            text = str(error)
            raise InputError(text if text.startswith(where) else f"{where}: {text}") from None

    return lens


def _json(path):
    try:
        with open(path, encoding="utf-8-sig") as file:
            values = json.load(file)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: not a JSON object")
    return values


def _inverse(pose):
    """The inverse of a rotation and translation (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out
