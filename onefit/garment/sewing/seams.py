"""Sews the panels of a pattern on the body that it is made for, by the physics of cloth, lets the
garment fall, and brings it to the standard body.

The panels begin where the pattern has them, before and behind the body, bent towards their seams,
whose vertices are one from the start; the cloth between them is too long, and draws the seams
together. Cloth that passes through itself would stay so: it does not at first, and each step begins
at rest until the seams are closed.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from onefit.body import AnnyBody, Body, skeleton, skinning
from onefit.garment.binding import surface_of
from onefit.garment.fitting import inward, misfit, pushed_out, to_standard, untangled
from onefit.garment.waistband import held
from onefit.objective import crossings
from onefit.physics import Material, Settings, Sheet, WornCloth
from polyfit.errors import InputError

from . import specification
from .fall import CONTACT
from .loose import Cut
from .panels import joined

_COUNT = 4000  # vertices, if it is not said how many
# Anny's body with the height, bust, waist and hips (1.72, 1.00, 0.84, 1.04 m) of GarmentCode's
# mean_all, which patterns without a body are made for
_MEAN_BODY = dict(
    gender=0.464, age=0.656, muscle=0.337, weight=0.713, height=0.40, proportions=0.464
)
_DEPTH = -0.03  # [m] of the trunk's middle in that body's place
_STRAIGHT = "hip", "elbow", "wrist"  # in the stand of patterns
_MATERIAL = Material.named("cotton")
_SETTINGS = Settings(iterations=30, tolerance=1e-3, contact=CONTACT)
# While the seams close: steps, each longer than the last, [s] of the first and of the longest; what
# goes farther than its contacts look would pass through. Velocities are multiplied by the last two,
# in the first and in the second half
_CLOSING, _FIRST, _GROWING, _STEP = 50, 1e-3, 1.1, 1 / 120
_STILL, _SLOWER = 0.0, 0.5
_FALL_STEP, _SLOWING = 1 / 60, 0.88  # [s]; the same, of the fall
_STANDING, _FALL = 0.5, 1.5  # [s] in which the body comes to its stand; of the whole fall
# The mean strain of cloth whose seams do not close, and how far from the body none hangs [m]
_STRAIN, _FAR = 0.05, 0.10


@dataclass(frozen=True)
class Sewn:
    """A garment that was sewn, around the standard body: ``vertices`` (N, 3) [m]; its ``cut``;
    ``lengths`` (F, 3) [m] at rest of the sides of its faces, in the size of the standard body;
    ``repairs``: sentences on what was changed.
    """

    name: str
    vertices: np.ndarray
    cut: Cut
    lengths: np.ndarray
    repairs: tuple


@lru_cache(maxsize=1)
def mean_body() -> Body:
    """The body that patterns are made for, if nothing else is said, in the standard stand."""
    model = AnnyBody()
    return model.body(torch.tensor([_MEAN_BODY[name] for name in model.shape_names]))


def sewn(path: str | os.PathLike[str], count: int | None = None, body: Body | None = None) -> Sewn:
    """The garment of a sewing pattern, ``path`` of a ``*_specification.json``, of about ``count``
    vertices, made for ``body``, which rests in the standard stand. Raises InputError.
    """
    where, pattern, body = str(path), specification.read(path), body or mean_body()
    least: tuple | None = None
    for cut in joined(pattern, count or _COUNT, where):
        cut = _around(body, cut)
        worn = _closed(cut, body)
        through = crossings(worn, cut.faces)
        if least is None or through < least[0]:
            least = through, cut, worn
        if not through:
            break
    if least is None:
        raise InputError(f"{where}: no panels")
    _, cut, worn = least
    worn = _fallen(cut, worn, body)
    _check(worn, cut, body, where)
    length = lambda x: np.linalg.norm(x[np.roll(cut.faces, -1, axis=1)] - x[cut.faces], axis=2)
    V = to_standard(worn, cut.faces, body, smooth=False)
    lengths = cut.sides * length(V) / length(worn)
    V = untangled(V, cut.faces)
    V, pushed = pushed_out(V, cut.faces, where)
    return Sewn(pattern.name, V, cut, lengths, pushed)


def _around(body, cut):
    """The ``cut`` where it begins to be sewn around a ``body``, wound outwards."""
    start = cut.start + [0, _DEPTH, float(body.vertices[:, 2].min())]
    turned = inward(start, cut.faces, surface_of(body))[:, None]
    faces = np.where(turned, cut.faces[:, ::-1], cut.faces)
    return Cut(start, faces, start, np.where(turned[..., None], cut.panels[:, ::-1], cut.panels))


def _standing(body, share):
    """The skin (V, 3) [m] of a ``body`` that has come by a ``share``, 0 to 1, from the stand of
    patterns, with straight limbs, to its own.
    """
    pose = body.rest_pose.clone()
    of_patterns = [skeleton.INDEX[f"{s}_{j}"] for s in ("left", "right") for j in _STRAIGHT]
    pose[of_patterns] *= share
    maps = skinning.transforms(body, pose[None], torch.zeros(1, 3))
    return skinning.skin(body.vertices, body.blend_weights, maps)[0].double().numpy()


def _worn(cut, x, body, material):
    sheet = Sheet(x, cut.faces, material, cut.sides, cut.start)
    return WornCloth(sheet, x, _standing(body, 0.0), body.faces.numpy(), _SETTINGS)


def _closed(cut, body):
    """The vertices (N, 3) [m] of a ``cut`` whose seams have closed around a ``body``."""
    worn, skin = _worn(cut, cut.start, body, replace(_MATERIAL, friction=0.0)), _standing(body, 0.0)
    for k in range(_CLOSING):
        worn.step(min(_STEP, _FIRST * _GROWING**k), skin, cut.start, 0.0)
        worn.cloth.v *= _STILL if k < _CLOSING // 2 else _SLOWER
    return worn.cloth.x


def _fallen(cut, x, body):
    """The vertices (N, 3) [m], once closed at ``x`` (N, 3) [m], as the garment hangs."""
    worn = _worn(cut, x, body, _MATERIAL)
    pull = _MATERIAL.stretch * held(x, cut.faces, body.joints.double().numpy())
    for k in range(1, round(_FALL / _FALL_STEP) + 1):
        worn.step(_FALL_STEP, _standing(body, min(1.0, k * _FALL_STEP / _STANDING)), x, pull)
        worn.cloth.v *= _SLOWING
    return worn.cloth.x


def _check(x, cut, body, where):
    """Raises InputError where cloth at ``x`` (N, 3) [m] is not what hangs on a ``body``."""
    if not np.isfinite(x).all():
        raise InputError(f"{where}: could not be sewn: the cloth tears apart")
    long = np.linalg.norm(x[np.roll(cut.faces, -1, axis=1)] - x[cut.faces], axis=2)
    strain, far = np.abs(long / cut.sides - 1).mean(), misfit(surface_of(body), x)
    if strain > _STRAIN or far > _FAR:
        raise InputError(
            f"{where}: does not fit the body: sewn, its cloth is strained by {100 * strain:.0f} %"
            f" and lies {100 * far:.0f} cm from it; look at units_in_meter and the panels'"
            " translation, or give the body that it is made for (made_for)"
        )
