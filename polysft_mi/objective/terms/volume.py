"""A closed surface keeps its volume. Import only after a Mitsuba variant is set."""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polyfit.mesh import sheets, winding
from polysft_mi.errors import InputError

from .term import Term


class Volume(Term):
    """k_volume times (V / V_0 - 1)^2, V_0 the template's. Raises InputError where that is open."""

    name, setting = "volume", "k_volume"

    def __init__(self, inputs):
        super().__init__(inputs)
        template = inputs.template
        if not template.is_closed:
            raise InputError(
                f"{inputs.where}: k_volume = {self.weight:g}, but the template is open and has no"
                " volume; 0 is right"
            )
        self._atlas, faces = inputs.atlas, template.faces
        turned = winding(sheets(faces)) < 0
        #: (F, 3): all wound alike
        self.faces = np.where(turned[:, None], faces[:, ::-1], faces)
        self.rest = self.of(template.vertices)  # [m^3]
        self._corners = [on_device(k, mi.UInt32) for k in self.faces.T]

    def of(self, vertices):
        """The volume [m^3], negative where faces are wound inwards."""
        a, b, c = (vertices - vertices.mean(0))[self.faces.T]
        return float(np.einsum("fk,fk->", a, np.cross(b, c))) / 6

    def energy(self, at):
        flat = mi.Float64(dr.ravel(at.vertices))
        middle = mi.Vector3d(*(dr.mean(mi.Float64(x)) for x in dr.detach(at.vertices)))
        a, b, c = (dr.gather(mi.Vector3d, flat, k) - middle for k in self._corners)
        volume = dr.sum(dr.dot(a, dr.cross(b, c))) / 6
        return mi.Float(self.weight * dr.square(volume / self.rest - 1))

    def add(self, at):
        """Its curvature is that by the jets and motions: displacements follow lengths."""
        x, normal, atlas = at.surface.vertices, at.normal, self._atlas
        a, b, c = (x - x.mean(0))[self.faces.T]
        by_vertex = np.zeros((len(x), 3))
        for k, by_corner in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
            for axis in range(3):
                column = by_corner[:, axis]
                by_vertex[:, axis] += np.bincount(self.faces[:, k], column, len(x))
        by_vertex /= 6 * self.rest
        change = self.of(x) / self.rest - 1
        along = at.surface.by_offset(by_vertex)[:, : at.d]
        columns = atlas.to_globals(at.surface, by_vertex)
        normal.local_gradient += 2 * self.weight * change * along
        normal.gradient += 2 * self.weight * change * columns
        normal.glob += 2 * self.weight * np.outer(columns, columns)
        return self.weight * change**2
