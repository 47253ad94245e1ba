"""Files or arrays of triangles go in; checked arrays, their edges, manifold sheets and finer meshes
come out, and mesh files again.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "meshio": ["read_mesh", "read_textured", "write_ply"],
        "notes": ["seam_note", "size_note"],
        "subdivision": ["child", "refined", "subdivided", "subdivided_loop"],
        "texcoords": ["TexCoords"],
        "triangles": [
            "areas",
            "as_arrays",
            "boundary_edges",
            "centred",
            "checked",
            "components",
            "edges_of",
            "face_vectors",
            "in_use",
            "loops",
            "neighbour_mean",
            "sheets",
            "signed_areas",
            "vertex_normals",
            "welded",
            "winding",
        ],
    },
)
