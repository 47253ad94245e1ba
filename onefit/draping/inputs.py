"""What a user names on the command line: bodies, shapes, motions. An InputError says what would be
accepted.
"""

import zipfile
from pathlib import Path

from onefit.body import AnnyBody, PlainBody, SmplBody
from onefit.motion import KINDS, Motion
from polyfit.errors import InputError


def shape_of(model, pairs):
    """The shape (S,) of a body ``model`` from pairs as "weight=0.6"; None without any. What is not
    named is standard.
    """
    if not pairs:
        return None
    if not model.shape_names:
        raise InputError(f"--shape {pairs[0]}: this body has one shape only; leave --shape out")
    shape, given = model.standard_shape.clone(), set()
    for pair in pairs:
        name, _, value = pair.partition("=")
        if name in given:
            raise InputError(f"--shape {pair}: {name} is there twice; give it once")
        given.add(name)
        if name not in model.shape_names:
            raise InputError(
                f"--shape {pair}: choose among {', '.join(model.shape_names)}, as in weight=0.6"
            )
        try:
            shape[model.shape_names.index(name)] = float(value)
        except ValueError:
            raise InputError(f"--shape {pair}: a number is needed, as in {name}=0.6") from None
    return shape


def motion_of(name, *, seconds, seed, fps=None, up=None):
    """A motion of a generated kind (``seconds``, ``seed``), or of a file (``fps``, ``up``)."""
    if name in KINDS:
        return Motion.generate(name, seconds=seconds, seed=seed)
    if not Path(name).exists():
        raise InputError(
            f"motion {name}: no such file, and no kind of motion; the kinds are {', '.join(KINDS)}"
        )
    return Motion.read(name, fps, up)


def body_model(name):
    """The body model "anny", or that of a file: SMPL's, or plain."""
    if name == "anny":
        return AnnyBody()
    if not Path(name).exists():
        raise InputError(f"--body {name}: no such file; anny needs none")
    plain = zipfile.is_zipfile(name) and "blend_weights.npy" in zipfile.ZipFile(name).namelist()
    return PlainBody(name) if plain else SmplBody(name)
