"""The jet patch on the host, in double precision, with the derivatives of its vertices by every
unknown: what second-order solvers work on. NumPy and SciPy only.

The unknowns of a frame are a :class:`State`; a :class:`Chart` turns it into a :class:`Surface`.
:mod:`polysft_mi.surface.patch` is the same patch on the device.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from polyfit.jets import exponents


@dataclass
class State:
    """Unknowns of a frame on the host, float64: ``alpha`` (A,), the offset of the coefficients in
    the basis of :class:`Chart`; ``offset`` (N, 3), (Δu, Δv, Δw); ``rotation``: R_c; ``translation``
    (3,): T_c, in the chart's unit."""

    alpha: np.ndarray
    offset: np.ndarray
    rotation: Rotation
    translation: np.ndarray

    def after_step(self, step, factor=1.0):
        """The state after a step (global (G,), local (N, d)); with d = 2 the relief stays."""
        g, local = step
        alpha, offset = self.alpha.copy(), self.offset.copy()
        alpha[: len(g) - 6] += factor * g[:-6]
        offset[:, : local.shape[1]] += factor * local
        return State(
            alpha,
            offset,
            Rotation.from_rotvec(factor * g[-6:-3]) * self.rotation,
            self.translation + factor * g[-3:],
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


@dataclass
class Surface:
    """The vertices (N, 3) [m, world] that a :class:`State` makes, with derivatives.

    ``offset_jacobian`` (N, 3, 3): by (Δu, Δv, Δw), of which the last, ``up`` (3,), is the same
    everywhere; by the coefficients: ``up`` times ``basis`` (N, A); by rotation and translation:
    ``motion_jacobian`` (N, 3, 6).
    """

    vertices: np.ndarray
    offset_jacobian: np.ndarray
    up: np.ndarray
    basis: np.ndarray
    motion_jacobian: np.ndarray


class Chart:
    """The template's jet on the host, in a basis of products of Legendre polynomials, which stays
    well conditioned to order 14.
    """

    def __init__(self, template):
        self.template = template
        self.order = template.order
        powers = exponents(self.order)
        self._u, self._v = powers.T
        self.to_monomials = _legendre_to_monomials(self.order)
        self._from_monomials = np.linalg.inv(self.to_monomials)
        self._alpha = self._from_monomials @ template.alpha
        self._axes = template.scale * template.rotation  # chart to world
        # the derivative of sum c_k P_k has the coefficients D c
        derivative = [
            np.pad(legendre.legder(row), (0, self.order + 1))[: self.order + 1]
            for row in np.eye(self.order + 1)
        ]
        self._derivative = np.array(derivative).T
        self.bending = self._bending()

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
            self._from_monomials @ a["delta_alpha"],
            np.stack([a["delta_u"], a["delta_v"], a["delta_w"]], 1),
            Rotation.from_quat(a["rotation"]),
            a["translation"],
        )

    def rigid(self, rotation, translation):
        """(R_c, T_c) that moves the template by p -> R p + t in the world (Rotation, (3,) [m])."""
        t = self.template
        turn = t.rotation.T @ rotation.as_matrix() @ t.rotation
        return (
            Rotation.from_matrix(turn),
            t.rotation.T @ (rotation.apply(t.origin) + translation - t.origin) / t.scale,
        )

    def arrays(self, state):
        """The reverse of :meth:`state`."""
        return {
            "delta_alpha": self.to_monomials @ state.alpha,
            "delta_u": state.offset[:, 0],
            "delta_v": state.offset[:, 1],
            "delta_w": state.offset[:, 2],
            "rotation": state.rotation.as_quat(),
            "translation": state.translation,
        }

    def surface(self, state):
        """The :class:`Surface` of a state."""
        t = self.template
        uv = t.chart + state.offset[:, :2]
        alpha = self._alpha + state.alpha
        matrix = np.zeros((self.order + 1, self.order + 1))
        matrix[self._u, self._v] = alpha
        pu, pv = (legendre.legvander(uv[:, k], self.order) for k in (0, 1))
        along = pu @ matrix
        height = (along * pv).sum(1) + state.offset[:, 2]
        slope = np.stack(
            [
                ((pu @ (self._derivative @ matrix)) * pv).sum(1),
                (along * (pv @ self._derivative)).sum(1),
            ],
            1,
        )
        rotation = state.rotation.as_matrix()
        turn = self._axes @ rotation
        y = np.column_stack([uv, height])
        motion_jacobian = np.empty((len(y), 3, 6))
        motion_jacobian[:, :, 3:] = self._axes
        x = y @ rotation.T
        for k, (a, b) in enumerate(
            ((1, 2), (2, 0), (0, 1))
        ):  # axis k of the chart crossed with the point
            motion_jacobian[:, :, k] = (
                x[:, a, None] * self._axes[:, b] - x[:, b, None] * self._axes[:, a]
            )
        offset_jacobian = np.tile(turn, (len(y), 1, 1))
        offset_jacobian[:, :, :2] += turn[None, :, 2:] * slope[:, None, :]
        return Surface(
            y @ turn.T + (t.origin + self._axes @ state.translation),
            offset_jacobian,
            turn[:, 2],
            pu[:, self._u] * pv[:, self._v],
            motion_jacobian,
        )

    def fitted(self, state, vertices, iterations=8, bending=1e-6):
        """The state, from ``state`` on, whose vertices come closest to ``vertices`` (N, 3) [m,
        world], in the least-squares sense.

        Each vertex slides freely in its tangent plane, so that only distances along the normals
        count for the other unknowns. The relief stays as it is.
        """
        size = len(state.alpha)
        prior = np.zeros((size + 6, size + 6))
        prior[:size, :size] = bending * len(vertices) * self.template.scale**2 * self.bending
        for _ in range(iterations):
            surface = self.surface(state)
            missing = vertices - surface.vertices
            tangents = surface.offset_jacobian[:, :, :2]
            normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            rows = np.column_stack(
                [
                    (normal @ surface.up)[:, None] * surface.basis,
                    np.einsum("nk,nkm->nm", normal, surface.motion_jacobian),
                ]
            )
            # sliding makes rotations in the plane and shifts along it free: a little damping holds
            # them
            square = rows.T @ rows + prior
            right = rows.T @ np.einsum("nk,nk->n", normal, missing) - prior[:, :size] @ state.alpha
            g = np.linalg.solve(
                square + 1e-6 * np.trace(square) / len(square) * np.eye(len(square)), right
            )
            rest = (
                missing
                - (surface.basis @ g[:size])[:, None] * surface.up
                - surface.motion_jacobian @ g[size:]
            )
            square = tangents.transpose(0, 2, 1) @ tangents
            uv = np.linalg.solve(square, np.einsum("nka,nk->na", tangents, rest)[:, :, None])[
                :, :, 0
            ]
            state = state.after_step((g, uv))
        return state

    def with_relief_in_jet(self, state, ridge=1e-6):
        """The state of the same surface with as much of the relief as the jet can hold in the
        coefficients instead; ``ridge`` holds those that the vertices do not determine.
        """
        relief, basis = state.offset[:, 2], self.surface(state).basis
        held = ridge * len(relief) * (self.bending + np.eye(len(self.bending)))
        part = np.linalg.solve(basis.T @ basis + held, basis.T @ relief)
        offset = state.offset.copy()
        offset[:, 2] -= basis @ part
        return State(state.alpha + part, offset, state.rotation, state.translation)


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
