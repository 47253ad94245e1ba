"""The nearest point of a closed triangle mesh, still or moving, and on which side of it a point
lies: Warp's bounding volume hierarchy.

The side is that of the pseudonormal at the nearest point (Baerentzen and Aanaes 2005): of the face,
of the two faces of an edge, or of all around a vertex, weighted by their angles. It is summed up
where it is asked for, so that nothing but the hierarchy follows a motion.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from .quietwarp import warp

SEARCH_RADIUS = 0.15  # [m]; how far :meth:`ClosestSurface.distances` looks
EDGE_TOLERANCE = 1e-5  # [m]; points nearer than this are on the surface


@dataclass(frozen=True)
class Nearest:
    """``face`` (N,) int64, ``barycentric`` (N, 3), ``point`` (N, 3) [m] on the mesh, ``distance``
    (N,) [m]: negative inside the mesh, ``normal`` (N, 3): the unit pseudonormal there, that of the
    face, of the edge or of the vertex on which the point lies. Arrays of points that were an array,
    tensors otherwise.
    """

    face: np.ndarray | torch.Tensor
    barycentric: np.ndarray | torch.Tensor
    point: np.ndarray | torch.Tensor
    distance: np.ndarray | torch.Tensor
    normal: np.ndarray | torch.Tensor


@lru_cache(maxsize=1)
def _warp():
    from . import kernels  # compiled at the first use

    return warp(), kernels.nearest, kernels.row, kernels.Surface


class ClosestSurface:
    """Queries of one closed mesh, ``vertices`` (V, 3) [m] and ``faces`` (F, 3) wound outward,
    arrays or tensors; on the vertices' device.
    """

    def __init__(self, vertices, faces):
        self._wp, self._nearest, self._row, surface = _warp()
        vertices, faces = torch.as_tensor(vertices).detach(), torch.as_tensor(faces)
        self.faces = np.ascontiguousarray(faces.cpu().numpy(), dtype=np.int64)
        self._device = self._wp.device_from_torch(vertices.device)
        self._vertices = vertices.float().clone().contiguous()
        on_device = lambda x: self._wp.array(x.astype(np.int32), dtype=int, device=self._device)
        self._mesh = self._wp.Mesh(
            self._wp.from_torch(self._vertices, dtype=self._wp.vec3), on_device(self.faces.ravel())
        )
        counts = np.bincount(self.faces.ravel(), minlength=len(vertices))
        #: the :class:`onefit.body.kernels.Surface` that kernels take
        self.of_kernels = surface()
        self.of_kernels.mesh = self._mesh.id
        self.of_kernels.first = on_device(np.concatenate([[0], np.cumsum(counts)]))
        self.of_kernels.around = on_device(np.argsort(self.faces.ravel(), kind="stable"))

    @property
    def vertices(self):
        """Where the mesh's vertices are now, (V, 3) float32 [m], an array."""
        return self._vertices.cpu().numpy()

    def follow(self, vertices):
        """The mesh moves: its vertices are at (V, 3) [m] from now on, a tensor, or an array for a
        mesh on the CPU, which no threads of torch's need to meet for.
        """
        if torch.is_tensor(vertices):
            self._vertices.copy_(vertices.detach())
        else:
            self._vertices.numpy()[:] = vertices
        self._mesh.refit()

    def __call__(self, points, reach=10.0):
        """:class:`Nearest` of points (N, 3) [m], an array or a tensor on the mesh's device. Those
        farther than ``reach`` [m] get the distance ``reach``, the face -1 and NaN. Without
        gradient.
        """
        wp = self._wp
        x = torch.as_tensor(points, device=self._vertices.device).detach().float().contiguous()
        face, found = x.new_empty(len(x), dtype=torch.int32), x.new_full((len(x), 10), torch.nan)
        arrays = (
            wp.from_torch(x, dtype=wp.vec3),
            float(reach),
            wp.from_torch(face),
            wp.from_torch(found, dtype=self._row),
        )
        wp.launch(self._nearest, len(x), [self.of_kernels, *arrays], device=self._device)
        parts = face.long(), found[:, :3], found[:, 3:6], found[:, 6], found[:, 7:]
        return Nearest(*parts if torch.is_tensor(points) else (p.cpu().numpy() for p in parts))

    def distances(self, points, vertices):
        """Signed distances (T, P) [m], negative inside, of points (T, P, 3) [m] from the mesh with
        its vertices at (T, V, 3); differentiable in ``points``. It is at
        most SEARCH_RADIUS.
        """
        found = []
        for x, at in zip(points, vertices):
            self.follow(at)
            found.append(self(x, SEARCH_RADIUS))
        face, point, distance, normal = (
            torch.stack([getattr(n, k) for n in found])
            for k in ("face", "point", "distance", "normal")
        )
        away = (points.detach() - point) / distance[..., None]
        away = torch.where(
            distance[..., None].abs() > EDGE_TOLERANCE, away, normal
        )  # the gradient of the distance
        missed = (face < 0)[..., None]
        d = ((points - point.masked_fill(missed, 0)) * away.masked_fill(missed, 0)).sum(-1)
        return torch.where(face < 0, SEARCH_RADIUS, d)
