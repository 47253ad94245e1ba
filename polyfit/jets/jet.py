"""n-jets: heights z(u, v) = sum_i sum_j alpha_{i-j,j} u^(i-j) v^j and their closed-form geometry
(paper, section "PolyFit"), of arrays of NumPy, torch or Dr.Jit.

``alpha`` (..., A) has A = (n+1)(n+2)/2 entries, in the paper's order: i = 0..n, and j = 0..i within
each i, that is 1, u, v, u^2, uv, v^2, u^3, ... ``uv`` (..., P, 2) are P chart coordinates of each
jet; leading dimensions broadcast, so that one jet (A,) takes (P, 2) and a batch (B, A) takes (B, P,
2). In Dr.Jit ``alpha`` is a tuple of A Floats, of one number or of P, ``uv`` a tuple of two Floats
of P; vectors and matrices come as tuples too. All lengths are in the canonical unit
(:class:`polyfit.CanonicalFrame`), curvatures in its inverse. Everything is differentiable in
``alpha`` and ``uv``.
"""

import math
from functools import lru_cache
from typing import Any

from polyfit.errors import InputError

from .backends import namespace
from .monomials import exponents, order_of


def matrix(alpha: Any) -> Any:
    """alpha (..., A) as the matrix m (..., n+1, n+1) of z = sum_ab m_ab u^a v^b; zero where a + b >
    n.
    """
    xp = namespace(alpha)
    order = order_of(xp.size(alpha))
    return xp.square(alpha, order + 1, _places(order, xp, getattr(alpha, "device", None)))


@lru_cache
def _places(order: int, xp: Any, device: Any) -> Any:
    """Where the coefficients stand in the flattened matrix, (A,)."""
    return xp.constant(exponents(order) @ (order + 1, 1), device)


def from_matrix(m: Any) -> Any:
    """The coefficients (..., A) of a matrix (..., n+1, n+1), of NumPy or torch."""
    flat = m.reshape(*m.shape[:-2], -1)
    return flat[..., _places(m.shape[-1] - 1, namespace(m), m.device)]


def powers(x: Any, order: int, derivative: int = 0) -> Any:
    """The derivatives of x^0 .. x^n, (..., n+1)."""
    xp = namespace(x)
    out = [xp.full_like(x, 0)] * min(derivative, order + 1)
    power = xp.full_like(x, 1)
    for k in range(derivative, order + 1):
        out.append(power * float(math.perm(k, derivative)))
        power = power * x
    return xp.stack(out)


def basis(uv: Any, order: int, du: int = 0, dv: int = 0) -> Any:
    """The monomials' derivatives d^(du+dv) / du^du dv^dv at uv (..., 2), of NumPy or torch: (...,
    A).
    """
    e = exponents(order)
    return powers(uv[..., 0], order, du)[..., e[:, 0]] * powers(uv[..., 1], order, dv)[..., e[:, 1]]


def derivatives(alpha: Any, uv: Any, *which: tuple[int, int]) -> tuple[Any, ...]:
    """For each (du, dv) in ``which`` the derivative d^(du+dv) z / du^du dv^dv at uv, (..., P)."""
    xp, m = namespace(uv), matrix(alpha)
    order = order_of(xp.size(alpha))
    if xp.size(uv) != 2:
        raise InputError(f"uv of {xp.size(uv)} coordinates; (..., points, 2) is needed")
    u, v = xp.parts(uv)
    along_v = {du: xp.times(powers(u, order, du), m) for du in {du for du, _ in which}}
    of_v = {dv: powers(v, order, dv) for dv in {dv for _, dv in which}}
    return tuple(xp.dot(along_v[du], of_v[dv]) for du, dv in which)


def height(alpha: Any, uv: Any) -> Any:
    """z, (..., P)."""
    return derivatives(alpha, uv, (0, 0))[0]


def height_derivatives(alpha: Any, uv: Any) -> tuple[Any, ...]:
    """(z_u, z_v), each (..., P)."""
    return derivatives(alpha, uv, (1, 0), (0, 1))


def point(alpha: Any, uv: Any) -> Any:
    """phi(u, v) = (u, v, z(u, v)), (..., P, 3)."""
    xp, z = namespace(uv), height(alpha, uv)
    return xp.stack([*(x + xp.full_like(z, 0) for x in xp.parts(uv)), z])


def tangents(alpha: Any, uv: Any) -> tuple[Any, Any]:
    """phi_u = (1, 0, z_u) and phi_v = (0, 1, z_v), each (..., P, 3)."""
    xp, (zu, zv) = namespace(uv), height_derivatives(alpha, uv)
    one, zero = xp.full_like(zu, 1), xp.full_like(zu, 0)
    return xp.stack([one, zero, zu]), xp.stack([zero, one, zv])


