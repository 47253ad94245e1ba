"""A garment and its cut into patches go in; deformations of the patches' jets become positions and
tangents of the cloth.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "deformation": ["Deformation"],
        "patched": ["FRAMES", "PatchedGarment"],
        "sparse": ["SparseMatrix"],
    },
)
