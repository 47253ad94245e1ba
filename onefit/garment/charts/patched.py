"""A garment cut into patches, and what follows from its patches' deformation: positions and
tangents, linear in the jets' coefficients.

In the chart of patch k a deformed jet is p(u, v) = s' R (u, v, sum_b alpha'_b m_b(u, v)) + T', m_b
the monomials. Since u, v and 1 are monomials too, p is linear in them: p = C_k m(u, v), with a
matrix C_k (3, A) for each patch. So the displacement of the whole garment, at any resolution, is
one sparse matrix, made once, times the changes of the C_k (:attr:`PatchedGarment.blend`). No jet is
evaluated frame by frame.
"""

import copy
import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch

from onefit.garment.binding import surface_of
from onefit.garment.waistband import held
from polyfit import jets, mesh
from polyfit.jets import CanonicalFrame
from polyfit.patches import PatchedSurface

# Charts reach this far beyond the patch, in units of its radius, where they fade into their
# neighbours'; at most so many meet in a point.
REACH = 1.3
MEET = 4
# How much jets are held to the chart's plane where the patch has no points, see _steady_jets.
STEADY = 1e-3
# A patch that fills less of its chart's disc is a strip (a hem turned in), of which networks know
# little: its neighbours have more say.
STRIP = 0.2
ROOM = 0.005, 0.1  # [m]; how far a patch may be thought to go: its drift of one
# width of the Gaussian by which patches around share their drift, in distances of neighbours
AROUND = 1.0
LEVEL = 1e-2  # how much the slopes of their plane are held to zero
LOOSE = 0.005  # [m]; a patch much nearer to the body than this lies on it
# Points of each patch at which the metric is held, and boundary points for each pair of patches
# that meet.
METRIC_POINTS = 16
BOUNDARY_POINTS = 6


@dataclass(frozen=True)
class Deformation:
    """What the network says of each patch in each frame: ``alpha`` (T, K, A) added to the
    coefficients, ``translation`` (T, K, 3) in the chart and in units of s, ``scale`` (T, K), the
    logarithm of s'/s, and ``drift`` (T, K, 3), a displacement along the rest space's axes, in units
    of the patch's room, that the cloth around shares: each patch takes the plane through those of
    the patches around it, so that it turns and stretches with them. Zeros leave the garment as it
    is."""

    alpha: torch.Tensor
    translation: torch.Tensor
    scale: torch.Tensor
    drift: torch.Tensor


class SparseMatrix:
    """A constant sparse matrix (rows, columns) to multiply dense ones with, on the left;
    differentiable in the dense one.
    """

    def __init__(self, matrix, device=None, dtype=torch.float32):
        matrix = sp.csr_matrix(matrix)
        self.shape = matrix.shape
        self._forward, self._backward = (_csr(m, device, dtype) for m in (matrix, matrix.T.tocsr()))

    def __matmul__(self, dense):
        """(columns, ...) -> (rows, ...)."""
        flat = dense.reshape(len(dense), -1).contiguous()
        return (
            _Product.apply(flat, self._forward, self._backward).unflatten(1, dense.shape[1:])
            if dense.ndim > 1
            else (self @ dense[:, None])[:, 0]
        )

    def to(self, device):
        moved = object.__new__(SparseMatrix)
        moved.shape, moved._forward, moved._backward = (
            self.shape,
            self._forward.to(device),
            self._backward.to(device),
        )
        return moved


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, dense, matrix, transposed):
        ctx.transposed = transposed
        return matrix @ dense

    @staticmethod
    def backward(ctx, gradient):
        return ctx.transposed @ gradient.contiguous(), None, None


def _csr(matrix, device, dtype):
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="Sparse (CSR tensor support|invariant checks)", category=UserWarning
        )
        return torch.sparse_csr_tensor(
            torch.as_tensor(matrix.indptr.astype(np.int64)),
            torch.as_tensor(matrix.indices.astype(np.int64)),
            torch.as_tensor(matrix.data, dtype=dtype),
            matrix.shape,
            device=device,
        )


