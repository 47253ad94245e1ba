"""The rim of a surface, continued from the inside. NumPy and SciPy only.

A rim that begins to fold looks alike whether it turns to the camera or away, and once it has
turned the wrong way, no small step leads back. What it would be, did it only go on as the surface
does inside of it, lies between both.
"""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from polyfit.mesh import areas, boundary_edges

_RIDGE = 1e-9  # of the bending energy, that makes it definite


class Rim:
    """The ``vertices`` (N,) bool of a ``template`` within a distance of its border: a ``share`` of
    its size, the root of its area.

    ``bends`` (H, N): the matrix of :func:`polysft_mi.surface.hinges`. False where no vertex is in
    the rim: also where those inside of it would lie in a line, and not say how it goes on.
    """

    def __init__(self, template, bends, share):
        points, faces, (a, b) = template.vertices, template.faces, template.edges.T
        self._rest = points
        lengths = np.linalg.norm(points[a] - points[b], axis=1)
        self._links = sp.csr_matrix((lengths, (a, b)), (len(points), len(points)))
        self.vertices = np.zeros(len(points), dtype=bool)
        if len(border := np.unique(boundary_edges(faces))) and share > 0:
            away = dijkstra(self._links, directed=False, indices=border, min_only=True)
            self.vertices = away <= share * np.sqrt(areas(points, faces).sum())
            if not _spread(points[~self.vertices]):
                self.vertices[:] = False
        if self:
            rim, energy = self.vertices, (bends.T @ bends).tocsr()
            ridge = _RIDGE * sp.identity(rim.sum())
            self._factor = splu((energy[rim][:, rim] + ridge).tocsc())
            self._known = energy[rim][:, ~rim]

    def __bool__(self):
        return bool(self.vertices.any())

    def continued(self, surface):
        """``surface`` (N, 3) with the vertices of the rim where it bends least from the template,
        which lies on the others as best it can; the others are held.
        """
        held = ~self.vertices
        (of_rest, of_surface) = (x[held].mean(0) for x in (self._rest, surface))
        turn, _ = Rotation.align_vectors(surface[held] - of_surface, self._rest[held] - of_rest)
        posed = turn.apply(self._rest - of_rest) + of_surface
        found = surface.copy()
        bent = self._factor.solve(-(self._known @ (surface - posed)[held]))
        found[self.vertices] = posed[self.vertices] + bent
        return found

    def parts(self, chosen):
        """The connected parts of the rim's vertices that are ``chosen`` (N,) bool: indices each."""
        at = np.flatnonzero(chosen & self.vertices)
        count, part = connected_components(self._links[at][:, at], directed=False)
        return [at[part == k] for k in range(count)]


def _spread(points):
    """Whether ``points`` (N, 3) lie in no line."""
    if len(points) < 3:
        return False
    sizes = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(sizes[1] > 1e-3 * sizes[0])
