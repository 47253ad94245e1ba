"""Further cameras of the same moving surface: calibrated, and exposed with the first one."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass

import numpy as np

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError

from .sequence import Sequence

_CAMERA = "camera.json"
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
    folder: str, count: int, first: int = 0, last: int = -1, stride: int = 1
) -> list[OtherCamera]:
    """The cameras of a folder that holds a folder for each: ``camera.json`` (fx, fy, cx, cy, width,
    height [pixels], ``world_to_camera``), ``frames``, and ``masks`` where there are some. Of each
    the frames ``first`` to ``last`` in steps of ``stride`` are used, ``count`` in all. Raises
    InputError.
    """
    if not os.path.isdir(folder):
        raise InputError(f"cameras: {folder}: no such folder")
    names = sorted(
        name for name in os.listdir(folder) if os.path.isfile(os.path.join(folder, name, _CAMERA))
    )
    if not names:
        raise InputError(
            f"{folder}: no cameras in it; a folder for each, with {_CAMERA} and frames, is needed"
            " (polysft prepare --cameras makes them of a rig of COLMAP or nerfstudio)"
        )
    return [_open(os.path.join(folder, name), count, first, last, stride) for name in names]


def _open(folder, count, first, last, stride):
    where = os.path.join(folder, _CAMERA)
    intrinsics, pose = _read(where)
    masks = os.path.join(folder, "masks")
    sequence = Sequence.open(
        os.path.join(folder, "frames"),
        masks if os.path.isdir(masks) else "",
        first,
        last,
        stride,
        (intrinsics.width, intrinsics.height),
    )
    if len(sequence) != count:
        raise InputError(
            f"{folder}: {len(sequence)} frames, and the scene's camera has {count}; one for each of"
            " its frames is needed"
        )
    return OtherCamera(os.path.basename(folder), intrinsics, pose, sequence)


def _read(where):
    """(:class:`Intrinsics`, world_to_camera (4, 4)) of a camera's file."""
    try:
        with open(where, encoding="utf-8") as file:
            known = json.load(file)
        numbers = [float(known[name]) for name in ("fx", "fy", "cx", "cy")]
        size = [int(known[name]) for name in ("width", "height")]
        pose = np.array(known["world_to_camera"], dtype=np.float64)
    except KeyError as error:
        raise InputError(
            f"{where}: {error.args[0]} is missing; fx, fy, cx, cy, width, height and"
            " world_to_camera are needed"
        ) from None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{where}: not a camera as JSON ({error})") from None
    if np.any(known.get("distortion")):
        raise InputError(
            f"{where}: distortion; frames without are needed, as polysft prepare VIDEO --cameras"
            " makes them"
        )
    if pose.shape == (3, 4):
        pose = np.vstack([pose, (0, 0, 0, 1)])
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"{where}: world_to_camera is {pose.shape}; 3 x 4 or 4 x 4 is needed")
    turn = pose[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > _STRAIGHT or np.linalg.det(turn) < 0:
        raise InputError(f"{where}: world_to_camera is no rotation and translation")
    return Intrinsics(*numbers, *size), pose
