"""The template: a mesh held by an atlas of jets, each in a canonical frame (paper, sections
"PolyFit" and "PolySfT"). NumPy.

A sheet is one patch. What no height graph over one plane can hold is cut into as few patches as can
(:mod:`polyfit.patches.atlas`). What the jets leave of the mesh is kept, so that the undeformed
template is the mesh that was given.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from polyfit import jets
from polyfit.jets import CanonicalFrame
from polyfit.mesh import TexCoords, components, edges_of, sheets, vertex_normals, winding
from polyfit.patches import Cover, is_graph
from polysft_mi.errors import InputError

_RIDGE = 1e-3  # of a jet's mean square, that holds it where several patches share a surface


@dataclass(frozen=True)
class Template:
    """A surface of K patches S_k = {O_k, phi_k(u, v)}, of N vertices, float64.

    ``vertices`` (N, 3) [m, camera frame] and ``faces`` (F, 3) as in the file; ``texcoords``: the
    :class:`polyfit.mesh.TexCoords` of the faces' corners; ``scale`` [m]: the
    surface's radius, the unit of displacements and translations.

    ``radius`` (K,) [m], ``rotation`` (K, 3, 3), ``origin`` (K, 3) [m]: the orientations O_k = (s,
    R, T), p = s R x + T; ``alpha`` (K, A): the jets, in the charts' units.

    ``patch`` (N, M), ``weight`` (N, M): the patches that hold a vertex, the first its own, and
    their shares in it; ``chart`` (N, M, 2): its (u, v) there, ``rest`` (N, M): its height over the
    jet there [chart unit]; ``axes`` (N, 3, 3): the axes of (Δu, Δv, Δw) in space,
    columns of length 1: tangents and normal, or the chart's where there is one patch; ``lift``
    (N,): what its own chart adds to the height for each length along the third axis, so that the
    vertex moves along it, whatever the jet's slope.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texcoords: TexCoords
    scale: float
    radius: np.ndarray
    rotation: np.ndarray
    origin: np.ndarray
    alpha: np.ndarray
    patch: np.ndarray
    weight: np.ndarray
    chart: np.ndarray
    rest: np.ndarray
    axes: np.ndarray
    lift: np.ndarray

    def __len__(self):
        """K, the number of patches."""
        return len(self.alpha)

    @property
    def order(self):
        """The order of the jets."""
        return jets.order_of(self.alpha.shape[1])

    @cached_property
    def edges(self):
        """Edges of the mesh, each once, (E, 2)."""
        return edges_of(self.faces)[0]

    @property
    def residual(self):
        """What the jets leave at each vertex (N,) [m]: distance along the chart's normal in its own
        patch.
        """
        return self.rest[:, 0] * self.radius[self.patch[:, 0]]

    @property
    def residual_rms(self):
        """Root mean square of the residual [m]."""
        return float(np.sqrt((self.residual**2).mean()))

    @property
    def residual_max(self):
        """Largest residual [m]."""
        return float(np.abs(self.residual).max())

    @property
    def is_closed(self):
        """Whether the mesh encloses a volume: each edge has exactly two faces."""
        return bool((np.bincount(edges_of(self.faces)[1].ravel()) == 2).all())

    @classmethod
    def fit(
        cls, vertices, faces, uv, order, *, exact=True, frame=None, cover=None, where="template"
    ):
        """Fit jets of ``order`` to the mesh: one in ``frame``, a :class:`polyfit.CanonicalFrame` in
        float64 (of torch or NumPy), or else in its PCA frame; several where the mesh is no height
        graph there, or a steep one; or those of ``cover``, a :class:`polyfit.patches.Cover` of the
        mesh.

        ``uv``: texture coordinates (N, 2), or :class:`polyfit.mesh.TexCoords`. ``order`` may be a
        function of the number of patches. Where not ``exact``, vertices that determine less get the
        highest order that they do, of several patches those that determine most. Raises InputError
        where the order is too high for the vertices (if ``exact``), or where ``frame`` is given and
        one patch cannot hold the mesh.
        """
        points, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        if not isinstance(uv, TexCoords):
            uv = TexCoords(np.asarray(uv, dtype=np.float64), faces)
        whole = _frame_of(points) if frame is None else frame
        whole = CanonicalFrame(*(np.asarray(x) for x in (whole.s, whole.R, whole.T)))
        scale = float(whole.s)
        alike = np.where(winding(sheets(faces))[:, None] < 0, faces[:, ::-1], faces)
        graph = is_graph(points, alike, whole.R[:, 2]) and _components_of(faces) == 1
        graph = graph and cover is None
        if cover is None and frame is None:
            # a skirt is a graph over the plane of its hem, but a steep one
            cover = Cover.of(points, alike)
        if graph and (frame is not None or len(cover) == 1):
            patch, weight = np.zeros((len(points), 1), dtype=np.int64), np.ones((len(points), 1))
            frames = [whole]
            axes = np.tile(whole.R, (len(points), 1, 1))
        elif frame is not None:
            raise InputError(
                f"{where}: one jet cannot hold it in the frame that is given: triangles fold over"
                " in its chart; a height graph over a plane is needed"
            )
        else:
            patch, weight = cover.patch, cover.weight
            frames = [
                CanonicalFrame.over(points[((patch == k) & (weight > 0)).any(1)], normal, scale)
                for k, normal in enumerate(cover.normal)
            ]
            axes = _tangent_axes(points, alike, patch[:, 0], np.stack([f.R for f in frames]))
        order = order(len(frames)) if callable(order) else order
        radius, rotation, origin = (np.array(x) for x in zip(*((f.s, f.R, f.T) for f in frames)))
        x = CanonicalFrame(radius, rotation, origin)[patch].to_chart(points[:, None, None])[:, :, 0]
        alpha, rest = _jets(x, patch, weight > 0, len(frames), order, exact, where)
        texcoords = TexCoords(np.asarray(uv.coordinates, np.float64), np.asarray(uv.faces))
        jets_of = radius, rotation, origin, alpha, patch, weight, x[..., :2], rest, axes
        lift = _lift(x[:, 0, :2], patch[:, 0], alpha, rotation, axes)
        return cls(points, faces, texcoords, scale, *jets_of, lift)


