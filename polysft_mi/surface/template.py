"""The template: a mesh held by one jet in its canonical frame (paper, sections "PolyFit" and
"PolySfT"). NumPy.

The frame and the fit are those of :class:`polyfit.CanonicalFrame` and
:func:`polyfit.jets.fit`, for one patch: to load torch would take longer than the rest of a run's
start.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev

from polyfit.jets import DETERMINED_RMS, MIN_BOX_RATIO, exponents, order_of, size_of
from polysft_mi.errors import InputError


@dataclass(frozen=True)
class Template:
    """A surface S = {O, phi(u, v)}: mesh, orientation, chart and coefficients, float64.

    ``vertices`` (N, 3) [m, camera frame] and ``faces`` (F, 3) as in the file; ``uv`` (N, 2) texture
    coordinates, v up; ``scale`` [m], ``rotation`` (3, 3), ``origin`` (3,) [m]: the orientation O =
    (s, R, T), p = s R x + T; ``chart`` (N, 2): (u, v) of each vertex, at most 1 in norm; ``alpha``
    (A,): the jet, in the chart's unit; ``residual`` (N,) [m]: signed distance along the chart's
    normal that the jet leaves.
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

    @property
    def order(self):
        """The order of the jet."""
        return order_of(len(self.alpha))

    @property
    def edges(self):
        """Edges of the mesh, each once, (E, 2)."""
        e = np.sort(
            np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]),
            axis=1,
        )
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
    def fit(
        cls,
        vertices,
        faces,
        uv,
        order,
        *,
        exact=True,
        frame=None,
        tolerance=0.05,
        where="template",
    ):
        """Fit a jet of ``order`` to the mesh, in ``frame``, a
        :class:`polyfit.CanonicalFrame` in float64, or else in its PCA frame. Where not
        ``exact``, vertices that determine less get the highest order that they do.

        Raises InputError where the order is too high for the vertices (if ``exact``), where the
        surface folds over in its chart (a closed surface does), or where the largest residual
        exceeds ``tolerance`` times the scale s.
        """
        points = np.asarray(vertices, dtype=np.float64)
        scale, rotation, origin = (
            _principal_frame(points)
            if frame is None
            else (np.asarray(x) for x in (frame.s, frame.R, frame.T))
        )
        x = (points - origin) @ rotation / scale
        alpha, fitted = _fitted(x, order)
        if fitted < order and exact:
            wanted = f"a jet of order {order} has {size_of(order)} coefficients"
            found = f"the {len(points)} vertices determine no more than order {fitted}"
            raise InputError(f"{where}: order = {order} is too high: {wanted}, and {found}")
        height = np.polynomial.polynomial.polyval2d(*x[:, :2].T, matrix(alpha))
        template = cls(
            points,
            np.asarray(faces, dtype=np.int64),
            np.asarray(uv, dtype=np.float64),
            float(scale),
            rotation,
            origin,
            x[:, :2],
            alpha[: size_of(fitted)],
            (x[:, 2] - height) * float(scale),
        )
        measured = (
            f"the residual of the {template.order}-jet is {1e3 * template.residual_rms:.3g} mm"
            f" RMS, {1e3 * template.residual_max:.3g} mm at most, of a radius of"
            f" {1e3 * template.scale:.3g} mm"
        )
        flipped = _flipped(template.chart, template.faces)
        if flipped:
            raise InputError(
                f"{where}: one jet cannot hold it: {flipped} of {len(faces)} triangles fold over in"
                f" its chart ({measured}); a height graph over a plane is needed"
            )
        if template.residual_max > tolerance * template.scale:
            raise InputError(
                f"{where}: one jet cannot hold it: {measured}; at most fit_tolerance ="
                f" {tolerance:g} of the radius is accepted; a higher order may help"
            )
        return template


def _flipped(chart, faces):
    """Triangles that lie in the chart the other way round than most."""
    a, b, c = (chart[faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    up = int((area > 0).sum())
    return min(up, len(faces) - up)


def _principal_frame(points):
    """(s, R, T) of points (P, 3) by their principal components, signs by the data, as
    ``CanonicalFrame.from_points`` has them.
    """
    origin = points.mean(0)
    centred = points - origin
    scale = np.sqrt((centred**2).sum(1).max())
    if not np.isfinite(scale) or not scale > 1e-12 * np.abs(points).max():
        raise InputError(f"the template's {len(points)} vertices are not finite, or coincide")
    x = centred / scale
    _, axes = np.linalg.eigh(x.T @ x / len(x))
    u, v = (axis * _side(x @ axis) for axis in (axes[:, 2], axes[:, 1]))
    return scale, np.stack([u, v, np.cross(u, v)], 1), origin


def _side(along):
    """1 or -1: where the third moment of coordinates (P,) lies; of symmetric ones, where the first
    lies that is half as far out as the farthest."""
    skew = (along**3).mean()
    far = np.abs(along) >= 0.5 * np.abs(along).max()
    return -1.0 if (skew if abs(skew) > 1e-9 else along[far.argmax()]) < 0 else 1.0


def _fitted(x, order):
    """(coefficients (A,), order) of the least-squares jet of ``order`` through points x (P, 3) of a
    chart, or of the highest order that they determine: products of Chebyshev polynomials in the
    points' box, turned into monomials."""
    powers = exponents(order)
    low, high = x[:, :2].min(0), x[:, :2].max(0)
    centre, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, max(MIN_BOX_RATIO * half.max(), 1e-300))
    values = [
        chebyshev.chebvander((x[:, k] - centre[k]) / half[k], order)[:, powers[:, k]]
        for k in (0, 1)
    ]
    basis = values[0] * values[1] / np.sqrt(len(x))
    kept = np.zeros(len(powers))
    diagonal = np.abs(np.diagonal(np.linalg.qr(basis, mode="r")))
    kept[: len(diagonal)] = diagonal
    fitted = int(min(powers.sum(1)[kept < DETERMINED_RMS], default=order + 1)) - 1
    size = size_of(fitted)
    solution = np.zeros(len(powers))
    solution[:size] = np.linalg.lstsq(basis[:, :size], x[:, 2] / np.sqrt(len(x)), rcond=None)[0]
    axes = [
        [
            Chebyshev.basis(n, domain=[c - h, c + h]).convert(kind=Polynomial).coef
            for n in range(order + 1)
        ]
        for c, h in zip(centre, half)
    ]
    to_u, to_v = (
        np.stack([np.pad(row, (0, order + 1 - len(row))) for row in rows]) for rows in axes
    )
    return (to_u.T @ matrix(solution) @ to_v)[tuple(powers.T)], fitted


def matrix(alpha):
    """Coefficients (A,) as a matrix over the powers of u and v."""
    order = order_of(len(alpha))
    out = np.zeros((order + 1, order + 1))
    out[tuple(exponents(order).T)] = alpha
    return out
