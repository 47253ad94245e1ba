"""Patched surfaces: a mesh as jets in canonical frames, that can be evaluated anywhere and at any
resolution (paper, section "PolyFit").
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from polyfit import jets, mesh
from polyfit.errors import InputError, number
from polyfit.jets import CanonicalFrame

from .patches import Patches
from .refine import refined


@dataclass(frozen=True)
class PatchedSurface:
    """S_k = {O_k, phi_k(u, v)}, k = 1..K: patches, their orientations, their jets, and the chart of
    every vertex.

    ``patches``: the :class:`polyfit.patches.Patches` of the mesh; ``frame``: the orientations,
    (K,); ``alpha`` (K, A): the coefficients, in charts whose z points to the side of the faces'
    normals; ``order`` (K,): the order fitted; ``uv`` (E, 2): chart coordinates of the entries,
    those of the jet's point nearest to the vertex. ``dataclasses.replace`` with another ``alpha``
    or ``frame`` gives the deformed surface on the same charts; all that follows from them is
    differentiable. Charts overlap at the patches' boundaries, where :meth:`at` blends them.
    """

    patches: Patches
    frame: CanonicalFrame
    alpha: Tensor
    order: Tensor
    uv: Tensor

    def __len__(self) -> int:
        """K, the number of patches."""
        return len(self.alpha)

    @property
    def parameters(self) -> int:
        """How many numbers hold the surface: the coefficients, and scale, rotation (3) and
        translation (3) of each patch.
        """
        return len(self) * (self.alpha.shape[1] + 7)

    @classmethod
    def fit(
        cls,
        patches: Patches,
        order: int = 4,
        *,
        polyfit: Callable[..., Any] | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> "PatchedSurface":
        """Fit a jet to each of the :class:`polyfit.patches.Patches`, weighted by area, in its PCA
        frame.

        ``polyfit``, a :class:`polyfit.PolyFit`, finds frames and jets in its own way and order
        instead.
        """
        _check_how(polyfit, dtype, device)
        index, exists = patches.padded
        tensor = lambda x, kind=dtype: torch.as_tensor(x, dtype=kind, device=device)
        points, mask = (
            tensor(patches.vertices[patches.entry_vertex[index]]),
            tensor(exists, torch.bool),
        )
        weights = tensor(patches.entry_weight[index])
        if polyfit is None:
            frame = CanonicalFrame.from_points(points, mask, weights=weights)
            jet = jets.fit(frame.to_chart(points), order, weights=weights, mask=mask)
        else:
            found = polyfit(points, weights=weights, mask=mask)
            frame, jet = found.frame, found.jet
        under = (frame.R[:, :, 2] * tensor(patches.direction)).sum(1) < 0
        over = frame.turned_over()
        frame = CanonicalFrame(frame.s, torch.where(under[:, None, None], over.R, frame.R), frame.T)
        alpha = torch.where(under[:, None], jets.turned_over(jet.alpha), jet.alpha)
        uv = jets.nearest(alpha, frame.to_chart(points))[mask]
        return cls(patches, frame, alpha, jet.order, uv)

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        count: int | None = None,
        order: int = 4,
        *,
        rounds: int = 5,
        acvd: bool = False,
        where: str = "mesh",
        polyfit: Callable[..., Any] | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> "PatchedSurface":
        """Cut the mesh (N, 3) [m], (F, 3) into patches (:meth:`polyfit.patches.Patches.cut`),
        :meth:`fit` them with ``polyfit``, ``dtype`` and ``device``, and let the boundaries move to
        where the jets fit best, ``rounds`` times (:func:`polyfit.patches.refine.refined`).
        ``acvd``: by plain ACVD, whose boundaries stay, as in the paper. Raises InputError for a
        mesh that lies too far from the origin for single precision
        (:func:`polyfit.mesh.centred`).
        """
        rounds = number("rounds", rounds, 0, whole=True)
        patches = Patches.cut(vertices, faces, count, acvd=acvd, where=where)
        options: dict[str, Any] = dict(polyfit=polyfit, dtype=dtype, device=device)
        if mesh.centred(patches.vertices)[1] is not None:
            raise InputError(
                f"{where}: it lies more than 1000 times its extent from the origin, too far for"
                " single precision; move it there (polyfit.mesh.centred)"
            )
        return refined(cls.fit(patches, order, **options), 0 if acvd else rounds, **options)

    @property
    def residual(self) -> Tensor:
        """Distance of each entry's vertex from its chart's jet, (E,) [m], to first order: along z,
        divided by the slope.
        """
        vertices = torch.as_tensor(
            self.patches.vertices, dtype=self.uv.dtype, device=self.uv.device
        )
        return self.distance(
            self._index(self.patches.entry_patch), vertices[self._index(self.patches.entry_vertex)]
        )

    # ---- patches and chart coordinates -> the surface --------------------------------------------

    def points(self, patch: Tensor, uv: Tensor) -> Tensor:
        """Points (..., 3) [m] at uv (..., 2) of the patches ``patch`` (...,)."""
        z = self._of(jets.height, patch, uv)
        return (
            self._turned(patch, torch.cat([uv, z[..., None]], -1)) * self.frame.s[patch][..., None]
            + self.frame.T[patch]
        )

    def distance(self, patch: Tensor, points: Tensor) -> Tensor:
        """Distances (...,) [m] of points (..., 3) [m] from the jets of the patches ``patch``
        (...,), to first order: along z, divided by the slope."""
        frame = self.frame[patch]
        x = frame.to_chart(points[..., None, :])
        z, zu, zv = (
            d.squeeze(-1)
            for d in jets.derivatives(self.alpha[patch], x[..., :2], (0, 0), (1, 0), (0, 1))
        )
        return frame.s * (z - x[..., 0, 2]).abs() / (1 + zu * zu + zv * zv).sqrt()

    def tangents(self, patch: Tensor, uv: Tensor) -> tuple[Tensor, ...]:
        """Derivatives of the points along u and v, each (..., 3) [m]."""
        return tuple(
            self._turned(patch, t) * self.frame.s[patch][..., None]
            for t in self._of(jets.tangents, patch, uv)
        )

    def normals(self, patch: Tensor, uv: Tensor) -> Tensor:
        """Unit normals (..., 3), to the side of the faces' normals."""
        return self._turned(patch, self._of(jets.normal, patch, uv))

    def metric(self, patch: Tensor, uv: Tensor) -> Tensor:
        """First fundamental forms (..., 2, 2) [m^2]."""
        return self._of(jets.metric, patch, uv) * self.frame.s[patch][..., None, None] ** 2

    def principal_curvatures(self, patch: Tensor, uv: Tensor) -> Tensor:
        """Principal curvatures (..., 2) [1/m], the smaller first; positive where the surface bends
        towards its normal.
        """
        return self._of(jets.principal_curvatures, patch, uv) / self.frame.s[patch][..., None]

    def _of(self, function: Callable[[Tensor, Tensor], Any], patch: Tensor, uv: Tensor) -> Any:
        """``function`` of jets at single points."""
        if patch.numel() and not 0 <= int(patch.min()) <= int(patch.max()) < len(self):
            raise InputError(
                f"patches {int(patch.min())} to {int(patch.max())}; 0 to {len(self) - 1} exist"
            )
        found = function(self.alpha[patch], uv[..., None, :])
        squeeze = lambda x: x.squeeze(patch.ndim)
        return tuple(map(squeeze, found)) if isinstance(found, tuple) else squeeze(found)

    def _turned(self, patch: Tensor, x: Tensor) -> Tensor:
        return (self.frame.R[patch] @ x[..., None])[..., 0]

    # ---- points of the mesh -> patches and chart coordinates -------------------------------------

    @cached_property
    def vertex_patch(self) -> Tensor:
        """The patch of each vertex of ``patches.vertices``, (M,); those of the given mesh come
        first.
        """
        return self._index(self.patches.vertex_patch)

    @property
    def vertex_uv(self) -> Tensor:
        """The chart coordinates of each vertex in its patch, (M, 2)."""
        return self.uv[self._index(self.patches.vertex_entry)]

    def vertices(self) -> Tensor:
        """The vertices on the surface, (M, 3) [m], in the order of ``patches.vertices``."""
        return self.points(self.vertex_patch, self.vertex_uv)

    def at(self, face: ArrayLike, barycentric: ArrayLike, what: str = "points") -> Tensor:
        """The surface at points of the given mesh, by face (P,) and barycentric coordinates (P, 3):
        (P, 3) [m].

        ``what``: "points" or "normals" (unit). Where a point's face (of ``patches.faces``) touches
        several patches, theirs are blended in proportion to the point's nearness to their corners;
        so neighbouring patches join without a gap.
        """
        face, barycentric = self.patches.locate(np.asarray(face), np.asarray(barycentric))
        return self._blended(face, barycentric, what)

    def sample(
        self, count: int, seed: int = 0, what: Sequence[str] = ("points",)
    ) -> tuple[Tensor, ...]:
        """``count`` points drawn evenly from the mesh's area, on the surface: a tuple of what
        ``what`` names, as in :meth:`at`.
        """
        count = number("count", count, 0, whole=True)
        rng = np.random.default_rng(number("seed", seed, 0, whole=True))
        area = mesh.areas(self.patches.vertices, self.patches.faces)
        face = rng.choice(len(area), count, p=area / area.sum())
        barycentric = rng.dirichlet((1, 1, 1), count)
        return tuple(self._blended(face, barycentric, w) for w in what)

    def resampled(self, parts: int = 4, smoothing: int = 0) -> tuple[Tensor, Tensor]:
        """A mesh of the surface with every side of the given mesh's faces cut in ``parts``:
        ``(vertices (N', 3) [m], faces (parts^2 F, 3) int64)``.

        The given mesh's vertices come first. ``smoothing``: how often :meth:`smoothed` is applied.
        Raises InputError for ``parts`` below 1.
        """
        parts = number("parts", parts, 1, whole=True)
        smoothing = number("smoothing", smoothing, 0, whole=True)
        faces, face, barycentric = mesh.refined(self.patches.given, parts)
        vertices = self.at(face, barycentric)
        seam = self.patches.on_boundary[self.patches.locate(face, barycentric)[0]]
        faces = self._index(faces)
        return smoothed(vertices, faces, self._index(seam), smoothing), faces

    def _blended(self, face: np.ndarray, barycentric: np.ndarray, what: str) -> Tensor:
        if what not in ("points", "normals"):
            raise InputError(f"what = {what!r}; points or normals is needed")
        value = self.points if what == "points" else self.normals
        on_boundary = self.patches.on_boundary[face]
        entries, patch = self.patches.face_entries[face], self.patches.corner_patch[face]
        b = torch.as_tensor(barycentric, dtype=self.uv.dtype, device=self.uv.device)
        at = lambda e, p, b: value(self._index(p), (b[..., None] * self.uv[self._index(e)]).sum(-2))
        out = self.uv.new_empty(len(face), 3)
        pure = at(entries[~on_boundary, 0], patch[~on_boundary, 0], b[self._index(~on_boundary)])
        rows = b[self._index(on_boundary)]
        blend = (rows[..., None] * at(entries[on_boundary], patch[on_boundary], rows[:, None])).sum(
            1
        )
        if what == "normals":
            blend = torch.nn.functional.normalize(blend, dim=-1)
        out = out.index_put((self._index(np.flatnonzero(~on_boundary)),), pure)
        return out.index_put((self._index(np.flatnonzero(on_boundary)),), blend)

    # ---- boundaries ------------------------------------------------------------------------------

    @cached_property
    def boundary_patch(self) -> Tensor:
        """The patches (B, 2) that hold each boundary point, the lower first. ``patches.neighbours``
        lists which patches meet.
        """
        return self._index(self.patches.entry_patch[self.patches.boundary])

    @property
    def boundary_uv(self) -> Tensor:
        """Each boundary point's chart coordinates in the two patches, (B, 2, 2)."""
        return self.uv[self._index(self.patches.boundary)]

    def boundary(self) -> tuple[Tensor, Tensor]:
        """The boundary points by their two patches, ``(points (B, 2, 3) [m], normals (B, 2, 3))``:
        what a boundary loss compares.
        """
        patch, uv = self.boundary_patch, self.boundary_uv
        return self.points(patch, uv), self.normals(patch, uv)

    def _index(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=self.uv.device)

    # ---- as a whole ------------------------------------------------------------------------------

    def to(self, *args: Any, **kwargs: Any) -> "PatchedSurface":
        """The surface in another dtype or on another device."""
        move = lambda x: x.to(*args, **kwargs)
        order = self.order.to(move(self.alpha).device)
        return dataclasses.replace(
            self,
            frame=self.frame.to(*args, **kwargs),
            alpha=move(self.alpha),
            order=order,
            uv=move(self.uv),
        )


