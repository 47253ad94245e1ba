"""The volume that a closed surface keeps: (V / V_0 - 1)^2, to second order. NumPy only."""

import numpy as np

from polyfit.mesh import sheets, winding


class Volume:
    """The squared relative change of the volume within a ``template``
    (:class:`polysft_mi.surface.template.Template`) that is closed.
    """

    def __init__(self, template):
        faces = template.faces
        turned = winding(sheets(faces)) < 0
        #: (F, 3): all wound alike
        self.faces = np.where(turned[:, None], faces[:, ::-1], faces)
        self.rest = self.of(template.vertices)  # [m^3]

    def of(self, vertices):
        """The volume [m^3], negative where faces are wound inwards."""
        a, b, c = (vertices - vertices.mean(0))[self.faces.T]
        return float(np.einsum("fk,fk->", a, np.cross(b, c))) / 6

    def add(self, normal, atlas, surface, weight):
        """Add it to the equations in an ``atlas``' unknowns, times ``weight``; returns its energy.
        Its curvature is that by the jets and motions: displacements follow lengths.
        """
        x, count = surface.vertices, len(surface.vertices)
        a, b, c = (x - x.mean(0))[self.faces.T]
        by_vertex = np.zeros((count, 3))
        for k, by_corner in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
            for axis in range(3):
                column = by_corner[:, axis]
                by_vertex[:, axis] += np.bincount(self.faces[:, k], column, count)
        by_vertex /= 6 * self.rest
        change = self.of(x) / self.rest - 1
        d = normal.local.shape[-1]
        along = np.einsum("nk,nka->na", by_vertex, surface.offset_jacobian)[:, :d]
        columns = atlas.to_globals(surface, by_vertex)
        normal.local_gradient += 2 * weight * change * along
        normal.gradient += 2 * weight * change * columns
        normal.glob += 2 * weight * np.outer(columns, columns)
        return weight * change**2
