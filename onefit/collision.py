"""Signed distances from points to posed bodies, by Warp's bounding volume hierarchy.

Measured against a k-d tree of the body's vertices: half as fast on one core, but exact, and the same on a GPU.
"""

from functools import lru_cache

import torch

from .quietwarp import warp

FAR = 0.15  # [m]; points farther from the body than this are not asked about, and pass for this far
DEEP = 0.005  # [m] inside, from where on a sign is asked of the nearest triangle too


@lru_cache
def _warp():
    wp = warp()

    @wp.kernel
    def query(
        mesh: wp.uint64, points: wp.array(dtype=wp.vec3), far: float, nearest: wp.array(dtype=wp.vec3), normal: wp.array(dtype=wp.vec3)
    ):
        i = wp.tid()
        found = wp.mesh_query_point_sign_normal(mesh, points[i], far)
        if found.result:
            at = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
            away = points[i] - at
            length = wp.length(away)
            nearest[i] = at
            sign = found.sign
            # between the legs, where two points of the body are equally near, Warp's sign takes the mean of both normals and can be wrong
            if sign < 0.0 and length > DEEP and wp.dot(away, wp.mesh_eval_face_normal(mesh, found.face)) > 0.0:
                sign = 1.0
            if length > 1.0e-5:
                normal[i] = away * (sign / length)
            else:
                normal[i] = wp.mesh_eval_face_normal(mesh, found.face)
        else:
            nearest[i] = points[i]
            normal[i] = wp.vec3(0.0, 0.0, 0.0)

    return wp, query


class Collider:
    """The surface of a body that moves: its triangles (F, 3), which are closed and wound outwards, and a hierarchy that follows its
    vertices.
    """

    def __init__(self, faces, rest):
        """``rest`` (V, 3) [m]: vertices that the hierarchy is built on."""
        wp, self._query = _warp()
        self._wp, self.device = wp, "cuda" if rest.is_cuda else "cpu"
        self._vertices = wp.from_torch(rest.detach().float().clone().contiguous(), dtype=wp.vec3)
        indices = wp.from_torch(faces.detach().to(rest.device, torch.int32).flatten().contiguous())
        self._mesh = wp.Mesh(points=self._vertices, indices=indices)

    def follow(self, vertices):
        """The body's vertices are at (V, 3) [m] from now on."""
        self._wp.copy(self._vertices, self._wp.from_torch(vertices.detach().float().contiguous(), dtype=self._wp.vec3))
        self._mesh.refit()

    def nearest(self, points, reach=FAR):
        """Of points (P, 3) [m]: the nearest points of the body's surface (P, 3), and unit vectors (P, 3) from there to the point where that
        lies outside, from the point where it lies inside. Zero for points farther than ``reach`` [m]. Without gradient."""
        points = points.detach().float().contiguous()
        nearest, normal = torch.empty_like(points), torch.empty_like(points)
        points, *found = (self._wp.from_torch(x, dtype=self._wp.vec3) for x in (points, nearest, normal))
        self._wp.launch(self._query, len(points), inputs=[self._mesh.id, points, reach, *found], device=self.device)
        return nearest, normal

    def distance(self, points, vertices):
        """Signed distances (T, P) [m], negative inside, of points (T, P, 3) [m] from the body with its vertices at (T, V, 3); differentiable
        in ``points``. Points farther than FAR have FAR."""
        found = []
        for p, v in zip(points, vertices):
            self.follow(v)
            found.append(self.nearest(p))
        nearest, normal = (torch.stack(x) for x in zip(*found))
        d = ((points - nearest) * normal).sum(-1)
        return torch.where((normal == 0).all(-1), FAR, d)
