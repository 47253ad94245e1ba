"""Garments: a mesh around the standard body goes in; the same garment, mended, bound to the body
and graded to its shapes, comes out.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "alignment": ["aligned", "pose_of"],
        "arguments": ["add_mesh_arguments", "add_place_arguments", "read_options"],
        "binding": [
            "Binding",
            "cotangent_laplacian",
            "smoother",
            "standard_body",
            "standard_surface",
        ],
        "charts": ["FRAMES", "Deformation", "PatchedGarment", "SparseMatrix"],
        "fitting": ["OffBody", "Place", "inward", "untangled", "up_of"],
        "garment": ["FOLDER", "Garment", "LOOSE", "TEMPLATES"],
        "reading": ["RenderMesh", "Stitches", "mended", "parts"],
        "waistband": ["held", "held_below"],
    },
)
