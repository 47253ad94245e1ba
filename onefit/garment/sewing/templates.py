"""The templates of the package: each is sewn by its pattern, those with slack fall once, and the
files of :class:`onefit.Garment` are written.
"""

import os

import numpy as np

from onefit.garment.binding import standard_body
from polyfit import mesh
from polyfit.files import aside, make_folder
from polyfit.mesh import loops

from .block import Block
from .fall import fallen
from .loose import LOOSE_PATTERNS, cut
from .sew import sewn


def write(names, folder):
    """Sew the named templates into ``folder``; those with slack fall once, and keep their cut."""
    make_folder(folder)
    body = standard_body()
    block = Block(body.vertices.numpy(), body.faces.numpy())
    for name in names:
        if name in LOOSE_PATTERNS:
            flat = cut(block, name)
            F, arrays = flat.faces, dict(vertices=fallen(flat), cut=flat.vertices)
        else:
            V, F = sewn(block, name)
            arrays = dict(vertices=V)
        arrays = {key: x.astype(np.float32) for key, x in arrays.items()}
        path = os.path.join(folder, f"{name}.npz")
        with aside(path) as temporary:
            np.savez_compressed(temporary, faces=F.astype(np.int32), **arrays)
        V = arrays.get("cut", arrays["vertices"]).astype(np.float64)
        print(
            f"{path}: {len(V)} vertices, {len(F)} faces, {mesh.areas(V, F).sum():.3f} m^2,"
            f" {len(loops(F))} loops",
            flush=True,
        )
