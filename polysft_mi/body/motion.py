"""A body's motion, as a pose estimator or a 4D scanner gives it. Needs no Mitsuba."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from polyfit.files import NOT_NPZ
from polyfit.mesh import read_mesh
from polysft_mi.errors import InputError

_JOINTS = 24
_SMPL_JOINTS = (22, 24, 52, 55)
_POSES = "poses", "pose", "pose_world"
_PLACES = "translation", "trans", "transl", "trans_world"
_MESHES = ".obj", ".ply", ".glb"
_RATES = "fps", "mocap_framerate", "mocap_frame_rate"
_USUAL_FPS = 30.0
_SHAPE = "gender, age, muscle, weight, height, proportions"  # of Anny's body, from 0 to 1
_BETAS = 10  # of SMPL's, that a body has
_ROOT = 0.0, 0.0, 0.9  # [m] about where a body of ours at rest has its root
_SIZES = 0.4, 3.0  # [m] of a body's longest side
_TO_Z = {"z": 0, "y": 90, "-y": -90}  # degrees about x that turn what is up to z
_UPRIGHT = 0.5  # least cosine of the angle from a standing body to what is up


def _up_of(up):
    """The turn from a world with ``up`` to one whose z is up."""
    return Rotation.from_euler("x", _TO_Z[up], degrees=True)


class _World:
    """Whose world has ``up`` for the axis that is: z, y or -y."""

    up: str

    @property
    def upright(self) -> Rotation:
        """Turns the scene's world to one whose z is up."""
        return _up_of(self.up)


@dataclass(frozen=True)
class BodyMotion(_World):
    """A body in T frames: ``poses`` (T, 24, 3) [rad] and ``translation`` (T, 3) [m] in the scene's
    world, as :class:`onefit.Motion` has them; ``fps`` frames a second; ``shape`` (S,) of Anny's
    body, or None for the standard one. ``up``: the scene's axis that is: z, y or -y. ``model``: the
    file of a body of SMPL's family, whose are the ``shape`` (betas) and the ``translation``, which
    then leads from its root at rest; or empty. ``path``: where it was read.
    """

    poses: np.ndarray
    translation: np.ndarray
    fps: float
    shape: np.ndarray | None = None
    up: str = "z"
    model: str = ""
    path: str = "body"

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        count: int,
        selected: list[int],
        model: str = "",
        up: str = "z",
    ) -> BodyMotion:
        """The motion of an ``.npz`` file: ``poses`` (T, 24, 3) or (T, 72), ``translation`` (T, 3),
        and, where it has them, ``fps`` and ``shape``. With a ``model`` of SMPL's family, as
        programs write its motions: ``poses``, of 22, 24, 52 or 55 joints, or ``global_orient`` and
        ``body_pose``; ``trans``; ``betas``. ``up``: the scene's axis that is, z, y or -y.

        T is the number of all ``count`` images, or of those that are ``selected``. Raises
        InputError.
        """
        path = os.fspath(path)
        arrays = _read(path)
        poses, places = _found(arrays, _POSES), _found(arrays, _PLACES)
        orient, of_body = (arrays.get(name) for name in ("global_orient", "body_pose"))
        if model and poses is None and orient is not None and of_body is not None:
            if orient.ndim < 2 or len(orient) != len(of_body):
                raise InputError(
                    f"{path}: global_orient {orient.shape} and body_pose {of_body.shape}; a row of"
                    " each for each frame is needed"
                )
            poses = np.concatenate([x.reshape(len(x), -1) for x in (orient, of_body)], 1)
        joints = _SMPL_JOINTS if model else (_JOINTS,)
        needed = f"poses (T, {' or '.join(map(str, joints))}, 3) and translation (T, 3) are needed"
        if "betas" in arrays and not model:
            raise InputError(
                f"{path}: has betas, so its poses are SMPL's; give its body's file too"
                " (--body-model, or -D body_model=)"
            )
        if poses is None or places is None:
            raise InputError(
                f"{path}: no {'poses' if poses is None else 'translation'}; {needed}, and the file"
                f" has {', '.join(sorted(arrays)) or 'nothing'}"
            )
        if poses.ndim == 2 and poses.shape[1] in [3 * n for n in joints]:
            poses = poses.reshape(len(poses), -1, 3)
        fits = poses.ndim == 3 and poses.shape[1] in joints and poses.shape[2] == 3
        if not fits or places.shape != (len(poses), 3):
            raise InputError(
                f"{path}: poses {poses.shape} and translation {places.shape}; {needed}"
            )
        numbers = poses.dtype.kind in "fiu" and places.dtype.kind in "fiu"
        if not numbers or not (np.isfinite(poses).all() and np.isfinite(places).all()):
            raise InputError(f"{path}: poses and translation must be finite numbers")
        longest = np.linalg.norm(poses, axis=2).max()
        if longest > 1.001 * 2 * np.pi:
            raise InputError(
                f"{path}: a rotation vector of length {longest:.3g}; radians below 2π are needed:"
                " in degrees? then multiply poses by π/180"
            )
        frames = _of_video(path, len(poses), "poses", count, selected)
        fps = _rate(path, arrays, count, selected)
        poses, places = poses[frames].astype(float), places[frames].astype(float)
        shape = arrays.get("shape")
        if shape is not None and not model:
            fits = shape.shape == (_SHAPE.count(",") + 1,) and shape.dtype.kind in "fiu"
            if not (fits and ((shape >= 0) & (shape <= 1)).all()):
                said = shape.tolist() if fits else shape.shape
                raise InputError(f"{path}: shape {said}; {_SHAPE} are needed, each from 0 to 1")
        if model:
            poses, shape = _in_our_axes(poses), _betas(arrays.get("betas"), path)
        return cls(poses, places, fps, shape, up, model, path)

    @property
    def place(self) -> np.ndarray:
        """About where its middle is in the first frame (3,) [m, world]."""
        return self.translation[0] + (0 if self.model else np.array(_ROOT))

    @property
    def note(self) -> str:
        """A line about what is not used of it, or of a body that does not stand, or ""."""
        said = []
        if self.model and self.shape is not None and np.any(self.shape[_BETAS:]):
            said.append(f"{len(self.shape)} betas; the first {_BETAS} of them count")
        spine = Rotation.from_rotvec(self.poses[:, 0]).apply((0, 0, 1))  # towards the head
        upright = {up: np.median(_up_of(up).apply(spine)[:, 2]) for up in _TO_Z}
        best = max(upright, key=lambda up: upright[up])
        if upright[self.up] < _UPRIGHT < upright[best]:
            said.append(
                f"with {self.up} up the body lies or leans most of the time; --body-up {best} (or"
                f" body_up = {best}) lets it stand"
            )
        return f"note: {self.path}: {'; '.join(said)}" if said else ""


