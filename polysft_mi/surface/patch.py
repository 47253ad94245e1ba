"""The deforming jet patch in Dr.Jit: unknowns of a frame, and the surface they make (paper, section
"PolySfT").

    vertices = O( R_c (phi(u + Δu, v + Δv; alpha + Δalpha) + (0, 0, Δw)) + T_c ),   O(x) = s R x + T

The paper has no Δw; it is zero but for the second-order solver.

Import only after a Mitsuba variant is set.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import jet


@dataclass
class Unknowns:
    """The unknowns of one frame, in the chart's unit.

    ``delta_alpha`` Float of A; ``delta_u``, ``delta_v``, ``delta_w`` Floats of N, the last the
    relief, a height over the jet; ``rotation`` Float of 4, the quaternion (x, y, z, w) of R_c,
    normalised where it is used; ``translation`` Float of 3, T_c.
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
    def zero(cls, coefficients, vertices):
        """The template itself: no deformation, no motion."""
        return cls(
            dr.zeros(mi.Float, coefficients),
            dr.zeros(mi.Float, vertices),
            dr.zeros(mi.Float, vertices),
            dr.zeros(mi.Float, vertices),
            mi.Float([0, 0, 0, 1]),
            dr.zeros(mi.Float, 3),
        )

    def items(self):
        return [(name, getattr(self, name)) for name in self.NAMES]

    def copy(self):
        """A detached copy."""
        return Unknowns(**{name: mi.Float(dr.detach(value)) for name, value in self.items()})

    def to_numpy(self):
        """Name to float32 array; the quaternion is normalised."""
        out = {name: np.array(dr.detach(value), dtype=np.float32) for name, value in self.items()}
        out["rotation"] = out["rotation"] / np.linalg.norm(out["rotation"])
        return out

    @classmethod
    def from_numpy(cls, arrays):
        return cls(
            **{
                name: mi.Float(np.ascontiguousarray(arrays[name], dtype=np.float32))
                for name in cls.NAMES
            }
        )


class JetPatch:
    """The template's jet on the device, and its deformations."""

    def __init__(self, template):
        self.template = template
        self.alpha = mi.Float(template.alpha.astype(np.float32))
        self.u, self.v = (
            mi.Float(np.ascontiguousarray(template.chart[:, k], dtype=np.float32)) for k in (0, 1)
        )
        self.rotation = mi.Matrix3f(template.rotation)
        self.origin = mi.Point3f(*map(float, template.origin))
        self.scale = mi.Float(template.scale)
        # opaque: the numbers of one template must not be baked into kernels that serve every
        # template
        dr.make_opaque(self.alpha, self.u, self.v, self.rotation, self.origin, self.scale)

    def rest(self):
        """The unknowns of the undeformed template."""
        return Unknowns.zero(len(self.template.alpha), len(self.template.vertices))

    def _to_camera(self, x, unknowns):
        """s R Rot(q) x of canonical vectors x."""
        q = [dr.gather(mi.Float, unknowns.rotation, k) for k in range(4)]
        axis, w = mi.Vector3f(q[0], q[1], q[2]), q[3]
        twice = 2 / (dr.dot(axis, axis) + w * w)
        across = dr.cross(axis, x)
        return self.scale * (self.rotation @ (x + twice * (w * across + dr.cross(axis, across))))

    def _chart(self, unknowns):
        return (
            self.alpha + unknowns.delta_alpha,
            self.u + unknowns.delta_u,
            self.v + unknowns.delta_v,
        )

    def vertices(self, unknowns):
        """Positions of the vertices, Point3f of N [m, camera frame]."""
        x = mi.Vector3f(jet.point(*self._chart(unknowns)))
        x.z += unknowns.delta_w
        t = mi.Vector3f(*(dr.gather(mi.Float, unknowns.translation, k) for k in range(3)))
        return self.origin + self._to_camera(x, unknowns) + self.scale * (self.rotation @ t)

    def tangents(self, unknowns):
        """Derivatives of the jet, without relief, along u and along v at the vertices, Vector3f of
        N each [m per chart unit, camera frame].
        """
        return tuple(self._to_camera(t, unknowns) for t in jet.tangents(*self._chart(unknowns)))

    def normals(self, unknowns):
        """Unit normals of the jet, without relief, at the vertices, Normal3f of N [camera
        frame].
        """
        return mi.Normal3f(
            self._to_camera(mi.Vector3f(jet.normal(*self._chart(unknowns))), unknowns) / self.scale
        )

    def metric(self, unknowns):
        """First fundamental form (E, F, G) of the jet, without relief, with respect to (u, v) at
        the vertices, Floats of N [m^2 per chart unit squared].
        """
        return tuple(self.scale * self.scale * g for g in jet.metric(*self._chart(unknowns)))
