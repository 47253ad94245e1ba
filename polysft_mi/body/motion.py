"""A body's motion, as a pose estimator gives it. Needs no Mitsuba."""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass

import numpy as np

from polysft_mi.errors import InputError

_JOINTS = 24
_POSES, _PLACES = ("poses", "pose"), ("translation", "trans", "transl")
_USUAL_FPS = 30.0


@dataclass(frozen=True)
class BodyMotion:
    """A body in T frames: ``poses`` (T, 24, 3) [rad] and ``translation`` (T, 3) [m] in the scene's
    world, as :class:`onefit.Motion` has them; ``fps`` frames a second; ``shape`` (S,) of Anny's
    body, or None for the standard one. ``path``: where it was read.
    """

    poses: np.ndarray
    translation: np.ndarray
    fps: float
    shape: np.ndarray | None = None
    path: str = "body"

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], count: int | None, selected: list[int]
    ) -> BodyMotion:
        """The motion of an ``.npz`` file: ``poses`` (T, 24, 3) or (T, 72), ``translation`` (T, 3),
        and, where it has them, ``fps`` and ``shape``.

        T is the number of all ``count`` images (None: of as many as the video has), or of those
        that are ``selected``. Raises InputError.
        """
        path = os.fspath(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except FileNotFoundError:
            raise InputError(f"{path}: no such file of a body's motion") from None
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError):
            raise InputError(
                f"{path}: not a file of a body's motion; .npz with poses (T, {_JOINTS}, 3) and"
                " translation (T, 3) is needed"
            ) from None
        poses, places = (
            next((arrays[name] for name in names if name in arrays), None)
            for names in (_POSES, _PLACES)
        )
        if poses is None or places is None:
            raise InputError(
                f"{path}: no {'poses' if poses is None else 'translation'}; poses (T, {_JOINTS}, 3)"
                f" and translation (T, 3) are needed, and the file has"
                f" {', '.join(sorted(arrays)) or 'nothing'}"
            )
        if poses.ndim == 2 and poses.shape[1] == 3 * _JOINTS:
            poses = poses.reshape(len(poses), _JOINTS, 3)
        if poses.ndim != 3 or poses.shape[1:] != (_JOINTS, 3) or places.shape != (len(poses), 3):
            raise InputError(
                f"{path}: poses {poses.shape} and translation {places.shape}; (T, {_JOINTS}, 3) and"
                " (T, 3) are needed"
            )
        numbers = poses.dtype.kind in "fiu" and places.dtype.kind in "fiu"
        if not numbers or not (np.isfinite(poses).all() and np.isfinite(places).all()):
            raise InputError(f"{path}: poses and translation must be finite numbers")
        if len(poses) != len(selected):
            whole = len(poses) > selected[-1] if count is None else len(poses) == count
            if not whole:
                raise InputError(
                    f"{path}: {len(poses)} poses; {count or f'more than {selected[-1]}'} frames,"
                    " the video's, are needed"
                )
            poses, places = poses[selected], places[selected]
        fps = float(arrays.get("fps", _USUAL_FPS))
        if count != len(selected) and len(selected) > 1:
            fps /= selected[1] - selected[0]
        if not 0 < fps < 10_000:
            raise InputError(f"{path}: fps = {fps:g}; a positive number is needed")
        shape = arrays.get("shape")
        return cls(poses.astype(float), places.astype(float), fps, shape, path)