@dataclass(frozen=True)
class MeshMotion(_World):
    """A body that is known as a mesh alone: ``rest`` (V, 3) and ``frames`` (T, V, 3) [m] in the
    scene's world, ``faces`` (F, 3); ``fps``, ``up`` and ``path`` as of :class:`BodyMotion`.
    """

    rest: np.ndarray
    faces: np.ndarray
    frames: np.ndarray
    fps: float
    up: str = "z"
    path: str = "body"

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], count: int, selected: list[int], up: str = "z"
    ) -> MeshMotion:
        """The motion of an ``.npz`` file: ``vertices`` (T, V, 3), ``faces`` (F, 3), and, where it
        has them, ``rest`` (V, 3) and ``fps``. Or of a folder of mesh files of the same vertices and
        faces, in the order of their names, of which ``rest`` may be one. Without it the first frame
        is the rest. T, ``count``, ``selected`` and ``up`` as :meth:`BodyMotion.read` has them.
        Raises InputError.
        """
        path = os.fspath(path)
        arrays = _read_folder(path) if os.path.isdir(path) else _read(path)
        needed = "vertices (T, V, 3) and faces (F, 3) are needed"
        if not ("vertices" in arrays and "faces" in arrays):
            raise InputError(
                f"{path}: {needed}, and the file has {', '.join(sorted(arrays)) or 'nothing'}"
            )
        vertices, faces = arrays["vertices"], arrays["faces"]
        if vertices.ndim != 3 or vertices.shape[2] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise InputError(f"{path}: vertices {vertices.shape} and faces {faces.shape}; {needed}")
        rest = arrays.get("rest", vertices[:1].reshape(-1, 3))
        if rest.shape != vertices.shape[1:]:
            raise InputError(
                f"{path}: rest {rest.shape}; {vertices.shape[1:]}, as in each frame, is needed"
            )
        if not (np.isfinite(vertices).all() and np.isfinite(rest).all()):
            raise InputError(f"{path}: vertices and rest must be finite numbers")
        whole = faces.dtype.kind in "iu" and len(faces)
        if not (whole and 0 <= faces.min() <= faces.max() < len(rest)):
            raise InputError(
                f"{path}: faces must be whole numbers from 0 to {len(rest) - 1}, its vertices"
            )
        frames = _of_video(path, len(vertices), "meshes", count, selected)
        fps = _rate(path, arrays, count, selected)
        size, (low, high) = np.ptp(rest, axis=0).max(), _SIZES
        if not low < size < high:
            units = [u for u, per in (("cm", 100), ("mm", 1000)) if low < size / per < high]
            hint = f", not {units[0]}" if units else ""
            raise InputError(f"{path}: a body of {size:.4g} m; metres are needed{hint}")
        frames = vertices[frames].astype(float)
        return cls(rest.astype(float), faces.astype(np.int64), frames, fps, up, path)

    @property
    def place(self) -> np.ndarray:
        """Where its middle is in the first frame (3,) [m, world]."""
        return self.frames[0].mean(0)

    note = ""


