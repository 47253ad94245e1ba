"""Where a garment is held on the body: at the band of its upper rim, unless it hangs from the
shoulders. NumPy.

The paper's objective has neither friction nor bands, so that its least lets trousers slide down and
wide skirts fall. Others pin the upper vertices of lower garments by hand (Bertiche et al. 2021,
2022); here the band is found.
"""

import numpy as np

from onefit.body import skeleton
from polyfit import mesh
from polyfit.mesh import loops

from .remesh import nearest_on_segments

_SHOULDERS = [skeleton.INDEX["left_shoulder"], skeleton.INDEX["right_shoulder"]]
BAND_WIDTH = 0.02, 0.05  # [m]; cloth so near to the rim is held, farther away it is free


def _highest_rim(vertices, faces):
    """The loop of the boundary that lies highest in the mean, vertex indices (R,); None without a
    boundary. ``vertices`` (N, 3) [m], NumPy, ``faces`` (F, 3)."""
    return max(loops(faces), key=lambda loop: vertices[loop, 2].mean(), default=None)


def held(vertices, faces, joints):
    """How firmly each of the vertices (N, 3) [m] of a garment with ``faces`` (F, 3) is held, 0 to
    1, (N,), by the height of the shoulders among the body's ``joints`` (J, 3) [m]: see
    :func:`held_below`.
    """
    return held_below(vertices, faces, joints[_SHOULDERS, 2].mean())


def held_below(vertices, faces, shoulders):
    """How firmly each of the vertices (N, 3) [m] of a garment with ``faces`` (F, 3) is held, 0 to
    1, (N,), on a body whose ``shoulders`` are at that height [m].

    A garment that reaches as high as the shoulder joints hangs from them, and nothing of it is
    held. Of any other one it is what lies along the highest loop of its boundary. Each part that is
    not sewn to the others is a garment of its own: trousers below a shirt.
    """
    out = np.zeros(len(vertices))
    part = mesh.components(len(vertices), mesh.edges_of(faces)[0])
    for k in np.unique(part[faces]):
        own = part == k
        number = np.cumsum(own) - 1
        out[own] = _held(vertices[own], number[faces[own[faces[:, 0]]]], shoulders)
    return out


def _held(vertices, faces, shoulders):
    """As :func:`held_below`, of one part."""
    out, rim = np.zeros(len(vertices)), _highest_rim(vertices, faces)
    if rim is None or vertices[:, 2].max() > shoulders:
        return out
    rim = vertices[rim]
    near = np.flatnonzero(
        (vertices[:, 2] > rim[:, 2].min() - BAND_WIDTH[1])
        & (vertices[:, 2] < rim[:, 2].max() + BAND_WIDTH[1])
    )
    distance = np.linalg.norm(
        vertices[near] - nearest_on_segments(vertices[near], rim, np.roll(rim, -1, axis=0)), axis=1
    )
    x = np.clip((BAND_WIDTH[1] - distance) / (BAND_WIDTH[1] - BAND_WIDTH[0]), 0, 1)
    out[near] = x * x * (3 - 2 * x)
    return out
