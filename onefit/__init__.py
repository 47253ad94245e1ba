"""OneFit: one network that drapes any garment on a moving body (paper, section "OneFit"), in torch,
on PolyFit's patches.

import onefit
drape = onefit.load("six-garments").drape("shirt.obj", onefit.Motion.generate("walk"))
drape.vertices  # (T, N, 3), metres
"""

_EXPORTS = {
    "load": "draper",
    "Draper": "draper",
    "Drape": "draper",
    "pretrained": "weights",
    "Garment": "garment",
    "TEMPLATES": "garment",
    "Motion": "motion",
    "Body": "body",
    "AnnyBody": "body",
    "SmplBody": "smpl",
    "PlainBody": "smpl",
    "OneFit": "network",
    "PatchedGarment": "charts",
    "Weights": "losses",
}

__all__ = sorted(_EXPORTS)


def __getattr__(name):
    # torch is loaded on first use, so that `import onefit` stays instant
    if name in _EXPORTS:
        from importlib import import_module

        return getattr(import_module(f".{_EXPORTS[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__():
    return sorted(list(globals()) + __all__)
