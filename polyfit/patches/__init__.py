"""A mesh goes in; patches come out, and the surface of their jets, which can be evaluated anywhere
and at any resolution.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "atlas": ["Cover", "is_graph", "partition"],
        "patches": ["Patches", "patch_count"],
        "surface": ["PatchedSurface", "smoothed"],
        "unity": ["shares"],
    },
)
