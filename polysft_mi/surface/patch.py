"""The deforming atlas in Dr.Jit: unknowns of a frame, and the surface they make (paper, section
"PolySfT", there with one patch).

    p_ik(d) = O_k( R_k (phi_k((u, v) + d_uv; alpha_k + Δalpha_k) + (0, 0, r + d_w)) + T_k )
    x_i     = sum_k w_ik p_ik(0) + p_ii(d_i) - p_ii(0)

with O_k(x) = s_k R x + T; w_ik is the share of patch k in vertex i, r what the jet leaves of the
template, p_ii the vertex in its own patch, and d_i its displacement (Δu, Δv, Δw) there. With one
patch x_i is p_ii(d_i). The paper has no Δw; it is zero but for the second-order solver.

Import only after a Mitsuba variant is set.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import jet


@dataclass
class Unknowns:
    """The unknowns of one frame; lengths in the template's scale.

    ``delta_alpha`` Float of K A [charts' units]; ``delta_u``, ``delta_v``, ``delta_w`` Floats of N,
    the last the relief, a height over the jets; ``rotation`` Float of 4 K, the quaternions (x, y,
    z, w) of the R_k, normalised where they are used; ``translation`` Float of 3 K, the T_k. All are
    listed patch by patch.
    """

    delta_alpha: mi.Float
    delta_u: mi.Float
    delta_v: mi.Float
    delta_w: mi.Float
    rotation: mi.Float
    translation: mi.Float

    DRJIT_STRUCT = {
        "delta_alpha": mi.Float,
        "delta_u": mi.Float,
        "delta_v": mi.Float,
        "delta_w": mi.Float,
        "rotation": mi.Float,
        "translation": mi.Float,
    }

    NAMES = ("delta_alpha", "delta_u", "delta_v", "delta_w", "rotation", "translation")

    @classmethod
    def zero(cls, coefficients, vertices, patches=1):
        """The template itself: no deformation, no motion; ``coefficients``: K A."""
        return cls(
            dr.zeros(mi.Float, coefficients),
            dr.zeros(mi.Float, vertices),
            dr.zeros(mi.Float, vertices),
            dr.zeros(mi.Float, vertices),
            mi.Float([0, 0, 0, 1] * patches),
            dr.zeros(mi.Float, 3 * patches),
        )

    def items(self):
        return [(name, getattr(self, name)) for name in self.NAMES]

    def copy(self):
        """A detached copy."""
        return Unknowns(**{name: mi.Float(dr.detach(value)) for name, value in self.items()})

    def to_numpy(self):
        """Name to float32 array: (K, A), (N,) three times, (K, 4), normalised, and (K, 3)."""
        out = {name: np.array(dr.detach(value), dtype=np.float32) for name, value in self.items()}
        turns = out["rotation"].reshape(-1, 4)
        out["rotation"] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
        out["translation"] = out["translation"].reshape(-1, 3)
        out["delta_alpha"] = out["delta_alpha"].reshape(len(turns), -1)
        return out

    @classmethod
    def from_numpy(cls, arrays):
        return cls(
            **{
                name: mi.Float(np.ascontiguousarray(arrays[name], dtype=np.float32).ravel())
                for name in cls.NAMES
            }
        )


class JetAtlas:
    """The template's jets on the device, and their deformations."""

    def __init__(self, template):
        self.template, t = template, template
        self._coefficients = template.alpha.shape[1]
        self.alpha = _flat(template.alpha)
        self.rotation, self.origin = _flat(template.rotation), _flat(template.origin)
        self.radius, self.scale = _flat(template.radius), mi.Float(template.scale)
        self._layers = [_Layer.of(t, m) for m in range(t.patch.shape[1])]
        # opaque: the numbers of one template must not be baked into kernels that serve every
        # template
        dr.make_opaque(self.alpha, self.rotation, self.origin, self.radius, self.scale)

    def rest(self):
        """The unknowns of the undeformed template."""
        t = self.template
        return Unknowns.zero(t.alpha.size, len(t.vertices), len(t))

    def vertices(self, unknowns):
        """Positions of the vertices, Point3f of N [m, camera frame]."""
        own, *others = self._layers
        found = self._points(own, unknowns, displaced=True)
        if others or own.to_chart is not None:
            found -= (1 - own.weight) * self._points(own, unknowns)
            for layer in others:
                found += layer.weight * self._points(layer, unknowns)
        return mi.Point3f(found)

    def patch_points(self, unknowns):
        """Where each patch that holds a vertex has it, undisplaced: pairs of the patch's share in
        the N vertices (Float of N, 0 where there is none) and points (Point3f of N [m, camera
        frame]).
        """
        return [(layer.weight, self._points(layer, unknowns)) for layer in self._layers]

    def tangents(self, unknowns):
        """Derivatives of the jets, without relief, along u and along v at the vertices, Vector3f of
        N each [m per chart unit, camera frame], in their own patches.
        """
        alpha, u, v, _ = self._in_chart(self._layers[0], unknowns)
        own = self._layers[0]
        radius = dr.gather(mi.Float, self.radius, own.patch)
        return tuple(radius * self._turned(own, t, unknowns) for t in jet.tangents(alpha, u, v))

    def normals(self, unknowns):
        """Unit normals of the jets, without relief, at the vertices, Normal3f of N [camera frame],
        in their own patches.
        """
        own = self._layers[0]
        alpha, u, v, _ = self._in_chart(own, unknowns)
        return mi.Normal3f(self._turned(own, mi.Vector3f(jet.normal(alpha, u, v)), unknowns))

    def metric(self, unknowns):
        """First fundamental form (E, F, G) of the jets, without relief, with respect to (u, v) at
        the vertices, Floats of N [m^2 per chart unit squared], in their own patches.
        """
        own = self._layers[0]
        alpha, u, v, _ = self._in_chart(own, unknowns)
        radius = dr.gather(mi.Float, self.radius, own.patch)
        return tuple(radius * radius * g for g in jet.metric(alpha, u, v))

    def _points(self, layer, unknowns, displaced=False):
        """The vertices as one patch of each has them [m, camera frame]."""
        alpha, u, v, height = self._in_chart(layer, unknowns, displaced)
        x = mi.Vector3f(jet.point(alpha, u, v))
        x.z += height
        radius = dr.gather(mi.Float, self.radius, layer.patch)
        t = self._rows(layer, mi.Vector3f(*_of_patches(unknowns.translation, layer.patch, 3)))
        origin = dr.gather(mi.Vector3f, self.origin, layer.patch)
        return origin + radius * self._turned(layer, x, unknowns) + self.scale * t

    def _in_chart(self, layer, unknowns, displaced=True):
        """(alpha, u, v, height over the jet) of the vertices in one patch of each; ``displaced``:
        with their own displacements, which the own patch alone has.
        """
        alpha = jet.Coefficients(self.alpha + unknowns.delta_alpha, self._coefficients, layer.patch)
        if not displaced:
            return alpha, layer.u, layer.v, layer.rest
        d = mi.Vector3f(unknowns.delta_u, unknowns.delta_v, unknowns.delta_w)
        if layer.to_chart is not None:
            d = mi.Vector3f(*(dr.dot(row, d) for row in layer.to_chart), layer.lift * d.z)
        return alpha, layer.u + d.x, layer.v + d.y, layer.rest + d.z

    def _turned(self, layer, x, unknowns):
        """R Rot(q) x of vectors x of a chart."""
        q = _of_patches(unknowns.rotation, layer.patch, 4)
        axis, w = mi.Vector3f(q[0], q[1], q[2]), q[3]
        twice = 2 / (dr.dot(axis, axis) + w * w)
        across = dr.cross(axis, x)
        return self._rows(layer, x + twice * (w * across + dr.cross(axis, across)))

    def _rows(self, layer, x):
        """R x of vectors x of a chart."""
        rows = [dr.gather(mi.Vector3f, self.rotation, 3 * layer.patch + k) for k in range(3)]
        return mi.Vector3f(*(dr.dot(row, x) for row in rows))


@dataclass
class _Layer:
    """One patch of each of the N vertices: ``patch`` UInt32, ``weight``, the chart's ``u``, ``v``
    and the ``rest`` over the jet, and its ``lift``, Floats; ``to_chart``: two rows that take
    displacements to the chart's u and v; None where they are the chart's own."""

    patch: mi.UInt32
    weight: mi.Float
    u: mi.Float
    v: mi.Float
    rest: mi.Float
    lift: mi.Float
    to_chart: list | None

    @classmethod
    def of(cls, t, m):
        k = t.patch[:, m]
        rows = np.einsum("nji,njk->nik", t.rotation[k], t.axes)
        unit = t.scale / t.radius[k]
        rows = rows[:, :2] * unit[:, None, None]
        same = len(t) == 1
        made = cls(
            mi.UInt32(k.astype(np.uint32)),
            _flat(t.weight[:, m]),
            _flat(t.chart[:, m, 0]),
            _flat(t.chart[:, m, 1]),
            _flat(t.rest[:, m]),
            _flat(unit * t.lift),
            None if same else [_vectors(row) for row in rows.transpose(1, 0, 2)],
        )
        dr.make_opaque(made.patch, made.weight, made.u, made.v, made.rest, made.lift)
        if made.to_chart is not None:
            dr.make_opaque(made.to_chart)
        return made


def _of_patches(numbers, patch, count):
    """``count`` numbers of the patch of each vertex; in double, so that the order in which
    gradients are summed does not show.
    """
    numbers = mi.Float64(numbers)
    return [mi.Float(dr.gather(mi.Float64, numbers, count * patch + k)) for k in range(count)]


def _vectors(array):
    """(N, 3) as a Vector3f."""
    return mi.Vector3f(*(_flat(column) for column in array.T))


def _flat(array):
    return mi.Float(np.ascontiguousarray(array, dtype=np.float32).ravel())
