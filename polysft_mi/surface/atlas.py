"""The atlas on the host, in double precision, with the derivatives of its vertices by every
unknown: what second-order solvers work on. NumPy and SciPy only.

The unknowns of a frame are a :class:`State`; an :class:`Atlas` turns it into a :class:`Surface`.
:mod:`polysft_mi.surface.patch` is the same surface on the device.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from polyfit.jets import exponents


@dataclass
class State:
    """Unknowns of a frame on the host, float64: ``alpha`` (K, A), the offsets of the coefficients
    in the basis of :class:`Atlas`; ``offset`` (N, 3), (Δu, Δv, Δw); ``rotation``: K of them, R_k;
    ``translation`` (K, 3): T_k; lengths in the template's scale."""

    alpha: np.ndarray
    offset: np.ndarray
    rotation: Rotation
    translation: np.ndarray

    def after_step(self, step, factor=1.0):
        """The state after a step (global (K (A + 6),), local (N, d)), whose global part has A
        coefficients, 3 of rotation and 3 of translation a patch; with d = 2 the relief stays."""
        g, local = step
        g, offset = factor * g.reshape(len(self.alpha), -1), self.offset.copy()
        offset[:, : local.shape[1]] += factor * local
        return State(
            self.alpha + g[:, :-6],
            offset,
            Rotation.from_rotvec(g[:, -6:-3]) * self.rotation,
            self.translation + g[:, -3:],
        )

    def extrapolated(self, other, factor):
        """The state that goes on from this one past ``other``: other + factor (other - self)."""
        turn = (other.rotation * self.rotation.inv()).as_rotvec()
        return State(
            other.alpha + factor * (other.alpha - self.alpha),
            other.offset + factor * (other.offset - self.offset),
            Rotation.from_rotvec(factor * turn) * other.rotation,
            other.translation + factor * (other.translation - self.translation),
        )

    def difference(self, other):
        """What leads from ``other`` to this state, of the jets and motions alone: (K, A + 6)."""
        turn = (self.rotation * other.rotation.inv()).as_rotvec()
        moved = self.translation - other.translation
        return np.concatenate([self.alpha - other.alpha, turn, moved], 1)


@dataclass
class Surface:
    """The vertices (N, 3) [m, world] that a :class:`State` makes, with derivatives.

    ``offset_jacobian`` (N, 3, 3): by (Δu, Δv, Δw). By the coefficients and the motion of a patch
    an *entry*, a vertex in a patch that holds it, moves ``points`` (E, 3) of its own; here with
    the patch's weight in the vertex: by coefficients ``up`` (K, 3) of its patch times ``basis``
    (E, A), by rotation and translation ``motion_jacobian`` (E, 3, 6).
    """

    vertices: np.ndarray
    points: np.ndarray
    offset_jacobian: np.ndarray
    up: np.ndarray
    basis: np.ndarray
    motion_jacobian: np.ndarray


