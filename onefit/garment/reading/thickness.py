"""Cloth with a thickness: a surface of two sides that lie near each other. One side is the cloth.
NumPy.
"""

import numpy as np
from scipy.spatial import cKDTree

from polyfit import mesh

_THICKEST = 0.02  # cloth is thinner [m]
_THIN_SHARE = 0.8  # of the area that has to be thinner
_OPPOSITE, _SMOOTH = -0.5, 0.65  # cosines: of two sides' normals at most, across an edge at least
_SOME = 500  # faces that are looked at first
_ROUNDS = 10  # in which faces without a face opposite join the side that they continue


def outer_side(V, F, body):
    """``(faces (F,) bool, thickness [m])``: which faces of a part, V (N, 3) [m], F (F, 3) wound
    alike, are its outer side, and how thick it is; None for a single layer, and for a solid.
    ``body``: the :class:`onefit.body.ClosestSurface` below.

    A face has two sides of cloth where another one lies opposite, nearer than 2 cm; at a rim it has
    none. So rims part the sides, and the side that looks away from the body is the outer one.
    """
    centre, vector = V[F].mean(axis=1), mesh.face_vectors(V, F)
    area = np.linalg.norm(vector, axis=1) / 2
    outward = np.sign(np.einsum("fd,fd->", V[F[:, 0]] - V.mean(axis=0), vector))
    normal = outward * vector / np.maximum(2 * area, 1e-300)[:, None]
    looks = 2 * _THICKEST * normal  # so that a face which looks the same way is no nearest
    tree, asked = cKDTree(np.hstack([centre, looks])), np.hstack([centre, -looks])

    def opposite(faces):
        """The face opposite to each of some faces, how far across, and whether that is near."""
        other = tree.query(asked[faces])[1]
        away = centre[faces] - centre[other]
        across = np.einsum("fd,fd->f", away, normal[faces])
        near = np.linalg.norm(away, axis=1) < _THICKEST + np.sqrt(area[faces])
        cosine = np.einsum("fd,fd->f", normal[faces], normal[other])
        return other, across, near & (across > 0) & (cosine < _OPPOSITE)

    some = np.arange(0, len(F), max(1, len(F) // _SOME))
    if opposite(some)[2].mean() < _THIN_SHARE / 2:  # which is quickly told
        return None
    other, across, thin = opposite(np.arange(len(F)))
    if area[thin].sum() < _THIN_SHARE * area.sum():
        return None
    thickness = np.median(across[thin])
    thin &= across > thickness / 3  # else it lies beside, at a rim
    edge = mesh.edges_of(F)[1].ravel()
    order = np.argsort(edge, kind="stable")
    first = np.flatnonzero(np.diff(edge[order]) == 0)
    one, two = order[first] // 3, order[first + 1] // 3  # the two faces of each inner edge
    side = mesh.components(len(F), np.stack([one, two], 1)[thin[one] & thin[two]])
    found = body(centre)
    distance = np.where(np.abs(found.distance) > 1e-6, found.distance, np.inf)
    agree = np.einsum("fd,fd->f", centre - found.point, normal) / distance
    label = np.where(thin, np.sign(np.bincount(side, area * agree)[side]), 0)
    outer = label > 0
    if area[outer & outer[other]].sum() > (1 - _THIN_SHARE) * area[outer].sum():
        return None  # both sides hang together
    smooth = np.einsum("fd,fd->f", normal[one], normal[two]) > _SMOOTH
    one, two = one[smooth], two[smooth]
    for _ in range(_ROUNDS):
        for a, b in ((one, two), (two, one)):
            joins = label[a] == 0
            label[a[joins]] = label[b[joins]]
    return label > 0, thickness