def normal(alpha: Any, uv: Any) -> Any:
    """Unit normal (..., P, 3), along (-z_u, -z_v, 1)."""
    xp, (zu, zv) = namespace(uv), height_derivatives(alpha, uv)
    n = xp.sqrt(1 + zu * zu + zv * zv)
    return xp.stack([-zu / n, -zv / n, 1 / n])


def metric(alpha: Any, uv: Any) -> Any:
    """First fundamental form J^T J, (..., P, 2, 2)."""
    zu, zv = height_derivatives(alpha, uv)
    F = zu * zv
    return namespace(uv).matrix([(1 + zu * zu, F), (F, 1 + zv * zv)])


def turned_over(alpha: Any) -> Any:
    """The jets alpha (..., A), of NumPy or torch, in charts with v and z pointing the other way:
    z'(u, v) = -z(u, -v).
    """
    xp = namespace(alpha)
    odd = xp.constant(exponents(order_of(alpha.shape[-1]))[:, 1] % 2 == 1, alpha.device)
    return xp.module.where(odd, alpha, -alpha)


def second_fundamental_form(alpha: Any, uv: Any) -> Any:
    """(z_uu, z_uv, z_vv) / sqrt(1 + z_u^2 + z_v^2) as a matrix, (..., P, 2, 2); positive where the
    surface bends towards +z.
    """
    xp = namespace(uv)
    zu, zv, zuu, zuv, zvv = derivatives(alpha, uv, (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    n = xp.sqrt(1 + zu * zu + zv * zv)
    return xp.matrix([(zuu / n, zuv / n), (zuv / n, zvv / n)])


def _mean_and_gauss(alpha: Any, uv: Any) -> tuple[Any, Any]:
    """Mean and Gaussian curvature, each (..., P)."""
    g, h = metric(alpha, uv), second_fundamental_form(alpha, uv)
    E, F, G = g[..., 0, 0], g[..., 0, 1], g[..., 1, 1]
    L, M, N = h[..., 0, 0], h[..., 0, 1], h[..., 1, 1]
    det = E * G - F * F
    return (E * N - 2 * F * M + G * L) / (2 * det), (L * N - M * M) / det


def mean_curvature(alpha: Any, uv: Any) -> Any:
    """Mean of the principal curvatures, (..., P), of NumPy or torch."""
    return _mean_and_gauss(alpha, uv)[0]


def principal_curvatures(alpha: Any, uv: Any) -> Any:
    """Eigenvalues of the shape operator, the smaller first, (..., P, 2), of NumPy or torch;
    positive where the surface bends towards +z.

    At an umbilic, where both are equal and not differentiable, each has the gradient of the mean
    curvature.
    """
    xp = namespace(uv)
    mean, gauss = _mean_and_gauss(alpha, uv)
    squared, where = mean * mean - gauss, xp.module.where
    apart = squared > xp.module.finfo(squared.dtype).eps * mean * mean
    half = where(apart, xp.sqrt(where(apart, squared, 1)), 0)
    return xp.stack([mean - half, mean + half])


def nearest(alpha: Any, x: Any, steps: int = 4) -> Any:
    """Chart coordinates uv (..., P, 2) of the jets' points nearest to points x (..., P, 3) of their
    charts, of NumPy or torch, found from the points' own (u, v) by Gauss and Newton.

    A step that does not bring the point nearer is not taken. Without gradient.
    """
    xp = namespace(x)
    where = xp.module.where
    with xp.no_grad():
        uv = x[..., :2]
        z, zu, zv = derivatives(alpha, uv, (0, 0), (1, 0), (0, 1))
        for _ in range(steps):
            r = xp.stack([uv[..., 0] - x[..., 0], uv[..., 1] - x[..., 1], z - x[..., 2]])
            a, b = r[..., 0] + zu * r[..., 2], r[..., 1] + zv * r[..., 2]
            det = 1 + zu * zu + zv * zv
            step = [(1 + zv * zv) * a - zu * zv * b, (1 + zu * zu) * b - zu * zv * a]
            tried = uv - xp.stack(step) / det[..., None]
            found = derivatives(alpha, tried, (0, 0), (1, 0), (0, 1))
            left = ((tried - x[..., :2]) ** 2).sum(-1) + (found[0] - x[..., 2]) ** 2
            nearer = left < (r * r).sum(-1)
            uv = where(nearer[..., None], tried, uv)
            z, zu, zv = (where(nearer, new, old) for new, old in zip(found, (z, zu, zv)))
        return uv