class Atlas:
    """The template's jets on the host, in a basis of products of Legendre polynomials, which stays
    well conditioned to order 14.

    ``entry_patch`` (E,), rising, ``entry_vertex`` (E,), ``entry_weight`` (E,): the entries;
    ``entries``: of each patch, a slice.
    """

    def __init__(self, template):
        self.template = t = template
        self.order = template.order
        powers = exponents(self.order)
        self._u, self._v = powers.T
        self.to_monomials = _legendre_to_monomials(self.order)
        self._from_monomials = np.linalg.inv(self.to_monomials)
        self._alpha = template.alpha @ self._from_monomials.T
        # the derivative of sum c_k P_k has the coefficients D c
        derivative = [
            np.pad(legendre.legder(row), (0, self.order + 1))[: self.order + 1]
            for row in np.eye(self.order + 1)
        ]
        self._derivative = np.array(derivative).T
        #: (A, A): the mean square of a jet's second derivatives, as a form of its coefficients
        self.bending = self._bending()
        self._list_entries(t)

    def _list_entries(self, t):
        vertex, slot = np.nonzero(t.weight > 0)
        order = np.argsort(t.patch[vertex, slot], kind="stable")
        vertex, slot = vertex[order], slot[order]
        self.entry_vertex, self.entry_patch = vertex, t.patch[vertex, slot]
        self.entry_weight = t.weight[vertex, slot]
        ends = np.searchsorted(self.entry_patch, np.arange(len(t) + 1)).tolist()
        self.entries = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        #: (N, M): the entry of each vertex's patches; where there is none, that of its own
        self.entry_of = np.zeros(t.patch.shape, dtype=np.int64)
        self.entry_of[vertex, slot] = np.arange(len(vertex))
        self.entry_of = np.where(t.weight > 0, self.entry_of, self.entry_of[:, :1])
        self._chart, self._rest = t.chart[vertex, slot], t.rest[vertex, slot]
        # displacements as a chart has them: along u and v, and of the height over the jet
        self._to_chart = np.einsum("eji,ejk->eik", t.rotation[self.entry_patch], t.axes[vertex])
        self._to_chart[:, 2] = 0  # (Δu, Δv) slide along the jet
        self._to_chart[:, 2, 2] = t.lift[vertex, slot]
        self._unit = t.scale / t.radius[self.entry_patch]

    def __len__(self):
        """K, the number of patches."""
        return len(self.template)

    def _bending(self):
        """The mean square of the second derivatives over the unit disc, as a quadratic form of the
        coefficients, (A, A).
        """
        x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 25)])
        x, y = x[x * x + y * y <= 1], y[x * x + y * y <= 1]
        d = self._derivative
        parts = []
        for du, dv, factor in ((2, 0, 1), (1, 1, np.sqrt(2)), (0, 2, 1)):
            pu = legendre.legvander(x, self.order) @ np.linalg.matrix_power(d, du)
            pv = legendre.legvander(y, self.order) @ np.linalg.matrix_power(d, dv)
            parts.append(factor * pu[:, self._u] * pv[:, self._v])
        return sum(p.T @ p for p in parts) / len(x)

    def state(self, arrays):
        """A :class:`State` from the arrays of ``Unknowns.to_numpy``."""
        a = {name: np.asarray(x, dtype=np.float64) for name, x in arrays.items()}
        return State(
            a["delta_alpha"].reshape(len(self), -1) @ self._from_monomials.T,
            np.stack([a["delta_u"], a["delta_v"], a["delta_w"]], 1),
            Rotation.from_quat(a["rotation"].reshape(-1, 4)),
            a["translation"].reshape(-1, 3),
        )

    def rigid(self, rotation, translation):
        """(R_k, T_k) that move the template by p -> R p + t in the world (Rotation, (3,) [m])."""
        t = self.template
        turn = t.rotation.transpose(0, 2, 1) @ rotation.as_matrix() @ t.rotation
        moved = rotation.apply(t.origin) + translation - t.origin
        return (
            Rotation.from_matrix(turn),
            np.einsum("kji,kj->ki", t.rotation, moved) / t.scale,
        )

    def arrays(self, state):
        """The reverse of :meth:`state`."""
        return {
            "delta_alpha": state.alpha @ self.to_monomials.T,
            "delta_u": state.offset[:, 0],
            "delta_v": state.offset[:, 1],
            "delta_w": state.offset[:, 2],
            "rotation": state.rotation.as_quat(),
            "translation": state.translation,
        }

    def surface(self, state):
        """The :class:`Surface` of a state."""
        t, vertex, unit = self.template, self.entry_vertex, self._unit[:, None]
        moved = unit * np.einsum("eij,ej->ei", self._to_chart, state.offset[vertex])
        uv, height = self._chart + moved[:, :2], self._rest + moved[:, 2]
        turns = t.rotation @ state.rotation.as_matrix()
        turn, slope = turns[self.entry_patch], np.empty_like(uv)
        basis = np.empty((len(uv), len(self._u)))
        for k, part in enumerate(self.entries):
            matrix = np.zeros((self.order + 1, self.order + 1))
            matrix[self._u, self._v] = self._alpha[k] + state.alpha[k]
            pu, pv = (legendre.legvander(uv[part, c], self.order) for c in (0, 1))
            along = pu @ matrix
            height[part] += (along * pv).sum(1)
            slope[part, 0] = ((pu @ (self._derivative @ matrix)) * pv).sum(1)
            slope[part, 1] = (along * (pv @ self._derivative)).sum(1)
            basis[part] = pu[:, self._u] * pv[:, self._v]
        # the patch's own point, and its place in space
        y = t.radius[self.entry_patch, None] * np.column_stack([uv, height])
        x = np.einsum("eij,ej->ei", turn, y)
        weight, moving = self.entry_weight[:, None], np.empty((len(y), 3, 6))
        moving[:, :, 3:] = t.scale * t.rotation[self.entry_patch]
        axes = t.rotation[self.entry_patch]
        for k in range(3):  # axis k of the chart crossed with the point
            for i, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
                moving[:, i, k] = axes[:, a, k] * x[:, b] - axes[:, b, k] * x[:, a]
        moving *= weight[..., None]
        shift = t.origin + t.scale * np.einsum("kij,kj->ki", t.rotation, state.translation)
        points = x + shift[self.entry_patch]
        jacobian = turn @ self._to_chart
        jacobian += turn[:, :, 2:] * np.einsum("ec,ecj->ej", slope, self._to_chart[:, :2])[:, None]
        jacobian *= t.scale * weight[..., None]
        return Surface(
            self._summed(weight * points),
            points,
            self._summed(jacobian),
            t.radius[:, None] * turns[:, :, 2],
            weight * basis,
            moving,
        )

    def _summed(self, values):
        """Values (E, ...) of the entries summed at the vertices, (N, ...)."""
        if len(self) == 1:
            return values
        out = np.zeros((len(self.template.vertices), *values.shape[1:]))
        for k, part in enumerate(self.entries):  # a patch holds a vertex once
            out[self.entry_vertex[part]] += values[part]
        return out

    def global_columns(self, surface, rows):
        """The derivatives (N, G) of ``rows`` (N, 3) . vertices by all jets and motions, patch by
        patch.
        """
        size = surface.basis.shape[1] + 6
        out = np.zeros((len(rows), size * len(self)))
        for k, part in enumerate(self.entries):
            at = self.entry_vertex[part]
            by_jet = (rows[at] @ surface.up[k])[:, None] * surface.basis[part]
            by_motion = np.einsum("nk,nkm->nm", rows[at], surface.motion_jacobian[part])
            out[at, k * size : (k + 1) * size] = np.concatenate([by_jet, by_motion], 1)
        return out

    def with_relief_in_jets(self, state, ridge=1e-6):
        """The state of the same surface with as much of the relief as the jets can hold in the
        coefficients instead; ``ridge`` holds those that the vertices do not determine.
        """
        surface, size = self.surface(state), state.alpha.shape[1]
        normal = surface.offset_jacobian[:, :, 2] / self.template.scale
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        columns = self.global_columns(surface, normal).reshape(len(normal), len(self), -1)
        columns = columns[:, :, :size].reshape(len(normal), -1) / self.template.scale
        lift = (surface.offset_jacobian[:, :, 2] * normal).sum(1) / self.template.scale
        held = ridge * len(normal) / len(self) * (self.bending + np.eye(size))
        square = columns.T @ columns + np.kron(np.eye(len(self)), held)
        part = np.linalg.solve(square, columns.T @ (lift * state.offset[:, 2]))
        offset = state.offset.copy()
        offset[:, 2] -= columns @ part / lift
        found = State(
            state.alpha + part.reshape(len(self), -1), offset, state.rotation, state.translation
        )
        if len(self) > 1:  # charts at an angle: what the heights leave is taken by all three
            for _ in range(2):
                now = self.surface(found)
                missing = surface.vertices - now.vertices
                found.offset = (
                    found.offset + np.linalg.solve(now.offset_jacobian, missing[..., None])[..., 0]
                )
        return found


def _legendre_to_monomials(order):
    """The matrix (A, A) that takes coefficients of P_{i-j}(u) P_j(v), products of Legendre
    polynomials, to those of the monomials.
    """
    powers = exponents(order)
    leg = [
        np.pad(legendre.leg2poly(row), (0, order - k))
        for k, row in enumerate(np.eye(k + 1)[k] for k in range(order + 1))
    ]
    return np.array([[leg[a][i] * leg[b][j] for a, b in powers] for i, j in powers])
