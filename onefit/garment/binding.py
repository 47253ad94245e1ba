"""Where the vertices of a garment hang on a body, and smoothing over the garment: what weights and
grading are made of. NumPy.
"""

from functools import cached_property, lru_cache

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from onefit.body import ClosestSurface
from onefit.contact import ContactSettings
from polyfit import mesh

# Lengths over which the weights and the displacements of a shape are smoothed where the garment
# touches the body [m]; they grow with the distance from it, doubled at 1.7 times this one.
_WEIGHTS_LENGTH, _SHAPE_LENGTH, _TOUCHING_DISTANCE = 0.010, 0.008, 0.007
_CLEARANCE = ContactSettings().clearance


@lru_cache(maxsize=1)
def standard_body():
    """The body that garments are made around: Anny's, with every phenotype at 0.5."""
    from onefit.body import AnnyBody

    return AnnyBody().body()


@lru_cache(maxsize=1)
def standard_surface():
    """The :class:`ClosestSurface` of the standard body."""
    return surface_of(standard_body())


def surface_of(body):
    return ClosestSurface(body.vertices.cpu().numpy(), body.faces.cpu().numpy())


class Binding:
    """Where each vertex of a mesh ``V`` (N, 3) [m], ``F`` (F, 3) wound outwards, hangs on a body's
    ``surface``, and smoothing over the mesh.

    The nearest points of the body tell a weight or a displacement of each vertex. They jump where
    the nearest point does, between arm and chest or from leg to leg, and mean less the farther away
    the body is; so they are smoothed: x minimises sum_i m_i c_i |x_i - y_i|^2 + l^2 sum_ij w_ij
    |x_i - x_j|^2, with the areas m, the cotangent weights w (above zero, so that x stays within the
    range of y), and the trust c = n / (1 + (distance / _TOUCHING_DISTANCE)^2), where n is the
    cosine between the normals of garment and body (at least 0.001: the other side of an armpit, the
    other leg tell nothing). Independent of the mesh's resolution.
    """

    def __init__(self, V, F, surface=None):
        surface = standard_surface() if surface is None else surface
        found = surface(V)
        self.distance = found.distance  # (N,) [m], negative inside the body
        self.barycentric = found.barycentric.astype(np.float64)  # (N, 3)
        self.corners = surface.faces[found.face]  # (N, 3) vertices of the body
        facing = (found.normal * mesh.vertex_normals(V, F)).sum(axis=1)
        self._touching = np.flatnonzero((np.abs(self.distance) < 0.01) & (facing > 0.3))
        self._above = self._above_body(V, surface.vertices.astype(np.float64))[0]
        area, self._stiffness = cotangent_laplacian(V, F)
        self._trust = (
            area * np.clip(facing, 1e-3, 1) / (1 + (self.distance / _TOUCHING_DISTANCE) ** 2)
        )

    def on_body(self, values):
        """Values (V, C) of the body's vertices where this mesh's hang (N, C)."""
        return np.einsum(
            "nk,nkc->nc", self.barycentric, np.asarray(values, dtype=np.float64)[self.corners]
        )

    def smoother(self, length):
        """A function that smooths values (N, C) over ``length`` [m]."""
        return smoother(self._trust, self._stiffness, length)

    @cached_property
    def _smooth_shape(self):
        return self.smoother(_SHAPE_LENGTH)

    def blend_weights(self, of_body):
        """(N, 24), rows that sum to one, of those of the body (V, 24)."""
        weights = np.maximum(self.smoother(_WEIGHTS_LENGTH)(self.on_body(of_body)), 0)
        return weights / weights.sum(axis=1, keepdims=True)

    def displacement(self, of_body):
        """(N, 3) [m] of that of the body's vertices (V, 3)."""
        return self._smooth_shape(self.on_body(of_body))

    def moved(self, V, before, after):
        """Vertices ``V`` (N, 3) [m] displaced with those of the body from ``before`` to ``after``
        (V, 3). Where the cloth touches the body, it stays as far above the plane at its point there
        as it was, or the contact's clearance if that is less.
        """
        moved = V + self.displacement(after - before)
        above, normal = self._above_body(moved, after)
        moved[self._touching] += (
            np.maximum(np.minimum(self._above, _CLEARANCE) - above, 0)[:, None] * normal
        )
        return moved

    def _above_body(self, V, body):
        """How far the vertices that touch the body lie above the planes of the body's faces on
        which they hang (K,) [m], and their normals (K, 3).
        """
        corners = body[self.corners[self._touching]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        point = np.einsum("nk,nkd->nd", self.barycentric[self._touching], corners)
        return ((V[self._touching] - point) * normal).sum(axis=1), normal


def smoother(trust, stiffness, length):
    """A function of values y (N, C) to x of least sum_i trust_i |x_i - y_i|^2 + length^2 x'
    stiffness x.
    """
    system = (diags(trust) + length**2 * stiffness).tocsc()
    solver = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return lambda y: solver.solve(trust[:, None] * y)


def cotangent_laplacian(V, F):
    """A third of the area of the faces around each vertex (N,) [m^2], and the positive semidefinite
    matrix (N, N) of the cotangent weights, all above zero.
    """
    to_next = V[np.roll(F, -1, axis=1)] - V[F]  # side k runs from corner k to the next
    area = np.maximum(mesh.areas(V, F), 1e-12)
    cot = (
        -(np.roll(to_next, -1, axis=1) * np.roll(to_next, 1, axis=1)).sum(axis=2)
        / (2 * area)[:, None]
    )  # of the angle opposite to side k
    i, j, w = F.ravel(), np.roll(F, -1, axis=1).ravel(), np.clip(cot.ravel() / 2, 1e-3, 1e3)
    L = coo_matrix(
        (
            np.concatenate([-w, -w, w, w]),
            (np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])),
        ),
        shape=(len(V),) * 2,
    )
    return np.bincount(F.ravel(), np.repeat(area / 3, 3), minlength=len(V)), L.tocsc()