def _check_how(polyfit: Any, dtype: Any, device: Any) -> None:
    """Raises InputError for what :meth:`PatchedSurface.fit` cannot be done with."""
    if polyfit is not None and not callable(polyfit):
        raise InputError(f"polyfit = {polyfit!r}; a PolyFit (PolyFit.pretrained()) is needed")
    if dtype not in (torch.float32, torch.float64):
        raise InputError(f"dtype = {dtype!r}; torch.float32 or torch.float64 is needed")
    try:
        torch.empty(0, device=device)
    except (TypeError, ValueError, RuntimeError, AssertionError):  # the last without CUDA
        raise InputError(f"device = {device!r}; one that this torch has is needed") from None


def smoothed(vertices: Tensor, faces: Tensor, where: Tensor, times: int = 1) -> Tensor:
    """Vertices (N, 3) with those of ``where`` (N,) bool moved ``times`` times halfway to the mean
    of their neighbours (Laplacian smoothing). Raises InputError for another ``where``.

    Vertices at the mesh's own boundary only feel their neighbours along it, so that the outline
    does not shrink. Differentiable.
    """
    times = number("times", times, 0, whole=True)
    if where.dtype != torch.bool or where.shape != vertices.shape[:1]:
        found = f"where of shape {tuple(where.shape)}, {where.dtype}"
        raise InputError(f"{found}; ({len(vertices)},) of bool is needed")
    if not times:
        return vertices
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    edges, uses = torch.unique(sides, dim=0, return_counts=True)
    rim = torch.zeros_like(where)
    rim[edges[uses == 1].ravel()] = True
    start = torch.cat([edges, edges.flip(1)])
    outline = torch.cat([uses, uses]) == 1
    a, b = start[where[start[:, 0]] & (outline | ~rim[start[:, 0]])].T
    count = torch.bincount(a, minlength=len(vertices)).clamp(min=1)[:, None].to(vertices.dtype)
    moves = (torch.bincount(a, minlength=len(vertices)) > 0)[:, None]
    for _ in range(times):
        mean = torch.zeros_like(vertices).index_add(0, a, vertices[b]) / count
        vertices = torch.where(moves, (vertices + mean) / 2, vertices)
    return vertices
