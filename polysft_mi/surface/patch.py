"""The deforming atlas in Dr.Jit: unknowns of a frame, and the surface they make
(:mod:`polysft_mi.surface.deformation`).

Import only after a Mitsuba variant is set.
"""

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device

from .deformation import Deformation


@dataclass
class Unknowns:
    """The unknowns of one frame; lengths in the template's scale.

    ``delta_alpha`` Float of K A [charts' units]; ``delta_u``, ``delta_v``, ``delta_w`` Floats of N,
    the last the relief, a height over the jets; ``rotation`` Float of 4 K, the quaternions (x, y,
    z, w) of the R_k, normalised where they are used; ``translation`` Float of 3 K, the T_k. All are
    listed patch by patch. ``pose``: of the body that carries the surface, as numbers
    (:meth:`polysft_mi.body.carrier.Pose.to_numpy`), of length 0 where there is none; surfaces have
    no gradient by it.
    """

    delta_alpha: mi.Float
    delta_u: mi.Float
    delta_v: mi.Float
    delta_w: mi.Float
    rotation: mi.Float
    translation: mi.Float
    pose: mi.Float = field(default_factory=lambda: dr.zeros(mi.Float, 0))

    NAMES = ("delta_alpha", "delta_u", "delta_v", "delta_w", "rotation", "translation", "pose")
    DRJIT_STRUCT = dict.fromkeys(NAMES, mi.Float)

    @classmethod
    def zero(cls, coefficients, vertices, patches=1):
        """The template itself: no deformation, no motion; ``coefficients``: K A."""
        return cls(
            *(dr.zeros(mi.Float, n) for n in (coefficients, vertices, vertices, vertices)),
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
        """The reverse of :meth:`to_numpy`; without ``pose`` no body carries the surface."""
        known = [name for name in cls.NAMES if name != "pose" or name in arrays]
        flat = {name: np.asarray(arrays[name], np.float32).ravel() for name in known}
        return cls(**{name: on_device(x, mi.Float) for name, x in flat.items()})


class JetAtlas(Deformation):
    """The template's jets on the device, and their deformations, in single precision; carried by a
    ``carrier`` as :class:`polysft_mi.surface.atlas.Atlas` is.
    """

    def __init__(self, template, carrier=None):
        super().__init__(template, _on_device)
        self._carrier = carrier

    def rest(self):
        """The unknowns of the undeformed template."""
        t = self.template
        return Unknowns.zero(t.alpha.size, len(t.vertices), len(t))

    def vertices(self, unknowns):
        """Positions of the vertices, Point3f of N [m, world]."""
        found = self.at_rest(unknowns)
        if not dr.width(unknowns.pose):
            return found
        pose = self._carrier.pose(np.array(dr.detach(unknowns.pose), dtype=np.float64))
        maps = self._carrier.maps(pose)
        rows = [[_on_device(maps.linear[:, a, b]) for b in range(3)] for a in range(3)]
        shift = mi.Vector3f(*(_on_device(maps.shift[:, a]) for a in range(3)))
        return mi.Point3f(*(sum(m * x for m, x in zip(row, found)) for row in rows)) + shift

    def at_rest(self, unknowns):
        """:meth:`vertices` before a body carries them."""
        return mi.Point3f(*super().vertices(unknowns))

    def patch_points(self, unknowns):
        """Where each patch that holds a vertex has it, undisplaced: pairs of the patch's share in
        the N vertices (Float of N, 0 where there is none) and points (Point3f of N [m, camera
        frame]).
        """
        return [
            (layer.weight, mi.Point3f(*self._points(layer, unknowns, displaced=False)))
            for layer in self._layers
        ]

    def tangents(self, unknowns):
        """As :meth:`Deformation.tangents`, Vector3f of N each."""
        return tuple(mi.Vector3f(*t) for t in super().tangents(unknowns))

    def normals(self, unknowns):
        """As :meth:`Deformation.normals`, Normal3f of N."""
        return mi.Normal3f(*super().normals(unknowns))


def _on_device(array):
    """An array (N,) of numbers or indices as a Float or UInt32. Opaque: the numbers of one template
    must not be baked into kernels that serve every template.
    """
    made = on_device(array, mi.UInt32 if array.dtype.kind == "i" else mi.Float)
    dr.make_opaque(made)
    return made
