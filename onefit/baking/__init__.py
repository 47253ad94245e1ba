"""A garment and its drapes go in; what a game or a browser plays in two tenths of a millisecond
comes out: joints, corrective shapes, and how to find their weights from poses.

``making`` samples drapes and fits; ``evaluation`` needs NumPy alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "evaluation": ["Baked", "Stream"],
        "files": ["is_in_page", "write_glb", "write_page"],
        "making": ["Sampling", "bake"],
    },
)