class PatchedGarment:
    """A :class:`onefit.Garment` as patches T_k = {O_k, phi_k} (paper, section "OneFit"),
    with all that draping and the losses need.

    ``frame`` (K,), ``alpha`` (K, A): orientations and jets, z outwards and v along the bone that
    moves the patch most, so that patches of different garments at the same place of the body are
    alike; ``blend_weights`` (K, J), those of the patch. N vertices, of the garment's own mesh; P =
    K M points where the metric is held. Lengths in metres, in the rest space.
    """

    def __init__(self, garment, body, *, patches=None, order=4, seed=0):
        """Cut ``garment`` into ``patches`` (by default as many as the paper has for its area);
        ``body``: the standard one.
        """
        self.garment = garment
        vertices, faces = garment.vertices.double().numpy(), garment.faces.numpy()
        surface = PatchedSurface.from_mesh(
            vertices, faces, patches, order, dtype=torch.float64, where=garment.name
        )
        p = surface.patches
        self._refinement = _refinement(len(vertices), p.given, p.levels)
        weights = self._refinement @ garment.blend_weights.double().numpy()
        area = np.bincount(p.entry_patch, p.entry_weight)
        of_patch = (
            np.stack(
                [np.bincount(p.entry_patch, p.entry_weight * w) for w in weights[p.entry_vertex].T],
                1,
            )
            / area[:, None]
        )
        self.frame, self.alpha, uv = _along_bones(surface, of_patch, body)
        self.blend_weights = of_patch
        self.order = order
        rng = np.random.default_rng(seed)
        self._entries(p, uv, rng)
        self._blend(p, vertices)
        surface = surface_of(body)
        self._hold(p, vertices, held(vertices, faces, body.joints.cpu().double().numpy()), surface)
        self.looseness = _looseness(p, surface)
        #: (K,) [m]: a patch's mean distance from the standard body, within ROOM
        self.room = np.clip(LOOSE * np.sinh(self.looseness[:, 1].double().numpy()), *ROOM)
        #: a SparseMatrix (3 K, K): the entries of 1, u and v [m] of the plane that drifts of the
        #: patches around make in each chart
        self.planes = SparseMatrix(_planes(p.neighbours, self.frame) @ sp.diags(self.room))

    def __len__(self):
        """K, the number of patches."""
        return len(self.alpha)

    def to(self, device):
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
        move = lambda x: (
            tuple(map(move, x)) if isinstance(x, tuple) else x.to(device) if hasattr(x, "to") else x
        )
        vars(moved).update({name: move(value) for name, value in vars(self).items()})
        return moved

    # ---- set-up, in NumPy and float64 ------------------------------------------------------------

    def _entries(self, p, uv, rng):
        """Points where the metric is held, boundary points, and the matrices that differentiate a
        field of the vertices there.
        """
        own = p.vertex_patch[p.entry_vertex] == p.entry_patch
        ends = np.cumsum(np.bincount(p.entry_patch))
        points, rows, columns, values = [], [], [], []
        for k, (first, last) in enumerate(zip(np.concatenate([[0], ends[:-1]]), ends)):
            e = np.arange(first, last)
            mine = e[own[first:last]] if own[first:last].sum() >= METRIC_POINTS else e
            chosen = mine[_spread(uv[mine], METRIC_POINTS, rng)]
            points.append(chosen)
            # a field of the vertices as a jet: least squares, weighted by area, held by a trace of
            # a ridge
            b, w = _basis(uv[e], self.order), p.entry_weight[e, None]
            gram = (b * w).T @ b
            fit = np.linalg.solve(
                gram + 1e-7 * np.trace(gram) * np.eye(len(gram)), (b * w).T
            )  # (A, E_k)
            stack = np.stack(
                [_basis(uv[chosen], self.order, *d) @ fit for d in ((0, 0), (1, 0), (0, 1))], 1
            )  # (M, 3, E_k)
            rows.append(np.repeat(3 * METRIC_POINTS * k + np.arange(3 * METRIC_POINTS), len(e)))
            columns.append(np.tile(p.entry_vertex[e], 3 * METRIC_POINTS))
            values.append(stack.reshape(-1))
        points = np.stack(points)  # (K, M)
        field = sp.csr_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            (3 * points.size, len(p.vertices)),
        )
        #: (3 P, N): value and derivatives along u and v, at the points of the metric, of a field
        #: given at the vertices
        self._field = (field @ self._refinement).tocsr()
        self.metric_uv = torch.as_tensor(uv[points], dtype=torch.float32)
        nearest = self._refinement[p.entry_vertex[points.ravel()]]
        #: (P,): the vertex of the garment's mesh nearest to each point of the metric
        self.metric_vertex = torch.as_tensor(np.asarray(nearest.argmax(axis=1)).ravel())
        pairs = p.boundary
        key = p.entry_patch[pairs] @ [len(p.label), 1]
        shuffled = rng.permutation(len(pairs))
        order = shuffled[np.argsort(key[shuffled], kind="stable")]
        rank = np.arange(len(order)) - np.searchsorted(key[order], key[order])
        pairs = pairs[np.sort(order[rank < BOUNDARY_POINTS])]
        self.boundary_patch = torch.as_tensor(p.entry_patch[pairs])  # (B, 2)
        self.boundary_uv = torch.as_tensor(uv[pairs], dtype=torch.float32)  # (B, 2, 2)

    def _blend(self, p, vertices):
        """The sparse matrix (N, K A) from changes of the C_k to displacements of the vertices: a
        partition of unity of the charts.
        """
        count, A = len(vertices), self.alpha.shape[1]
        own = self.vertex_patch = p.vertex_patch[:count]  # (N,): the patch of each vertex
        near = sp.coo_matrix(
            (np.ones(len(p.neighbours)), p.neighbours.T), (len(self), len(self))
        ).tocsr()
        near = ((near + near.T + sp.identity(len(self))) > 0).tocsr()
        candidates = near[own].tocoo()  # (N, K): own patch and those that it meets
        row, patch = candidates.row, candidates.col
        x = (
            np.einsum(
                "ei,eij->ej",
                vertices[row] - self.frame.T.numpy()[patch],
                self.frame.R.numpy()[patch],
            )
            / self.frame.s.numpy()[patch, None]
        )
        r = np.linalg.norm(x[:, :2], axis=1) / REACH
        near = np.where(
            patch == own[row],
            np.maximum(1 - r**2, 0.02),
            np.maximum(1 - r**2 - np.maximum(np.abs(x[:, 2]) - 0.5, 0), 0),
        )
        area = np.bincount(p.entry_patch, p.entry_weight) / (
            np.pi * self.frame.s.numpy() ** 2
        )  # as a share of the chart's disc
        weight = (near * np.minimum(area / STRIP, 1)[patch]) ** 3
        keep = _largest(row, weight, MEET) & (weight > 0)
        row, patch, weight, x = row[keep], patch[keep], weight[keep], x[keep]
        weight /= np.bincount(row, weight, minlength=count)[row]
        b = weight[:, None] * _basis(x[:, :2], self.order)
        columns = patch[:, None] * A + np.arange(A)
        #: (N, K A), a SparseMatrix
        self.blend = SparseMatrix(
            sp.csr_matrix((b.ravel(), (np.repeat(row, A), columns.ravel())), (count, len(self) * A))
        )

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
    def field(self):
        """A SparseMatrix (3 P, N): value, u- and v-derivative, at the P points of the metric, of
        any field given at the vertices.
        """
        return SparseMatrix(self._field)

    @cached_property
    def metric_weights(self):
        """Blend weights at the metric's points and their derivatives along u and v: (P, 3, J)."""
        return torch.as_tensor(
            self._field @ self.garment.blend_weights.double().numpy(), dtype=torch.float32
        ).unflatten(0, (-1, 3))

    @cached_property
    def metric_basis(self):
        """Monomials at the metric's points and their derivatives along u and v: (K, 3 M, A)."""
        return self._of_basis(self.metric_uv)

    @cached_property
    def boundary_basis(self):
        """The same at the boundary points, on both sides: (2, B, 3, A)."""
        return self._of_basis(self.boundary_uv.transpose(0, 1)[:, :, None])

    def _of_basis(self, uv):
        stack = torch.stack([jets.basis(uv, self.order, *d) for d in ((0, 0), (1, 0), (0, 1))], -2)
        return stack.flatten(1, 2) if stack.ndim == 4 else stack.squeeze(2)

    # ---- deformation -----------------------------------------------------------------------------

    def changes(self, deformation):
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

    def displacement(self, changes):
        """Displacements of the vertices in the rest space, (N, T, 3) [m]."""
        moved = self.blend @ changes.flatten(0, 1)
        band, along = self.band
        return moved.index_add(0, band, moved[band] @ along, alpha=-1) if len(band) else moved

    def at_metric(self, changes):
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

    def at_boundary(self, changes):
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
    def boundary_tangents(self):
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
    def features(self):
        """What the network reads of each patch: ``alpha`` (K, A), ``orientation`` (K, 7) (log s / 5
        cm, two axes of R), ``centre`` (K, 3), ``looseness`` (K, 3) (least, mean and greatest
        distance of its vertices from the standard body, as asinh(d / LOOSE)), ``held`` (K, 1) and
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
    def edges(self):
        """Edges of the mesh, (E, 2), each once."""
        return torch.as_tensor(mesh.edges_of(self.garment.faces.numpy())[0])

    @cached_property
    def vertex_area(self):
        """The area that each vertex speaks for, (N,) [m^2]."""
        faces = self.garment.faces.numpy()
        area = np.repeat(mesh.areas(self.garment.vertices.double().numpy(), faces) / 3, 3)
        return torch.as_tensor(
            np.bincount(faces.ravel(), area, minlength=len(self.garment.vertices)),
            dtype=torch.float32,
        )


def _basis(uv, order, du=0, dv=0):
    return jets.basis(torch.as_tensor(uv), order, du, dv).numpy()


def _refinement(count, given, levels):
    """The matrix (M, N) from the vertices of a mesh to those after ``levels`` subdivisions."""
    matrix, faces = sp.identity(count, format="csr"), given
    for _ in range(levels):
        faces, edges = mesh.subdivided(faces)
        rows = np.repeat(np.arange(len(edges)), 2)
        middle = sp.csr_matrix(
            (np.full(edges.size, 0.5), (rows, edges.ravel())), (len(edges), matrix.shape[0])
        )
        matrix = sp.vstack([matrix, middle @ matrix]).tocsr()
    return matrix


def _along_bones(surface, weights, body):
    """Frames turned about z until v lies along the bone of the joint that ``weights`` (K, J) give
    most, and the jets there: (frame, alpha, uv (E, 2) NumPy).
    """
    p = surface.patches
    bones = _bones(body)[torch.as_tensor(weights).argmax(1)]
    along = (surface.frame.R.mT @ bones[..., None])[..., 0]
    angle = torch.atan2(-along[:, 0], along[:, 1])
    cos, sin, zero, one = angle.cos(), angle.sin(), 0 * angle, 1 + 0 * angle
    turn = torch.stack(
        [torch.stack(row, -1) for row in [(cos, -sin, zero), (sin, cos, zero), (zero, zero, one)]],
        -2,
    )
    frame = CanonicalFrame(surface.frame.s, surface.frame.R @ turn, surface.frame.T)
    patch = torch.as_tensor(p.entry_patch)
    points = torch.as_tensor(p.vertices[p.entry_vertex]) - frame.T[patch]
    x = (frame.R[patch].mT @ points[..., None])[..., 0] / frame.s[patch, None]
    alpha = _steady_jets(
        x,
        patch,
        torch.as_tensor(p.entry_weight),
        len(weights),
        jets.order_of(surface.alpha.shape[1]),
    )
    return frame, alpha, jets.nearest(alpha[patch], x[:, None])[:, 0].numpy()


def _planes(pairs, frame):
    """The matrix (3 K, K) from values of the patches to the planes a + b u + c v of the charts:
    least squares over the patches around, two rings of the ``pairs`` (B, 2) that meet, weighted by
    a Gaussian of their distance; slopes are held by a trace of a ridge.
    """
    R, s, T = (x.numpy() for x in (frame.R, frame.s, frame.T))
    ring = sp.coo_matrix((np.ones(len(pairs)), pairs.T), (len(T), len(T))).tocsr()
    ring = ring + ring.T + sp.identity(len(T))
    near = (ring @ ring).tocsr()
    length = (
        np.median(np.linalg.norm(T[pairs[:, 0]] - T[pairs[:, 1]], axis=1)) if len(pairs) else 1.0
    )
    rows, columns, values = [], [], []
    for k in range(len(T)):
        around = near[k].indices
        x = (T[around] - T[k]) @ R[k] / s[k]
        b = np.column_stack([np.ones(len(around)), x[:, :2]])
        w = np.exp(-((np.linalg.norm(T[around] - T[k], axis=1) / (AROUND * length)) ** 2))[:, None]
        gram = (b * w).T @ b + np.diag([0, LEVEL, LEVEL]) * w.sum()
        values.append(np.linalg.solve(gram, (b * w).T).ravel())
        rows.append(np.repeat(3 * k + np.arange(3), len(around)))
        columns.append(np.tile(around, 3))
    return sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (3 * len(T), len(T)),
    )


def _looseness(p, surface):
    """Least, mean and greatest distance of each patch's vertices from the body's ``surface``, as
    asinh(d / LOOSE): (K, 3).
    """
    distance = surface(p.vertices).distance
    order = np.argsort(p.vertex_patch, kind="stable")
    count = np.bincount(p.vertex_patch)
    first = np.cumsum(count) - count
    least, total, greatest = (
        ufunc.reduceat(distance[order], first) for ufunc in (np.minimum, np.add, np.maximum)
    )
    return torch.as_tensor(
        np.arcsinh(np.stack([least, total / count, greatest], 1) / LOOSE), dtype=torch.float32
    )


def _steady_jets(x, patch, weight, count, order):
    """Jets (K, A) of the points ``x`` (E, 3) of the charts ``patch`` (E,): least squares, held by
    STEADY times the mean square of the jet over the chart's unit disc.

    A strip of cloth (a hem turned in, a waistband) does not determine a jet across it: coefficients
    a hundred times those of other patches fit it a little better, and a network that reads them
    answers with nonsense.
    """
    b = jets.basis(x[:, :2], order)
    share = (weight / torch.zeros(count, dtype=x.dtype).index_add(0, patch, weight)[patch])[:, None]
    A = b.shape[1]
    gram = (
        x.new_zeros(count, A * A)
        .index_add(0, patch, ((share * b)[:, :, None] * b[:, None]).flatten(1))
        .unflatten(1, (A, A))
    )
    right = x.new_zeros(count, A).index_add(0, patch, share * b * x[:, 2:])
    ring = torch.linspace(0, 2 * np.pi, 33, dtype=x.dtype)[1:]
    radius = torch.linspace(0, 1, 33, dtype=x.dtype)[1:].sqrt()  # rings of equal area
    disc = jets.basis(
        torch.stack([torch.outer(radius, ring.cos()), torch.outer(radius, ring.sin())], -1).flatten(
            0, 1
        ),
        order,
    )
    return torch.linalg.solve(gram + STEADY * disc.T @ disc / len(disc), right)


def _bones(body):
    """Directions (J, 3) of the bones that begin in each joint: to the mean of its children, for a
    last joint from its parent.
    """
    joints, parents = body.joints.double(), torch.as_tensor(body.parents)
    child = torch.arange(len(joints))[parents >= 0]
    count = torch.bincount(parents[child], minlength=len(joints))[:, None]
    ahead = torch.zeros_like(joints).index_add(0, parents[child], joints[child]) / count.clamp(
        min=1
    )
    behind = joints[parents.clamp(min=0)]
    return torch.nn.functional.normalize(
        torch.where(count > 0, ahead - joints, joints - behind), dim=-1
    )


def _spread(uv, count, rng):
    """Indices (count,) of points of uv (P, 2) far from each other; the farthest from those chosen
    is next.
    """
    chosen = [int(rng.integers(len(uv)))]
    distance = np.full(len(uv), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, ((uv - uv[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)


def _largest(row, weight, count):
    """Which entries (E,) are among the ``count`` of the largest weight in their row."""
    order = np.lexsort((-weight, row))
    rank = np.empty(len(row), dtype=np.int64)
    rank[order] = np.arange(len(row)) - np.searchsorted(row[order], row[order])
    return rank < count
