"""Meshes go in, at rest or moving; pictures of them come out, by Mitsuba's rays, and videos. Names
of :mod:`stage` are imported after a variant is set (:func:`polyfit.backend.set_variant`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["stage", "video"],
    submod_attrs={
        "stage": ["SideView", "Triangles"],
        "video": ["read_video", "write_video"],
    },
)
