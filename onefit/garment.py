"""Garments in the rest space of the standard body: read, bound to the body by smooth blend weights, and graded to its shapes."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from polyfit import mesh
from polyfit.errors import InputError

from .nearest import ClosestSurface

TEMPLATES = ("tshirt", "dress", "tank", "long_sleeve_top", "shorts", "trousers", "jumpsuit")
FOLDER = Path(__file__).parent / "data" / "garments"

# Lengths over which the weights and the displacements of a shape are smoothed where the garment touches the body [m]; they grow with the
# distance from it, doubled at this one.
WEIGHTS_LENGTH, SHAPE_LENGTH, NEAR = 0.025, 0.015, 0.02
CLEARANCE = 0.003  # that grading leaves between garment and body, where the template had it [m]


@lru_cache(maxsize=1)
def standard_body():
    """The body that garments are made around: Anny's, with every phenotype at 0.5."""
    from .body import AnnyBody

    return AnnyBody().body()


@lru_cache(maxsize=1)
def _standard_surface():
    body = standard_body()
    return ClosestSurface(body.vertices.numpy(), body.faces.numpy())


@dataclass(frozen=True)
class Garment:
    """A garment at rest on the standard body.

    ``name``; ``vertices`` (N, 3) float32 [m], in OneFit's axes; ``faces`` (F, 3) int64, wound outwards; ``blend_weights`` (N, 24), rows that
    sum to one; ``repairs``, sentences on what was changed when it was read.
    """

    name: str
    vertices: torch.Tensor
    faces: torch.Tensor
    blend_weights: torch.Tensor
    repairs: tuple = ()
    _binding: "Binding" = field(default=None, repr=False, compare=False)

    @classmethod
    def template(cls, name):
        """One of :data:`TEMPLATES`, which :mod:`onefit.tailor` made."""
        if name not in TEMPLATES:
            raise InputError(f"garment '{name}': no such template; there are {', '.join(TEMPLATES)}")
        with np.load(FOLDER / f"{name}.npz") as file:
            return cls.bound(name, file["vertices"], file["faces"])

    @classmethod
    def bound(cls, name, vertices, faces, repairs=()):
        """The garment of a clean mesh (N, 3) [m], (F, 3) around the standard body, with blend weights from there."""
        V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        binding = Binding(V, F)
        weights = torch.as_tensor(binding.blend_weights(), dtype=torch.float32)
        return cls(name, torch.as_tensor(V, dtype=torch.float32), torch.as_tensor(F), weights, tuple(repairs), binding)

    def __len__(self):
        return len(self.vertices)

    def to(self, device):
        """The same garment with its tensors on ``device``."""
        return replace(self, **{f.name: v.to(device) for f in fields(self) if isinstance(v := getattr(self, f.name), torch.Tensor)})

    def graded(self, body):
        """Rest vertices (N, 3) [m] moved with the shape of ``body``: a Body of the standard body's kind (AnnyBody). The standard shape
        leaves them where they are.
        """
        moved = self._binding.graded(body.vertices.detach().cpu().numpy())
        return torch.as_tensor(moved, dtype=torch.float32, device=self.vertices.device)


class Binding:
    """Where each vertex of a mesh ``V`` (N, 3) [m], ``F`` (F, 3) hangs on the standard body, and smoothing over the mesh.

    The nearest points of the body tell a weight or a displacement of each vertex. They jump where the nearest point does, between arm and
    chest or from leg to leg, and mean less the farther away the body is; so they are smoothed: x minimises
    sum_i m_i c_i |x_i - y_i|^2 + l^2 sum_ij w_ij |x_i - x_j|^2, with the areas m, the cotangent weights w (at least zero, so that x stays
    within the range of y), and the trust c = 1 / (1 + (distance / NEAR)^2). Independent of the mesh's resolution.
    """

    def __init__(self, V, F):
        surface, body = _standard_surface(), standard_body()
        self.V, self.F = V, F
        self.normals = vertex_normals(V, F)
        found = surface(V)
        self.distance, self.face, self.barycentric = found.distance, found.face, found.barycentric.astype(np.float64)
        self._rest = body.vertices.numpy().astype(np.float64)
        self._body_faces = body.faces.numpy()
        facing = (found.normal * self.normals).sum(axis=1)  # below zero where the nearest point is on the other side of an armpit, on the other leg
        self.corners = self._body_faces[self.face]
        self.area, self.stiffness = _cotangent_laplacian(V, F)
        self._trust = self.area * np.clip(facing, 1e-3, 1) / (1 + (self.distance / NEAR) ** 2)

    def _on_body(self, values):
        """Values (V, C) of the body's vertices where this mesh's hang (N, C)."""
        return np.einsum("nk,nkc->nc", self.barycentric, values[self.corners])

    def _smoother(self, length):
        trust = self._trust
        solver = splu((diags(trust) + length**2 * self.stiffness).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return lambda values: solver.solve(trust[:, None] * values)

    @cached_property
    def _smooth_shape(self):
        return self._smoother(SHAPE_LENGTH)

    def blend_weights(self):
        """(N, 24), rows that sum to one."""
        weights = self._on_body(standard_body().blend_weights.numpy().astype(np.float64))
        weights = np.maximum(self._smoother(WEIGHTS_LENGTH)(weights), 0)
        return weights / weights.sum(axis=1, keepdims=True)

    def graded(self, body_vertices):
        """Vertices (N, 3) [m] where the standard body's are at ``body_vertices`` (V, 3)."""
        if body_vertices.shape != self._rest.shape:
            raise InputError(f"body of {len(body_vertices)} vertices; garments are graded to shapes of Anny, of {len(self._rest)}")
        moved = body_vertices.astype(np.float64)
        return self.V + self._smooth_shape(self._on_body(moved - self._rest))


def vertex_normals(V, F):
    """Unit normals (N, 3), means of those of the faces around, weighted by their areas."""
    N = np.stack([np.bincount(F.ravel(), np.repeat(x, 3), minlength=len(V)) for x in mesh.face_vectors(V, F).T], axis=1)
    return N / np.maximum(np.linalg.norm(N, axis=1, keepdims=True), 1e-300)


def _cotangent_laplacian(V, F):
    """A third of the area of the faces around each vertex (N,) [m^2], and the positive semidefinite matrix (N, N) of the cotangent weights,
    none below zero.
    """
    to_next = V[np.roll(F, -1, axis=1)] - V[F]  # side k runs from corner k to the next
    area = np.maximum(mesh.areas(V, F), 1e-12)
    cot = -(np.roll(to_next, -1, axis=1) * np.roll(to_next, 1, axis=1)).sum(axis=2) / (2 * area)[:, None]  # of the angle opposite to side k
    i, j, w = F.ravel(), np.roll(F, -1, axis=1).ravel(), np.clip(cot.ravel() / 2, 1e-3, 1e3)
    L = coo_matrix((np.concatenate([-w, -w, w, w]), (np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j]))), shape=(len(V),) * 2)
    return np.bincount(F.ravel(), np.repeat(area / 3, 3), minlength=len(V)), L.tocsc()
