"""Bodies: shape parameters and a pose go in; a skinned surface with joints, and the points of it
that are closest to given ones, come out. Metres, z up, SMPL's 24 joints.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "body": ["AnnyBody", "Body", "BodyModel"],
        "nearest": ["ClosestSurface", "Nearest"],
        "smpl": ["PlainBody", "SmplBody"],
    },
)
