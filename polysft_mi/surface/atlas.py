"""The atlas on the host, in double precision, with the derivatives of its vertices by every
unknown: what second-order solvers work on. NumPy and SciPy only.

The unknowns of a frame are a :class:`State`; an :class:`Atlas` turns it into a :class:`Surface`.
:mod:`polysft_mi.surface.deformation` has the same surface without derivatives, for arrays of any
kind.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from polyfit.jets import exponents

_SAME = 1e-4  # of the template's scale: surfaces that are the same


@dataclass
class State:
    """Unknowns of a frame on the host, float64: ``alpha`` (K, A), the offsets of the coefficients
    in the basis of :class:`Atlas`; ``offset`` (N, 3), (Δu, Δv, Δw); ``rotation``: K of them, R_k;
    ``translation`` (K, 3): T_k; lengths in the template's scale. ``pose``: of the body that carries
    the surface (:class:`polysft_mi.body.carrier.Pose`), or None."""

    alpha: np.ndarray
    offset: np.ndarray
    rotation: Rotation
    translation: np.ndarray
    pose: Any = None

    def after_step(self, step, factor=1.0):
        """The state after a step (global (K (A + 6) + P,), local (N, d)), whose global part has A
        coefficients, 3 of rotation and 3 of translation a patch, and then P of the body's pose,
        where there is one; with d = 2 the relief stays."""
        g, local = step
        (patches, size), pose = self.alpha.shape, self.pose
        g, of_pose = np.split(factor * g, [patches * (size + 6)])
        if pose is not None and len(of_pose):
            pose = pose.after_step(of_pose)
        g, offset = g.reshape(patches, -1), self.offset.copy()
        offset[:, : local.shape[1]] += factor * local
        return State(
            self.alpha + g[:, :-6],
            offset,
            Rotation.from_rotvec(g[:, -6:-3]) * self.rotation,
            self.translation + g[:, -3:],
            pose,
        )

    def extrapolated(self, other, factor):
        """The state that goes on from this one past ``other``: other + factor (other - self); a
        body's pose is the other's.
        """
        turn = (other.rotation * self.rotation.inv()).as_rotvec()
        return State(
            other.alpha + factor * (other.alpha - self.alpha),
            other.offset + factor * (other.offset - self.offset),
            Rotation.from_rotvec(factor * turn) * other.rotation,
            other.translation + factor * (other.translation - self.translation),
            other.pose,
        )

    def difference(self, other):
        """What leads from ``other`` to this state, of the jets and motions alone: (K, A + 6)."""
        turn = (self.rotation * other.rotation.inv()).as_rotvec()
        moved = self.translation - other.translation
        return np.concatenate([self.alpha - other.alpha, turn, moved], 1)


@dataclass
class Surface:
    """The vertices (N, 3) [m, world] that a :class:`State` makes, with derivatives.

    ``offset_jacobian`` (N, 3, 3): by (Δu, Δv, Δw). An *entry* is a vertex in a patch that holds it:
    ``points`` (E, 3) is where the patch has it, before it is displaced. A patch moves its entries'
    vertices: by its coefficients by ``up`` (K, 3) times ``basis`` (E, A), by its rotation and
    translation by ``motion_jacobian`` (E, 3, 6); and its entries' points by ``rest_basis`` and
    ``rest_motion``, which are None where there is one patch.

    Where a body carries the surface, all of this but ``vertices`` is at the body's rest;
    ``linear`` (N, 3, 3) takes derivatives from there to the world, ``by_pose`` (N, 3, P) are
    those of the vertices by the body's pose, and ``at_rest`` (N, 3) [m] is where they are carried
    from.
    """

    vertices: np.ndarray
    points: np.ndarray
    offset_jacobian: np.ndarray
    up: np.ndarray
    basis: np.ndarray
    motion_jacobian: np.ndarray
    rest_basis: np.ndarray | None = None
    rest_motion: np.ndarray | None = None
    linear: np.ndarray | None = None
    by_pose: np.ndarray | None = None
    at_rest: np.ndarray | None = None

    def to_rest(self, rows):
        """Derivatives ``rows`` (N, 3) by the vertices, as those by the vertices at rest."""
        return rows if self.linear is None else np.einsum("nk,nkm->nm", rows, self.linear)

    def by_offset(self, rows):
        """The derivatives (N, 3) of ``rows`` (N, 3) . vertices by (Δu, Δv, Δw)."""
        return np.einsum("nk,nka->na", self.to_rest(rows), self.offset_jacobian)


class Atlas:
    """The template's jets on the host, in a basis of products of Legendre polynomials, which stays
    well conditioned to order 14.

    ``entry_patch`` (E,), rising, ``entry_vertex`` (E,), ``entry_weight`` (E,): the entries;
    ``entries``: of each patch, a slice. ``carrier``: what carries the surface of a state that has a
    pose (:class:`polysft_mi.body.carrier.Carrier`), or None.
    """

    def __init__(self, template, carrier=None):
        self.template, self.carrier = template, carrier
        t = template
        self.order = template.order
        self._u, self._v = exponents(self.order).T
        self.to_monomials = _legendre_to_monomials(self.order)
        self._from_monomials = np.linalg.inv(self.to_monomials)
        self._alpha = template.alpha @ self._from_monomials.T
        # the derivative of sum c_k P_k has the coefficients D c
        self._derivative = np.pad(legendre.legder(np.eye(self.order + 1)), ((0, 1), (0, 0)))
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
        self.entries = [slice(a, b) for a, b in itertools.pairwise(ends)]
        #: (N, M): the entry of each vertex's patches; where there is none, that of its own
        self.entry_of = np.zeros(t.patch.shape, dtype=np.int64)
        self.entry_of[vertex, slot] = np.arange(len(vertex))
        self.entry_of = np.where(t.weight > 0, self.entry_of, self.entry_of[:, :1])
        self._own = self.entry_of[:, 0]  # (N,): the entry of each vertex in its own patch
        self._chart, self._rest = t.chart[vertex, slot], t.rest[vertex, slot]
        self._at_rest = None
        if len(t) > 1:  # where no vertex is displaced, a jet's basis stays what it is
            self._at_rest = self._basis(self._chart)
        # displacements in the vertex' own chart: along u and v, and of the height over the jet
        own = t.patch[:, 0]
        self._to_chart = np.einsum("nji,njk->nik", t.rotation[own], t.axes)
        self._to_chart[:, 2] = 0  # (Δu, Δv) slide along the jet
        self._to_chart[:, 2, 2] = t.lift
        self._unit = (t.scale / t.radius[own])[:, None]

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

    @property
    def start(self):
        """The :class:`State` that the first frame begins with: of the undeformed template, or, on a
        body, of its drape.
        """
        (patches, size), count = self._alpha.shape, len(self.template.vertices)
        zeros = np.zeros((patches, size)), np.zeros((count, 3))
        still = Rotation.identity(patches), np.zeros((patches, 3))
        return self.posed(State(*zeros, *still), 0)

    def posed(self, state, frame, like=None):
        """The state in a ``frame``, whose body stands there as is known, or corrected as that of
        the state ``like`` is; without a body the same.
        """
        if self.carrier is None:
            return state
        corrected = (
            None if like is None or like.pose is None else self.carrier.correction(like.pose)
        )
        return replace(state, pose=self.carrier.at(frame, corrected))

    def state(self, arrays):
        """A :class:`State` from the arrays of ``Unknowns.to_numpy``."""
        a = {name: np.asarray(x, dtype=np.float64) for name, x in arrays.items()}
        return State(
            a["delta_alpha"].reshape(len(self), -1) @ self._from_monomials.T,
            np.stack([a["delta_u"], a["delta_v"], a["delta_w"]], 1),
            Rotation.from_quat(a["rotation"].reshape(-1, 4)),
            a["translation"].reshape(-1, 3),
            self.carrier.pose(a["pose"]) if len(a.get("pose", ())) else None,
        )

    def moved(self, state, rotation, translation):
        """The state whose surface is that of ``state``, moved by p -> R p + t in the world
        (Rotation, (3,) [m]).
        """
        t = self.template
        turn = t.rotation.transpose(0, 2, 1) @ rotation.as_matrix() @ t.rotation
        moved = rotation.apply(t.origin) + translation - t.origin
        shift = np.einsum("kji,kj->ki", t.rotation, moved) / t.scale
        return replace(
            state,
            rotation=Rotation.from_matrix(turn) * state.rotation,
            translation=np.einsum("kij,kj->ki", turn, state.translation) + shift,
        )

    def arrays(self, state):
        """The reverse of :meth:`state`."""
        return {
            "delta_alpha": state.alpha @ self.to_monomials.T,
            **dict(zip(("delta_u", "delta_v", "delta_w"), state.offset.T)),
            "rotation": state.rotation.as_quat(),
            "translation": state.translation,
            "pose": np.zeros(0) if state.pose is None else state.pose.to_numpy(),
        }

    def surface(self, state):
        """The :class:`Surface` of a state."""
        found = self._surface(state)
        if state.pose is None:
            return found
        maps = self.carrier.maps(state.pose)
        by_pose = self.carrier.columns(state.pose, found.vertices)
        carried, rest = maps(found.vertices), found.vertices
        return replace(found, vertices=carried, linear=maps.linear, by_pose=by_pose, at_rest=rest)

    def _surface(self, state):
        """The :class:`Surface` before a body carries it."""
        t, own, patch = self.template, self._own, self.entry_patch
        moved = self._unit * np.einsum("nij,nj->ni", self._to_chart, state.offset)
        chart = self._chart[own] + moved[:, :2]
        turns = t.rotation @ state.rotation.as_matrix()
        shift = t.origin + t.scale * np.einsum("kij,kj->ki", t.rotation, state.translation)
        alpha = self._alpha + state.alpha

        def points(entries, basis, uv, height):
            """The entries' points [m], with the derivatives by rotation and translation."""
            k = patch[entries]
            height = height + np.einsum("ea,ea->e", basis, alpha[k])
            y = t.radius[k, None] * np.column_stack([uv, height])
            x = np.einsum("eij,ej->ei", turns[k], y)
            moving, axes = np.empty((len(y), 3, 6)), t.rotation[k]
            moving[:, :, 3:] = t.scale * axes
            for c in range(3):  # axis c of the chart crossed with the point
                for i, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
                    moving[:, i, c] = axes[:, a, c] * x[:, b] - axes[:, b, c] * x[:, a]
            return x + shift[k], moving

        values = self._values(chart)
        basis = self._basis(chart, values)
        found, moving = points(own, basis, chart, self._rest[own] + moved[:, 2])
        slope, turn = self._slope(alpha[patch[own]], values), turns[patch[own]]
        jacobian = turn @ self._to_chart
        jacobian += turn[:, :, 2:] * np.einsum("nc,ncj->nj", slope, self._to_chart[:, :2])[:, None]
        up = t.radius[:, None] * turns[:, :, 2]
        if len(self) == 1:
            return Surface(found, found, t.scale * jacobian, up, basis, moving)
        # all patches where the vertices are not displaced, blended, and their own displacements
        every = slice(None)
        rest, rest_moving = points(every, self._at_rest, self._chart, self._rest)
        weight = self.entry_weight[:, None]
        all_basis, all_moving = weight * self._at_rest, weight[..., None] * rest_moving
        all_basis[own] += basis - self._at_rest[own]
        all_moving[own] += moving - rest_moving[own]
        vertices = self._summed(weight * rest) + found - rest[own]
        derivatives = t.scale * jacobian, up, all_basis, all_moving
        return Surface(vertices, rest, *derivatives, self._at_rest, rest_moving)

    def _values(self, uv):
        """Legendre polynomials at uv (P, 2): two of (P, n + 1)."""
        return [legendre.legvander(uv[:, c], self.order) for c in (0, 1)]

    def _basis(self, uv, values=None):
        pu, pv = values or self._values(uv)
        return pu[:, self._u] * pv[:, self._v]

    def _slope(self, alpha, values):
        """Derivatives (P, 2) of the jets ``alpha`` (P, A)."""
        pu, pv = values
        return np.stack(
            [
                np.einsum("pa,pa,pa->p", alpha, along_u[:, self._u], along_v[:, self._v])
                for along_u, along_v in ((pu @ self._derivative, pv), (pu, pv @ self._derivative))
            ],
            1,
        )

    def _summed(self, values):
        """Values (E, ...) of the entries summed at the vertices, (N, ...)."""
        if len(self) == 1:
            return values
        out = np.zeros((len(self.template.vertices), *values.shape[1:]))
        for part in self.entries:  # a patch holds a vertex once
            out[self.entry_vertex[part]] += values[part]
        return out

    def global_columns(self, surface, rows):
        """The derivatives (N, G) of ``rows`` (N, 3) . vertices by all jets and motions, patch by
        patch, and by the body's pose.
        """
        size, world = surface.basis.shape[1] + 6, rows
        rows = surface.to_rest(rows)
        out = np.zeros((len(rows), size * len(self)))
        for k, part in enumerate(self.entries):
            at = self.entry_vertex[part]
            by_jet = (rows[at] @ surface.up[k])[:, None] * surface.basis[part]
            by_motion = np.einsum("nk,nkm->nm", rows[at], surface.motion_jacobian[part])
            out[at, k * size : (k + 1) * size] = np.concatenate([by_jet, by_motion], 1)
        if surface.by_pose is None:
            return out
        return np.concatenate([out, np.einsum("nk,nkp->np", world, surface.by_pose)], 1)

    def to_globals(self, surface, gradient, at_rest=None):
        """The gradient (G,) by the jets, the motions and the body's pose, of that in space (N,
        3), and of that ``at_rest`` (N, 3), where a body carries the surface from.
        """
        parts, world = [], gradient
        gradient = surface.to_rest(gradient)
        if at_rest is not None:
            gradient = gradient + at_rest
        for up, part in zip(surface.up, self.entries, strict=True):
            g = gradient[self.entry_vertex[part]]
            parts.append(surface.basis[part].T @ (g @ up))
            parts.append(np.einsum("nk,nkm->m", g, surface.motion_jacobian[part]))
        if surface.by_pose is not None:
            parts.append(np.einsum("nk,nkp->p", world, surface.by_pose))
        return np.concatenate(parts)

    def reaching(self, vertices, state, iterations=8):
        """The ``state`` with its vertices displaced to ``vertices`` (N, 3) [m, world; where a body
        carries them, at its rest], by Newton's method.
        """
        offset = state.offset
        for _ in range(iterations):
            now = self._surface(replace(state, offset=offset))
            missing = (vertices - now.vertices)[..., None]
            offset = offset + np.linalg.solve(now.offset_jacobian, missing)[..., 0]
        return replace(state, offset=offset)

    def with_relief_in_jets(self, state, ridge=1e-6):
        """The state of the same surface with as much of the relief as the jets can hold in the
        coefficients instead; ``ridge`` holds those that the vertices do not determine.
        """
        surface, size = self._surface(state), state.alpha.shape[1]
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
        found = replace(state, alpha=state.alpha + part.reshape(len(self), -1), offset=offset)
        if len(self) > 1:  # charts at an angle: what the heights leave is taken by all three
            found = self.reaching(surface.vertices, found, 2)
            left = np.abs(self._surface(found).vertices - surface.vertices).max()
            less = (found.offset**2).sum() < (state.offset**2).sum()
            if not (less and left < _SAME * self.template.scale):
                return state
        return found


def _legendre_to_monomials(order):
    """The matrix (A, A) that takes coefficients of P_{i-j}(u) P_j(v), products of Legendre
    polynomials, to those of the monomials.
    """
    u, v = exponents(order).T
    in_powers = (legendre.leg2poly(np.eye(k + 1)[k]) for k in range(order + 1))
    leg = np.stack([np.pad(row, (0, order + 1 - len(row))) for row in in_powers])
    return (leg[np.ix_(u, u)] * leg[np.ix_(v, v)]).T.copy()
