"""Further cameras of the same moving surface: calibrated, and exposed with the first one."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from polysft_mi.camera import LARGEST, Intrinsics, check_pinhole
from polysft_mi.errors import InputError

from .sequence import Sequence

_CAMERA = "camera.json"
_HINT = " (polysft prepare --cameras makes one of a rig of COLMAP or nerfstudio)"
_STRAIGHT = 1e-3  # how far a rotation may be from one


@dataclass(frozen=True)
class OtherCamera:
    """A camera beside the scene's own: its ``name``, what it sees, and ``world_to_camera`` (4, 4),
    from the scene's world to its own frame (OpenCV's axes) [m].
    """

    name: str
    intrinsics: Intrinsics
    world_to_camera: np.ndarray
    sequence: Sequence

    def sensor(self):
        """Mitsuba's sensor. Import only after a variant is set."""
        import mitsuba as mi

        c = self.intrinsics
        # Mitsuba's camera frame has x to the left and y up
        to_world = np.linalg.inv(self.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        film = {
            "type": "hdrfilm",
            "width": c.width,
            "height": c.height,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        }
        focal = {name: getattr(c, name) for name in ("fx", "fy", "cx", "cy")}
        transform = mi.ScalarTransform4f(to_world)
        return mi.load_dict({"type": "pinhole", **focal, "to_world": transform, "film": film})


def open_cameras(
    folder: str,
    count: int | None,
    first: int = 0,
    last: int = -1,
    stride: int = 1,
    known: Mapping[str, tuple[Intrinsics, np.ndarray]] | None = None,
) -> list[OtherCamera]:
    """The cameras of a folder that holds a folder for each: ``camera.json`` (fx, fy, cx, cy, width,
    height [pixels], ``world_to_camera``), ``frames``, and ``masks`` where there are some. Of each
    the frames ``first`` to ``last`` in steps of ``stride`` are used, of ``count`` (None: of any
    number). ``known``: intrinsics and world_to_camera (4, 4) of those that need no ``camera.json``,
    by name. Raises InputError.
    """
    known = known or {}
    if not os.path.isdir(folder):
        raise InputError(f"cameras: {folder}: no such folder{_HINT}")
    names = sorted({*known, *camera_names(folder, known)})
    if not names:
        raise InputError(
            f"{folder}: no cameras in it; a folder for each, with {_CAMERA} and frames, is"
            f" needed{_HINT}"
        )
    return [
        _open(
            os.path.join(folder, name),
            known.get(name) or read_camera(os.path.join(folder, name, _CAMERA)),
            count,
            (first, last, stride),
        )
        for name in names
    ]


def camera_names(folder: str, known: Iterable[str] = ()) -> list[str]:
    """The names of the cameras in a folder, which are those of its folders but the ``known`` ones.
    Raises InputError where one of them has no ``camera.json``.
    """
    names = sorted(
        name
        for name in os.listdir(folder)
        if os.path.isdir(os.path.join(folder, name)) and not name.startswith(".")
    )
    names = [name for name in names if name not in known]
    for name in names:
        if not has_camera(folder, name):
            raise InputError(
                f"{os.path.join(folder, name)}: no {_CAMERA} in it; each folder in {folder} is a"
                f" camera's{_HINT}"
            )
    return names


def has_camera(folder: str, name: str) -> bool:
    """Whether the folder of cameras says how the camera ``name`` stands."""
    return os.path.isfile(os.path.join(folder, name, _CAMERA))


def read_cameras(path: str) -> dict[str, tuple[Intrinsics, np.ndarray]]:
    """Intrinsics and world_to_camera (4, 4) by name, of a file that :func:`written` is the content
    of. Raises InputError.
    """
    try:
        with open(path, encoding="utf-8-sig") as file:
            cameras = json.load(file)
        return {name: _camera(values, f"{path}: {name}") for name, values in cameras.items()}
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not cameras as JSON ({error})") from None


def written(intrinsics: Intrinsics, world_to_camera: np.ndarray) -> dict:
    """What ``camera.json`` says of a camera; ``world_to_camera`` (4, 4) [m]."""
    return {**asdict(intrinsics), "world_to_camera": world_to_camera.tolist()}


def _open(folder, camera, count, selected):
    intrinsics, pose = camera
    masks = os.path.join(folder, "masks")
    sequence = Sequence.open(
        os.path.join(folder, "frames"),
        masks if os.path.isdir(masks) else "",
        *selected,
        (intrinsics.width, intrinsics.height),
    )
    if count is not None and sequence.count != count:
        raise InputError(
            f"{folder}: {sequence.count} frames, and the scene's camera has {count}; one for each"
            " of its frames is needed"
        )
    return OtherCamera(os.path.basename(folder), intrinsics, pose, sequence)


def read_camera(where: str) -> tuple[Intrinsics, np.ndarray]:
    """Intrinsics and world_to_camera (4, 4) [m] of a camera's file, as :func:`written` makes it.
    Raises InputError.
    """
    try:
        with open(where, encoding="utf-8-sig") as file:
            known = json.load(file)
    except (OSError, ValueError) as error:
        raise InputError(f"{where}: not a camera as JSON ({error})") from None
    return _camera(known, where)


def _camera(known, where):
    """:func:`read_camera` of what the file holds."""
    try:
        numbers = [float(known[name]) for name in ("fx", "fy", "cx", "cy")]
        size = [int(known[name]) for name in ("width", "height")]
        pose = known["world_to_camera"]
    except KeyError as error:
        raise InputError(
            f"{where}: {error.args[0]} is missing; fx, fy, cx, cy, width, height and"
            " world_to_camera are needed"
        ) from None
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where}: not a camera as JSON ({error})") from None
    try:
        check_pinhole(known)
        intrinsics = Intrinsics(*numbers, *size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return intrinsics, rigid_pose(pose, f"{where}: world_to_camera")


def rigid_pose(values: Any, where: str) -> np.ndarray:
    """A rotation and translation, (4, 4) float64, of lists, 3 x 4 or 4 x 4. Raises InputError,
    which begins with ``where``, for anything else.
    """
    try:
        pose = np.array(values, dtype=np.float64)
        usable = pose.ndim > 0 and (np.abs(pose) <= LARGEST).all()
    except (TypeError, ValueError, OverflowError):
        usable = False
    if not usable:
        raise InputError(
            f"{where} is no matrix of 4 x 4, or 3 x 4, finite numbers, none beyond {LARGEST:g}"
        )
    if pose.shape == (3, 4):
        pose = np.vstack([pose, (0, 0, 0, 1)])
    if pose.shape != (4, 4):
        raise InputError(f"{where} is {pose.shape}; 3 x 4 or 4 x 4 is needed")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(f"{where}: its last row is {pose[3].tolist()}; 0, 0, 0, 1 is needed")
    turn = pose[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > _STRAIGHT or np.linalg.det(turn) < 0:
        raise InputError(f"{where} is no rotation and translation")
    return pose
