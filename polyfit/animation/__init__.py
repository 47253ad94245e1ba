"""A textured mesh that moves goes in; files that other programs play come out: USD, glTF, or one
OBJ or PLY a frame.

Everywhere: ``vertices`` (T, N, 3) [m] of T frames, in the axes of the file (right-handed, ``up``
says which way is up), ``faces`` (F, 3), counterclockwise as seen from outside; ``uv`` (N, 2)
texture coordinates, v up, :class:`polyfit.mesh.TexCoords` where there are seams, or None;
``texture`` the path of an image, or None; ``fps`` frames a
second, the first at time 0. Files are written aside and renamed; InputError and OSError are raised
for what cannot be used or written.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "frames": ["write_frames"],
        "gltf": ["Skeleton", "SkinnedMesh", "write_glb", "write_skinned_glb"],
        "moving": ["AXES_FROM_CAMERA", "encoded", "from_camera", "normals"],
        "usd": ["write_usd"],
    },
)