def read_motion(
    path: str | os.PathLike[str],
    count: int,
    selected: list[int],
    model: str = "",
    up: str = "z",
) -> BodyMotion | MeshMotion:
    """The motion of a file or a folder, whichever of both it has; arguments as
    :meth:`BodyMotion.read` has them. Raises InputError.
    """
    if os.path.isdir(path) or _has_faces(path):
        if model:
            raise InputError(f"{os.fspath(path)}: is of meshes; {model} is for poses alone")
        return MeshMotion.read(path, count, selected, up)
    return BodyMotion.read(path, count, selected, model, up)


def _has_faces(path):
    """Whether a file is of meshes; what is no file at all is not."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return "faces" in file.files
    except NOT_NPZ:
        return False


def _read(path):
    """The arrays of a file, by their names."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file of a body's motion") from None
    except NOT_NPZ:
        raise InputError(
            f"{path}: not a file of a body's motion; .npz with poses (T, {_JOINTS}, 3) and"
            " translation (T, 3), or with vertices (T, V, 3) and faces (F, 3), is needed"
        ) from None


def _read_folder(path):
    """The same of a folder of mesh files."""
    names = sorted(n for n in os.listdir(path) if n.lower().endswith(_MESHES))
    if not names:
        raise InputError(f"{path}: no meshes ({', '.join(_MESHES)}) in this folder")
    known, faces, rest = [], None, {}
    for name in names:
        vertices, own, _ = read_mesh(os.path.join(path, name))
        faces = own if faces is None else faces
        if not np.array_equal(own, faces) or (known and len(vertices) != len(known[0])):
            raise InputError(
                f"{os.path.join(path, name)}: other faces than {names[0]}; all meshes of a body"
                " must have the same vertices and faces, in the same order"
            )
        if os.path.splitext(name)[0] == "rest":
            rest = {"rest": vertices}
        else:
            known.append(vertices)
    if not known:
        raise InputError(f"{path}: only the body at rest; a mesh for each frame is needed")
    return {"vertices": np.stack(known), "faces": faces, **rest}


def _of_video(path, given, what, count, selected):
    """Which of ``given`` poses or meshes are of the frames that are used: their indices."""
    if given == len(selected):
        return list(range(given))
    if given != count:
        raise InputError(f"{path}: {given} {what}; {count} frames, the video's, are needed")
    return selected


def _rate(path, arrays, count, selected):
    """Frames a second, of those that are used."""
    rate = _found(arrays, _RATES)
    try:
        fps = _USUAL_FPS if rate is None else float(np.ravel(rate)[0])
    except (ValueError, TypeError, IndexError):
        raise InputError(f"{path}: fps = {rate}; a positive number is needed") from None
    if count != len(selected) and len(selected) > 1:
        fps /= selected[1] - selected[0]
    if not 0 < fps < 10_000:
        raise InputError(f"{path}: fps = {fps:g}; a positive number is needed")
    return fps


def _found(arrays, names):
    return next((arrays[name] for name in names if name in arrays), None)


def _in_our_axes(poses):
    """SMPL's rotations (T, J, 3) [rad], the root's first, as :class:`onefit.Motion` has them, (T,
    24, 3): fingers are left out, and the root leads into the same world.
    """
    body = _JOINTS if poses.shape[1] == _JOINTS else 22
    turn = Rotation.from_euler("x", 90, degrees=True)  # from SMPL's body axes to OneFit's
    out = np.zeros((len(poses), _JOINTS, 3))
    out[:, :body] = turn.apply(poses[:, :body].reshape(-1, 3)).reshape(-1, body, 3)
    out[:, 0] = (Rotation.from_rotvec(poses[:, 0]) * turn.inv()).as_rotvec()
    return out


def _betas(betas, path):
    """One shape (S,) for all frames: the mean of an estimate for each. None where there is none."""
    if betas is None:
        return None
    betas = np.asarray(betas)
    if betas.ndim not in (1, 2) or betas.dtype.kind not in "fiu" or not np.isfinite(betas).all():
        raise InputError(f"{path}: betas {betas.shape}; finite numbers (S,) or (T, S) are needed")
    return betas.reshape(-1, betas.shape[-1]).mean(0)
