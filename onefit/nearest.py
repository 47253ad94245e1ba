"""The nearest point of a closed triangle mesh, and on which side of it a point lies. Warp's bounding volume hierarchy, NumPy in and out."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from polyfit import mesh

from .quietwarp import warp

from .quietwarp import warp


@dataclass(frozen=True)
class Nearest:
    """``face`` (N,) int64, ``barycentric`` (N, 3), ``point`` (N, 3) [m] on the mesh, ``distance`` (N,) [m]: negative inside the mesh,
    ``normal`` (N, 3): the unit pseudonormal there, that of the face, of the edge or of the vertex on which the point lies.
    """

    face: np.ndarray
    barycentric: np.ndarray
    point: np.ndarray
    distance: np.ndarray
    normal: np.ndarray


@lru_cache(maxsize=1)
def _warp():
    wp = warp()

    @wp.kernel
    def nearest(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach: float, face: wp.array(dtype=int), uv: wp.array(dtype=wp.vec2)):
        i = wp.tid()
        query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
        if query.result:
            face[i] = query.face
            uv[i] = wp.vec2(query.u, query.v)

    return wp, nearest


class ClosestSurface:
    """Queries of one closed mesh, ``vertices`` (V, 3) [m] and ``faces`` (F, 3) wound outward."""

    def __init__(self, vertices, faces):
        self._wp, self._nearest = _warp()
        wp = self._wp
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        corners = wp.array(self.faces.ravel().astype(np.int32), dtype=int, device="cpu")
        self._mesh = wp.Mesh(wp.array(self.vertices, dtype=wp.vec3, device="cpu"), corners)
        self._normals = _pseudonormals(np.asarray(vertices, dtype=np.float64), self.faces).astype(np.float32)

    def __call__(self, points, reach=10.0):
        """:class:`Nearest` of points (N, 3) [m]. Those farther than ``reach`` [m] get the distance ``reach``, the face -1 and NaN."""
        wp = self._wp
        x = np.ascontiguousarray(points, dtype=np.float32)
        face, uv = wp.full(len(x), -1, dtype=int, device="cpu"), wp.zeros(len(x), dtype=wp.vec2, device="cpu")
        wp.launch(self._nearest, len(x), [self._mesh.id, wp.array(x, dtype=wp.vec3, device="cpu"), float(reach), face, uv], device="cpu")
        face, uv = face.numpy().astype(np.int64), uv.numpy()
        b = np.column_stack([uv, 1 - uv.sum(axis=1)])
        point = np.einsum("nk,nkd->nd", b, self.vertices[self.faces[face]])
        zero = b < 1e-5
        on_edge, on_vertex = zero.sum(axis=1) == 1, zero.sum(axis=1) == 2
        part = np.where(on_vertex, 4 + b.argmax(axis=1), np.where(on_edge, 1 + zero.argmax(axis=1), 0))
        normal = self._normals[face, part]
        distance = np.copysign(np.linalg.norm(x - point, axis=1), np.einsum("nd,nd->n", x - point, normal))
        missed = face < 0
        b[missed], point[missed], normal[missed], distance[missed] = np.nan, np.nan, np.nan, reach
        return Nearest(face, b, point, distance, normal)


def _pseudonormals(V, F):
    """Unit normals (F, 7, 3): of the face, of its edges opposite to the corners 0, 1, 2, of its corners (weighted by the angles there).

    With them the side of the surface on which a point lies is found from its nearest point alone (Baerentzen and Aanaes 2005).
    """
    face = mesh.face_vectors(V, F)
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-300)
    edges, side = mesh.edges_of(F)  # sides run from corner k to the next: side k is opposite to corner k + 2
    sums = lambda index, count, values: np.stack([np.bincount(index, x, minlength=count) for x in values.T], axis=1)
    of_edge = sums(side.ravel(), len(edges), np.repeat(face, 3, axis=0))
    to_next = V[np.roll(F, -1, axis=1)] - V[F]
    to_next /= np.maximum(np.linalg.norm(to_next, axis=2, keepdims=True), 1e-300)
    angle = np.arccos(np.clip(-(to_next * np.roll(to_next, 1, axis=1)).sum(axis=2), -1, 1))
    of_vertex = sums(F.ravel(), len(V), (angle[..., None] * face[:, None]).reshape(-1, 3))
    out = np.concatenate([face[:, None], of_edge[np.roll(side, -1, axis=1)], of_vertex[F]], axis=1)
    return out / np.maximum(np.linalg.norm(out, axis=2, keepdims=True), 1e-300)
