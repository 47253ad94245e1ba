"""The mesh of a garment's file goes in; clean cloth comes out, the file's mesh that it carries, and
what its buttons hold together.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "mending": ["SMALL_PART_SHARE", "check", "mended", "parts"],
        "render_mesh": ["RenderMesh"],
        "stitches": ["Stitches", "stitched"],
    },
)
