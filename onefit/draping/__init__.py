"""Draping: a garment, a body and a motion go in, the garment's vertices in every frame come out."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "draper": ["Drape", "Draper", "load"],
        "inputs": ["body_model", "motion_of", "shape_of"],
        "post": ["DRAG", "PULL"],
        "simulation": ["simulated"],
    },
)
