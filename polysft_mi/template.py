"""The template: a mesh held by one jet in its canonical frame (paper, sections "PolyFit" and "PolySfT"). NumPy, and torch for the fit."""

from dataclasses import dataclass

import numpy as np

from polyfit.monomials import order_of, size_of

from .errors import InputError


@dataclass(frozen=True)
class Template:
    """A surface S = {O, phi(u, v)}: mesh, orientation, chart and coefficients, float64.

    ``vertices`` (N, 3) [m, camera frame] and ``faces`` (F, 3) as in the file; ``uv`` (N, 2) texture coordinates, v up; ``scale`` [m],
    ``rotation`` (3, 3), ``origin`` (3,) [m]: the orientation O = (s, R, T), p = s R x + T; ``chart`` (N, 2): (u, v) of each vertex, at
    most 1 in norm; ``alpha`` (A,): the jet, in the chart's unit, zero beyond the order that was fitted; ``residual`` (N,) [m]: signed
    distance along the chart's normal that the jet leaves; ``fitted``: the order that was fitted.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    scale: float
    rotation: np.ndarray
    origin: np.ndarray
    chart: np.ndarray
    alpha: np.ndarray
    residual: np.ndarray
    fitted: int

    @property
    def order(self):
        """The order that the coefficients are for."""
        return order_of(len(self.alpha))

    @property
    def edges(self):
        """Edges of the mesh, each once, (E, 2)."""
        e = np.sort(np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]), axis=1)
        return np.unique(e, axis=0)

    @property
    def residual_rms(self):
        """Root mean square of the residual [m]."""
        return float(np.sqrt((self.residual**2).mean()))

    @property
    def residual_max(self):
        """Largest residual [m]."""
        return float(np.abs(self.residual).max())

    @classmethod
    def fit(cls, vertices, faces, uv, order, *, capacity=None, exact=True, frame=None, tolerance=0.05, where="template"):
        """Fit a jet of ``order`` to the mesh, in ``frame``, a :class:`polyfit.frames.CanonicalFrame` in float64, or else in its PCA frame;
        it has the coefficients of order ``capacity`` (default: the same), those beyond ``order`` zero. Where not ``exact``, vertices that
        determine less get the highest order that they do.

        Raises InputError where the order is too high for the vertices (if ``exact``), where the surface folds over in its chart (a closed surface does),
        or where the largest residual exceeds ``tolerance`` times the scale s.
        """
        import torch  # takes longer than the rest of a start together

        from polyfit import jets
        from polyfit.frames import CanonicalFrame

        points = torch.as_tensor(np.asarray(vertices, dtype=np.float64))
        frame = frame or CanonicalFrame.from_points(points)
        x = frame.to_chart(points)
        fitted = jets.fit(x, order)
        if fitted.order < order and exact:
            wanted = f"a jet of order {order} has {size_of(order)} coefficients"
            found = f"the {len(points)} vertices determine no more than order {int(fitted.order)}"
            raise InputError(f"{where}: order = {order} is too high: {wanted}, and {found}")
        alpha = fitted.alpha
        residual = (x[:, 2] - jets.height(alpha, x[:, :2])).numpy() * float(frame.s)
        template = cls(
            np.asarray(vertices, dtype=np.float64),
            np.asarray(faces, dtype=np.int64),
            np.asarray(uv, dtype=np.float64),
            float(frame.s),
            frame.R.numpy(),
            frame.T.numpy(),
            x[:, :2].numpy(),
            np.pad(alpha.numpy(), (0, size_of(max(order, capacity or order)) - len(alpha))),
            residual,
            int(fitted.order),
        )
        measured = (
            f"the residual of the {template.fitted}-jet is {1e3 * template.residual_rms:.3g} mm RMS, {1e3 * template.residual_max:.3g} mm at most, "
            f"of a radius of {1e3 * template.scale:.3g} mm"
        )
        flipped = _flipped(template.chart, template.faces)
        if flipped:
            raise InputError(
                f"{where}: one jet cannot hold it: {flipped} of {len(faces)} triangles fold over in its chart ({measured}); "
                "a height graph over a plane is needed"
            )
        if template.residual_max > tolerance * template.scale:
            raise InputError(
                f"{where}: one jet cannot hold it: {measured}; at most fit_tolerance = {tolerance:g} of the radius is accepted, a higher order may do"
            )
        return template


def _flipped(chart, faces):
    """Triangles that lie in the chart the other way round than most."""
    a, b, c = (chart[faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    up = int((area > 0).sum())
    return min(up, len(faces) - up)
