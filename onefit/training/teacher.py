"""A teacher: finished drapes of generated motions, as deformations of the garments' patches. A
network learns them by plain regression, without a body to collide with, before physics alone
teaches it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from onefit.body import skinning
from polyfit.errors import InputError
from polyfit.files import aside

from .projection import Projection, unposed

FPS = 30.0


@dataclass(frozen=True)
class Lesson:
    """One drape: ``poses`` (T, 24, 3), ``translation`` (T, 3) [m] and ``shape`` (S,) of the body at
    30 frames a second; ``changes`` (K, A, T, 3) [m] of the patches' matrices, as
    :meth:`onefit.PatchedGarment.changes` gives them.
    """

    poses: torch.Tensor
    translation: torch.Tensor
    shape: torch.Tensor
    changes: torch.Tensor


def lesson(draper, garment, motion, shape, *, finish, material, advance=lambda: None) -> Lesson:
    """What the finished drape of ``garment`` in ``motion`` on a body of ``shape`` (S,) teaches; the
    arguments as :meth:`onefit.Draper.drape` takes them.
    """
    drape = draper.drape(garment, motion, shape, finish=finish, material=material, advance=advance)
    body = draper.model.body(shape)
    motion = motion.resampled(FPS).fitted(body)
    maps = skinning.transforms(body, motion.poses, motion.translation)
    at_rest = unposed(drape.vertices, garment.blend_weights, maps)
    changes = Projection(draper.patched(garment))(at_rest - drape.rest[:, None])
    return Lesson(motion.poses, motion.translation, shape, changes)


def path_of(folder, garment: str, motion: str) -> Path:
    """The file of a lesson; ``garment`` and ``motion`` by their names."""
    return Path(folder) / f"{re.sub('[^A-Za-z0-9_]', '_', garment)}--{motion}.npz"


def write(path: Path, lesson: Lesson) -> None:
    with aside(path) as temporary:
        np.savez(temporary, **{name: value.numpy() for name, value in vars(lesson).items()})


def lessons(folder, patched) -> list[Lesson]:
    """Those of a garment (:class:`onefit.PatchedGarment`) in ``folder``. Raises InputError without
    any, and for those of a garment that was cut otherwise.
    """
    found = []
    for path in sorted(Path(folder).glob(path_of("", patched.garment.name, "*").name)):
        with np.load(path) as file:
            lesson = Lesson(*(torch.as_tensor(file[n]) for n in Lesson.__annotations__))
        if lesson.changes.shape[:2] != patched.alpha.shape:
            raise InputError(
                f"{path}: of {tuple(lesson.changes.shape[:2])} coefficients, not"
                f" {tuple(patched.alpha.shape)}: another garment, or another order"
            )
        found.append(lesson)
    if not found:
        raise InputError(f"{folder}: no lesson of {patched.garment.name}; onefit.teach makes them")
    return found