def _components_of(faces):
    """How many connected components the faces (F, 3) have."""
    return int(components(faces.max() + 1, edges_of(faces)[0])[faces].max()) + 1


def _jets(x, patch, held, count, order, exact, where):
    """(alpha (K, A), rest (N, M)): jets through the points ``x`` (N, M, 3) of the charts, and their
    heights over them.
    """
    # where the rim of a patch is steep, as a shirt's at its seams, a jet that is free would swing
    ridge, found = _RIDGE if count > 1 else 0.0, []
    for k in range(count):
        points = x[held & (patch == k)]
        found.append(jets.fit_points(points, order, ridge))
        if found[-1].order < order and exact:
            wanted = f"a jet of order {order} has {jets.size_of(order)} coefficients"
            few = f"the {len(points)} vertices determine no more than order {found[-1].order}"
            raise InputError(f"{where}: order = {order} is too high: {wanted}, and {few}")
    most = max(jet.order for jet in found)  # coefficients beyond a jet's own order are 0
    alpha = np.stack([jet.alpha[: jets.size_of(most)] for jet in found])
    rest = np.zeros(patch.shape)
    for k in range(count):
        at = held & (patch == k)
        rest[at] = x[at][:, 2] - jets.height(alpha[k], x[at][:, :2])
    return alpha, rest


def _frame_of(points):
    """The PCA frame of the vertices (N, 3)."""
    try:
        return CanonicalFrame.from_points(points)
    except InputError:
        raise InputError(
            f"the template's {len(points)} vertices are not finite, or coincide"
        ) from None


def _tangent_axes(points, faces, patch, rotation):
    """Axes (N, 3, 3) at the vertices: the third is the normal, the first the projected u of its own
    chart.
    """
    third = vertex_normals(points, faces)
    third = np.where(third.any(1)[:, None], third, rotation[patch][..., 2])
    first = np.cross(rotation[patch][..., 1], third)
    flat = np.linalg.norm(first, axis=1) < 0.1  # the normal along the chart's v
    first[flat] = rotation[patch][flat][..., 0]
    first -= (first * third).sum(1, keepdims=True) * third
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], 2)


def _lift(chart, patch, alpha, rotation, axes):
    """``lift`` (N,) of :class:`Template`, from the own charts' coordinates (N, 2) and patches
    (N,).
    """
    third = np.einsum("nij,ni->nj", rotation[patch], axes[..., 2])
    lift = third[:, 2].copy()
    for k, coefficients in enumerate(alpha):
        at = patch == k
        slopes = jets.height_derivatives(coefficients, chart[at])
        lift[at] -= (np.stack(slopes, 1) * third[at][:, :2]).sum(1)
    return lift
