"""A garment cut into patches, and what follows from its patches' deformation: positions and
tangents, linear in the jets' coefficients.

In the chart of patch k a deformed jet is p(u, v) = s' R (u, v, sum_b alpha'_b m_b(u, v)) + T', m_b
the monomials. Since u, v and 1 are monomials too, p is linear in them: p = C_k m(u, v), with a
matrix C_k (3, A) for each patch. So the displacement of the whole garment, at any resolution, is
one sparse matrix, made once, times the changes of the C_k (:attr:`PatchedGarment.blend`). No jet is
evaluated frame by frame.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import torch

from onefit.body import Body
from onefit.garment.binding import surface_of
from onefit.garment.waistband import held
from polyfit import mesh
from polyfit.errors import InputError
from polyfit.network import PolyFit
from polyfit.patches import PatchedSurface

from .blending import blend_matrix, drift_planes, drift_scale, looseness_of
from .deformation import Deformation
from .frames import along_bones
from .samples import basis_and_slopes, boundary_points, metric_points, refinement
from .sparse import SparseMatrix

if TYPE_CHECKING:
    from onefit.garment.garment import Garment

FRAMES = ("pca", "stn")


class PatchedGarment:
    """A :class:`onefit.Garment` as patches T_k = {O_k, phi_k} (paper, section "OneFit"),
    with all that draping and the losses need.

    ``frame`` (K,), ``alpha`` (K, A): orientations and jets, z outwards and v along the bone that
    moves the patch most, so that patches of different garments at the same place of the body are
    alike; ``blend_weights`` (K, J), those of the patch. N vertices, of the garment's own mesh; P =
    K M points where the metric is held. Lengths in metres, in the rest space.
    """

    def __init__(
        self,
        garment: Garment,
        body: Body,
        *,
        patches: int | None = None,
        order: int = 4,
        frames: str = "pca",
        acvd: bool = False,
        waistband: bool = True,
        seed: int = 0,
    ) -> None:
        """Cut ``garment`` into ``patches`` (by default as many as the paper has for its area);
        ``body``: the standard one.

        ``frames``: "pca", or "stn", refined by the spatial transformer of the paper's training;
        ``acvd``: cut by plain ACVD; ``waistband``: garments that do not reach the shoulders are
        held along a rim. Raises InputError for other ``frames``.
        """
        if frames not in FRAMES:
            raise InputError(f"frames '{frames}': choose {' or '.join(FRAMES)}")
        self.garment = garment
        vertices, faces = garment.vertices.double().numpy(), garment.faces.numpy()
        stn = PolyFit.pretrained(order, "paper").requires_grad_(False) if frames == "stn" else None
        surface = PatchedSurface.from_mesh(
            vertices, faces, patches, order, acvd=acvd, polyfit=stn, dtype=torch.float64,
            where=garment.name,
        )  # fmt: skip
        p = surface.patches
        self._refinement = refinement(len(vertices), p.given, p.levels)
        weights = self._refinement @ garment.blend_weights.double().numpy()
        area = np.bincount(p.entry_patch, p.entry_weight)
        of_patch = (
            np.stack(
                [np.bincount(p.entry_patch, p.entry_weight * w) for w in weights[p.entry_vertex].T],
                1,
            )
            / area[:, None]
        )
        self.frame, self.alpha, uv = along_bones(surface, of_patch, body)
        self.blend_weights = of_patch
        self.order = order
        rng = np.random.default_rng(seed)
        points, field = metric_points(p, uv, order, rng)
        #: (3 P, N): value and derivatives along u and v, at the points of the metric, of a field
        #: given at the vertices
        self._field = (field @ self._refinement).tocsr()
        self.metric_uv = torch.as_tensor(uv[points], dtype=torch.float32)
        nearest = self._refinement[p.entry_vertex[points.ravel()]]
        #: (P,): the vertex of the garment's mesh nearest to each point of the metric
        self.metric_vertex = torch.as_tensor(np.asarray(nearest.argmax(axis=1)).ravel())
        pairs = boundary_points(p, rng)
        self.boundary_patch = torch.as_tensor(p.entry_patch[pairs])  # (B, 2)
        self.boundary_uv = torch.as_tensor(uv[pairs], dtype=torch.float32)  # (B, 2, 2)
        self.vertex_patch = p.vertex_patch[: len(vertices)]  # (N,): the patch of each vertex
        #: (N, K A), a SparseMatrix
        self.blend = SparseMatrix(blend_matrix(p, vertices, self.frame, order))
        surface = surface_of(body)
        firmly = held(vertices, faces, body.joints.cpu().double().numpy())
        self._hold(p, vertices, firmly if waistband else 0 * firmly, surface)
        self.looseness = looseness_of(p, surface)
        #: (K,) [m]: how far a patch goes with a drift of 1
        self.drift_scale = drift_scale(self.looseness)
        #: a SparseMatrix (3 K, K): the entries of 1, u and v [m] of the plane that drifts of the
        #: patches around make in each chart
        self.planes = SparseMatrix(
            drift_planes(p.neighbours, self.frame) @ sp.diags(self.drift_scale)
        )

    def __len__(self):
        """K, the number of patches."""
        return len(self.alpha)

    def to(self, device: torch.device | str) -> PatchedGarment:
        """The same, with its tensors on ``device``."""
        moved = copy.copy(self)
        for name in (
            "field",
            "metric_weights",
            "metric_basis",
            "boundary_basis",
            "boundary_tangents",
            "features",
            "edges",
            "vertex_area",
        ):
            getattr(self, name)

        def move(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(map(move, value))
            return value.to(device) if hasattr(value, "to") else value

        vars(moved).update({name: move(value) for name, value in vars(self).items()})
        return moved

    def _hold(self, p, vertices, firmly, surface):
        """The band where vertices are held ``firmly`` (N,) (:mod:`onefit.garment.waistband`): they
        give way along the body's normal, but do not slide.
        """
        band = np.flatnonzero(firmly)
        normal = (
            surface(vertices[band]).normal.astype(np.float64) if len(band) else np.zeros((0, 3))
        )
        along = firmly[band, None, None] * (np.eye(3) - normal[:, :, None] * normal[:, None])
        #: which vertices are held, (H,), and what is taken off their displacements, (H, 3, 3)
        self.band = torch.as_tensor(band), torch.as_tensor(along, dtype=torch.float32)
        share = np.bincount(p.vertex_patch, self._refinement @ firmly) / np.bincount(p.vertex_patch)
        #: (K, 1): how much of each patch is held
        self.held = torch.as_tensor(share[:, None], dtype=torch.float32)

    # ---- fields of the vertices at the metric's points -------------------------------------------

    @cached_property
    def field(self) -> SparseMatrix:
        """A SparseMatrix (3 P, N): value, u- and v-derivative, at the P points of the metric, of
        any field given at the vertices.
        """
        return SparseMatrix(self._field)

    @cached_property
    def metric_weights(self) -> torch.Tensor:
        """Blend weights at the metric's points and their derivatives along u and v: (P, 3, J)."""
        return torch.as_tensor(
            self._field @ self.garment.blend_weights.double().numpy(), dtype=torch.float32
        ).unflatten(0, (-1, 3))

    @cached_property
    def metric_basis(self) -> torch.Tensor:
        """Monomials at the metric's points and their derivatives along u and v: (K, 3 M, A)."""
        return self._of_basis(self.metric_uv)

    @cached_property
    def boundary_basis(self) -> torch.Tensor:
        """The same at the boundary points, on both sides: (2, B, 3, A)."""
        return self._of_basis(self.boundary_uv.transpose(0, 1)[:, :, None])

    def _of_basis(self, uv):
        stack = basis_and_slopes(uv, self.order)
        return stack.flatten(1, 2) if stack.ndim == 4 else stack.squeeze(2)

    # ---- deformation -----------------------------------------------------------------------------

    def changes(self, deformation: Deformation) -> torch.Tensor:
        """The changes of the matrices C_k, (K, A, T, 3) [m], by a :class:`Deformation` of T
        frames.
        """
        s, R, alpha = (x.to(deformation.alpha) for x in (self.frame.s, self.frame.R, self.alpha))
        grown = deformation.scale.exp()[..., None]
        height = grown * (alpha + deformation.alpha) - alpha
        _T, K, A = height.shape
        wide = (
            torch.nn.functional.pad((grown - 1), (1, A - 2)),
            torch.nn.functional.pad((grown - 1), (2, A - 3)),
        )
        C = torch.stack([wide[0], wide[1], height], -1)
        C = torch.cat([C[:, :, :1] + deformation.translation[:, :, None], C[:, :, 1:]], 2)
        change = torch.einsum("tkac,kdc->katd", C, s[:, None, None] * R)
        plane = (self.planes @ deformation.drift.transpose(0, 1)).unflatten(0, (K, 3))
        return change + torch.nn.functional.pad(plane, (0, 0, 0, 0, 0, A - 3))

    def displacement(self, changes: torch.Tensor) -> torch.Tensor:
        """Displacements of the vertices in the rest space, (N, T, 3) [m]."""
        moved = self.blend @ changes.flatten(0, 1)
        band, along = self.band
        return moved.index_add(0, band, moved[band] @ along, alpha=-1) if len(band) else moved

    def at_metric(self, changes: torch.Tensor) -> torch.Tensor:
        """Displacement at the metric's points and its derivatives along u and v, each patch by its
        own chart: (P, 3, T, 3) [m].
        """
        K, A, T, _ = changes.shape
        return (
            (self.metric_basis @ changes.reshape(K, A, T * 3))
            .unflatten(1, (-1, 3))
            .flatten(0, 1)
            .unflatten(-1, (T, 3))
        )

    def at_boundary(self, changes: torch.Tensor) -> torch.Tensor:
        """Displacement and its derivatives along u and v at the boundary points by the chart of
        each side: (2, B, 3, T, 3) [m].
        """
        K, A, T, _ = changes.shape
        flat = changes.reshape(K, A, T * 3)
        return torch.stack(
            [
                basis @ flat[patch]
                for basis, patch in zip(self.boundary_basis, self.boundary_patch.T)
            ]
        ).unflatten(-1, (T, 3))

    @cached_property
    def boundary_tangents(self) -> torch.Tensor:
        """Tangents of the template along u and v at the boundary points, on each side: (2, B, 2, 3)
        [m].
        """
        alpha, s, R = self.alpha.float(), self.frame.s.float(), self.frame.R.float()
        out = []
        for basis, patch in zip(self.boundary_basis, self.boundary_patch.T):
            slope = (basis[:, 1:] @ alpha[patch][..., None])[..., 0]  # (B, 2)
            tangents = torch.cat([torch.eye(2).expand(len(slope), 2, 2), slope[..., None]], -1)
            out.append(s[patch][:, None, None] * tangents @ R[patch].mT)
        return torch.stack(out)

    @cached_property
    def features(self) -> tuple[torch.Tensor, ...]:
        """What the network reads of each patch: ``alpha`` (K, A), ``orientation`` (K, 7) (log s / 5
        cm, two axes of R), ``centre`` (K, 3), ``looseness`` (K, 3) (least, mean and greatest
        distance of its vertices from the standard body, as asinh(d / 5 mm)), ``held`` (K, 1) and
        ``blend_weights`` (K, J).
        """
        R = self.frame.R.float()
        orientation = torch.cat(
            [(self.frame.s.float() / 0.05).log()[:, None], R[:, :, 2], R[:, :, 1]], 1
        )
        return (
            self.alpha.float(),
            orientation,
            self.frame.T.float(),
            self.looseness,
            self.held,
            torch.as_tensor(self.blend_weights).float(),
        )

    @cached_property
    def edges(self) -> torch.Tensor:
        """Edges of the mesh, (E, 2), each once."""
        return torch.as_tensor(mesh.edges_of(self.garment.faces.numpy())[0])

    @cached_property
    def vertex_area(self) -> torch.Tensor:
        """The area that each vertex speaks for, (N,) [m^2]."""
        faces = self.garment.faces.numpy()
        area = np.repeat(mesh.areas(self.garment.vertices.double().numpy(), faces) / 3, 3)
        return torch.as_tensor(
            np.bincount(faces.ravel(), area, minlength=len(self.garment.vertices)),
            dtype=torch.float32,
        )
