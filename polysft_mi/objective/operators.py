"""The linear operators that smoothness is made of, for the host and for the device. Import
only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.surface import Pattern, hinges, slides

from .visibility import VisibilityWeights


class Operators:
    """What differences of displacements are made with, on a template's mesh.

    ``patterns``: number of local unknowns (2, or 3 with the relief) to the
    :class:`polysft_mi.surface.pattern.Pattern` of their blocks; ``slides`` (2E, 2N): differences of
    (Δu, Δv) along the edges, in the axes of the first end; ``bends`` (H, N): bends of heights at
    the inner edges; ``relief_bend``: their share of the relief's weight.
    """

    def __init__(self, atlas, faces, narrow, relief_bend):
        template, count = atlas.template, len(atlas.template.vertices)
        self.atlas, self.relief_bend = atlas, relief_bend
        across, self.bends = hinges(template.vertices / template.scale, faces)
        # A hinge reaches a vertex beyond the neighbours. A sheet's normal equations have room for
        # it; around a tube they would take four times as long, and its curvature is bounded.
        wide = Pattern(faces, template.edges, count, across) if len(template) == 1 else narrow
        self.patterns = {2: narrow, 3: wide}
        self.slides = slides(template.edges, template.axes)
        #: the weights where all is seen
        self.all_seen = VisibilityWeights.of(np.ones(count, dtype=bool), 1.0, self)


class DeviceOperator:
    """A sparse ``matrix`` (M, N) on the device: called with a Float64 of N, it returns one of M,
    attached. Rows are padded to the longest one.
    """

    def __init__(self, matrix):
        rows = matrix.tocsr()
        rows.sum_duplicates()
        count = np.diff(rows.indptr)
        self._columns = []
        for k in range(count.max(initial=0)):
            at = np.minimum(rows.indptr[:-1] + k, max(len(rows.data) - 1, 0))
            held = count > k
            value = np.where(held, rows.data[at], 0.0)
            column = np.where(held, rows.indices[at], 0)
            self._columns.append((on_device(value, mi.Float64), on_device(column, mi.UInt32)))

    def __call__(self, x):
        return sum(value * dr.gather(mi.Float64, x, column) for value, column in self._columns)
