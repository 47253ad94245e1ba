"""A teacher: simulated drapes of generated motions. A network learns them by regression, beside the
objective or before it.

A folder of lessons has a file for each garment, as it was draped, and one for each of its drapes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from onefit.body import skinning
from onefit.contact import ContactSettings
from onefit.garment import Garment
from onefit.physics import Settings
from polyfit.errors import InputError
from polyfit.files import aside, read_npz

from .projection import unposed

FPS = 30.0
# A lesson's faces are of 2 cm, and a third of its time would go into points between their corners
SETTINGS = Settings(contact=ContactSettings(spacing=0.05))
_BETWEEN = "--"  # the names of garment and motion, in those of files


@dataclass(frozen=True)
class Lesson:
    """One drape: ``poses`` (T, 24, 3), ``translation`` (T, 3) [m] and ``shape`` (S,) of the body at
    30 frames a second; ``displacement`` (N, T, 3) [m] of the garment's vertices in the rest space,
    from the garment graded to the shape; in half precision, a tenth of a millimetre.
    """

    poses: torch.Tensor
    translation: torch.Tensor
    shape: torch.Tensor
    displacement: torch.Tensor


def lesson(draper, garment, motion, shape, *, material, steps=2, advance=lambda: None) -> Lesson:
    """What a simulation of ``garment`` in ``motion`` on a body of ``shape`` (S,) teaches; the
    arguments as :meth:`onefit.Draper.simulate` takes them.
    """
    how = dict(material=material, steps=steps, settings=SETTINGS, advance=advance)
    drape = draper.simulate(garment, motion, shape, **how)
    body = draper.model.body(shape)
    motion = motion.resampled(FPS).fitted(body)
    maps = skinning.transforms(body, motion.poses, motion.translation)
    at_rest = unposed(drape.vertices, garment.blend_weights, maps)
    away = (at_rest - drape.rest[:, None]).half()
    return Lesson(motion.poses, motion.translation, shape, away)


def path_of(folder, garment: str, motion: str = "") -> Path:
    """The file of a lesson, or that of the garment; ``garment`` and ``motion`` by their names."""
    name = re.sub("[^A-Za-z0-9_]", "_", garment)
    return Path(folder) / f"{name}{_BETWEEN if motion else ''}{motion}.npz"


def write(path: Path, lesson: Lesson) -> None:
    with aside(path) as temporary:
        np.savez(temporary, **{name: value.numpy() for name, value in vars(lesson).items()})


def write_garment(folder, garment: Garment) -> None:
    """The garment of the lessons of its name in ``folder``."""
    names = "vertices", "faces", "cut", "lengths"
    arrays = {name: getattr(garment, name) for name in names}
    with aside(path_of(folder, garment.name)) as temporary:
        np.savez(temporary, **{k: x.numpy() for k, x in arrays.items() if x is not None})


def garment_of(folder, name: str) -> Garment:
    """The garment of that name in a folder of lessons. Raises InputError where there is none."""
    path = path_of(folder, name)
    if not path.exists():
        raise InputError(f"{folder}: no lesson of {name}; onefit.teach makes them")
    found = _arrays(path, ("vertices", "faces"), ("cut", "lengths"))
    return Garment.bound(path.stem, **found)


def _arrays(path, needed, more=()):
    """The arrays ``needed`` of a file, and those of ``more`` that it has. Raises InputError."""
    found = read_npz(path, (*needed, *more), "a lesson")
    if missing := [name for name in needed if name not in found]:
        raise InputError(f"{path}: no lesson, for it misses {', '.join(missing)}")
    return found


def taught(folder) -> tuple[str, ...]:
    """The names of the garments in a folder of lessons. Raises InputError for none."""
    paths = Path(folder).glob("*.npz")
    names = tuple(sorted(path.stem for path in paths if _BETWEEN not in path.stem))
    if not names:
        raise InputError(f"{folder}: no lessons; onefit.teach makes them")
    return names


def lessons(folder, garment: Garment) -> list[Lesson]:
    """Those of a garment in ``folder``. Raises InputError without any, and for those of another
    mesh.
    """
    found = []
    for path in sorted(Path(folder).glob(path_of("", garment.name, "*").name)):
        arrays = _arrays(path, Lesson.__annotations__)
        lesson = Lesson(**{name: torch.as_tensor(x) for name, x in arrays.items()})
        if len(lesson.displacement) != len(garment):
            raise InputError(
                f"{path}: of {len(lesson.displacement)} vertices, not {len(garment)}: another mesh"
            )
        found.append(lesson)
    if not found:
        raise InputError(f"{folder}: no lesson of {garment.name}; onefit.teach makes them")
    return found
