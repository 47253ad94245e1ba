"""Mesh inextensibility: edges keep the template's lengths (paper, eq. isometry_mesh). Import only
after a Mitsuba variant is set.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device

from ..quadratic import EdgeRows
from .term import Term


class Inextensibility(Term):
    """k_mi times the sum over edges of ((e_P - e_T) / s)^2, s the template's scale.

    With ``mi_norm`` = charbonnier, an edge that is stretched by more than the strain ``give``
    hardly pulls harder (:class:`polysft_mi.objective.quadratic.EdgeRows`): cloth that hangs from a
    point is stretched there by a tenth, and by squares that would turn the whole sheet. What is
    compressed buckles; its costs are squares. On a body a compressed edge yields from ``give`` on,
    too: depth hangs on the lengths there, and a norm that yields on one side makes all too long.
    """

    name, setting = "inextensibility", "k_mi"

    def __init__(self, inputs):
        super().__init__(inputs)
        template = inputs.template
        gives = inputs.settings.mi_norm == "charbonnier"
        self._give = inputs.rules.give if gives else math.inf
        self._shrink = self._give if inputs.settings.body else math.inf
        self._unit = template.scale**2
        edges = template.edges
        # of the surface as the device has it: what it rounds is no strain
        with dr.suspend_grad():
            rest = np.array(inputs.surface.vertices(inputs.surface.rest()), dtype=np.float64).T
        lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        #: (E,) [m]
        self.lengths = lengths.astype(np.float32).astype(np.float64)
        self._atlas = inputs.atlas
        self._edges = tuple(on_device(edges[:, k], mi.UInt32) for k in (0, 1))

    def lengths_in(self, frame):
        """The edges' lengths (E,) [m] in a frame where nothing strains them: the template's, or, on
        a body, those of the drape, which its weight has stretched.
        """
        carrier = self._atlas.carrier
        known = carrier is not None and carrier.lengths is not None
        return carrier.lengths[frame] if known else self.lengths

    def _strains(self, stage):
        """(give, shrink), as :class:`polysft_mi.objective.quadratic.EdgeRows` has them."""
        return (self._give, self._shrink) if stage.gives else (math.inf, math.inf)

    def energy(self, at):
        rest = mi.Float64(self.lengths_in(at.context.frame))
        excess = edge_lengths(at.vertices, self._edges) - rest
        give, shrink = self._strains(at.stage)
        over = dr.square(excess / (dr.select(excess > 0, give, shrink) * rest))
        squared = dr.square(excess) * 2 / (1 + dr.sqrt(1 + over))
        return mi.Float(self.weight * at.stage.stiffness / self._unit * dr.sum(squared))

    def rows(self, at):
        stiffness = self.weight * at.stage.stiffness / self._unit
        lengths = self.lengths_in(at.context.frame)
        at.edges = EdgeRows(lengths, stiffness, *self._strains(at.stage))

    def add(self, at):
        return at.edge_energy


def edge_lengths(points, edges):
    """Lengths of the edges (pair of UInt32 of E) between points (Point3f of N [m]): a Float64 of E.
    In double, so that the gradient of a vertex does not depend on the order of its edges.
    """
    flat = mi.Float64(dr.ravel(points))
    a, b = (dr.gather(mi.Point3d, flat, i) for i in edges)
    return dr.norm(a - b)
