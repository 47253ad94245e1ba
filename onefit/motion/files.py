"""Motions from files: AMASS's and Neural Cloth Simulation's ``.npz``, and BVH
(:mod:`onefit.motion.bvh`).

SMPL's joint rotations are taken over as they are: SMPL's zero pose is OneFit's T-pose, and a joint
here is the joint of the same name there; only the axes are turned. With C from SMPL's body axes (y
up, facing +z) to OneFit's (z up, facing -y), a joint's rotation R becomes C R C^T. The root's leads
into the file's world: with W from that world's axes to OneFit's it becomes W R C^T, the translation
W t. AMASS's world has z up (W = 1), Neural Cloth Simulation's y up (W = C).
"""

import os

import numpy as np
from scipy.spatial.transform import Rotation

from polyfit.errors import InputError, as_number
from polyfit.files import as_path, read_npz

from . import likely
from .bvh import read_bvh
from .placing import placed, require_finite

_C = Rotation.from_euler("x", 90, degrees=True)  # from SMPL's body axes, or any world with y up
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate", "framerate")
_COUNTS = {22: 22, 24: 24, 52: 22, 55: 22}  # joints in a file, and how many of them are the body's


def read(path, fps=None, up=None):
    """``(poses (T, 24, 3) [rad], translation (T, 3) [m], fps, name)`` of a file, as
    :class:`onefit.Motion` takes them; see :meth:`onefit.Motion.read`.
    """
    path = as_path(path, "motion")
    if fps is not None and np.isnan(as_number(fps)):
        raise InputError(f"{path}: fps = {fps!r}; a number of frames a second is needed")
    name = os.path.splitext(os.path.basename(path))[0]
    if up not in (None, "y", "z"):
        raise InputError(f"up = {up!r}; y or z is needed")
    readers = {".npz": _read_npz, ".bvh": read_bvh}
    reader = readers.get(os.path.splitext(path)[1].lower())
    if reader is None:
        raise InputError(
            f"{path}: a motion is read from .npz (AMASS, Neural Cloth Simulation) or .bvh"
        )
    poses, translation, rate, other = reader(path, fps, up)
    poses, translation = likely.stood(path, poses, translation, rate, up, other)
    return *placed(poses, translation), float(rate), name


def _read_npz(path, fps, up):
    """(poses (T, 24, 3) [rad], translation (T, 3) [m], fps, what may be up instead)."""
    data = read_npz(path, ("poses", "trans", *_RATES), "a motion")
    for key in ("poses", "trans"):
        if key not in data:
            raise InputError(
                f"{path}: misses {key}; a motion file has poses, trans and a frame rate"
            )
    poses, trans = (_numbers(path, key, data[key]) for key in ("poses", "trans"))
    rate = next((key for key in _RATES if key in data), None)
    if fps is None:
        if rate is None:
            raise InputError(
                f"{path}: no frame rate ({', '.join(_RATES)}); give it: fps=30, or --fps 30"
            )
        try:
            fps = float(np.ravel(data[rate])[0])
        except (ValueError, TypeError, IndexError):
            raise InputError(f"{path}: {rate} is no number; give it: fps=30, or --fps 30") from None
    likely.check_rate(path, fps)
    if up is None:  # AMASS names its rate after its motion capture
        up = "z" if rate is None or rate.startswith("mocap") else "y"
    count = poses.shape[1] if poses.ndim == 3 else poses.shape[1] / 3 if poses.ndim == 2 else None
    if poses.ndim == 3 and count in _COUNTS and poses.shape[2] not in (3, 4):
        needed = f"axis-angle vectors (T, {count}, 3) are needed"
        raise InputError(f"{path}: poses of shape {poses.shape}; {needed}")
    if count not in _COUNTS or (poses.ndim == 3 and poses.shape[2] != 3):
        raise InputError(
            f"{path}: poses of shape {poses.shape}; axis-angle vectors of 22, 24 (SMPL), 52"
            " (SMPL-H) or 55 (SMPL-X) joints are needed"
        )
    if len(poses) == 0 or trans.shape != (len(poses), 3):
        raise InputError(
            f"{path}: {len(poses)} frames of poses and a translation of shape {trans.shape}"
        )
    require_finite(path, poses=poses, trans=trans)
    local = np.zeros((len(poses), 24, 3))
    body = _COUNTS[int(count)]
    local[:, :body] = poses.reshape(len(poses), -1, 3)[:, :body]
    likely.check_rotations(path, local)
    world = _C if up == "y" else Rotation.identity()
    root = world * Rotation.from_rotvec(local[:, 0]) * _C.inv()
    local = _C.apply(local.reshape(-1, 3)).reshape(local.shape)
    local[:, 0] = root.as_rotvec()
    other = ("z", world.apply([0.0, 0, 1])) if up == "y" else ("y", np.array([0.0, 1, 0]))
    return local, world.apply(trans), fps, other


def _numbers(path, key, array):
    """An array of a file as float64. Raises InputError where it holds no numbers."""
    array = np.asarray(array)  # bytes, where it is no array
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: {key} of type {array.dtype}; numbers are needed")
    return array.astype(np.float64)
