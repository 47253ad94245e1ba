"""n-jets: heights z(u, v) = sum_i sum_j alpha_{i-j,j} u^(i-j) v^j and their closed-form geometry
(paper, section "PolyFit").

``alpha`` (..., A) has A = (n+1)(n+2)/2 entries, in the paper's order: i = 0..n, and j = 0..i within
each i, that is 1, u, v, u^2, uv, v^2, u^3, ... ``uv`` (..., P, 2) are P chart coordinates of each
jet; leading dimensions broadcast, so that one jet (A,) takes (P, 2) and a batch (B, A) takes (B, P,
2). All lengths are in the canonical unit (:class:`polyfit.CanonicalFrame`), curvatures in
its inverse. Everything is differentiable in ``alpha`` and ``uv``. The same functions stand in
Dr.Jit in ``polysft_mi.surface.jet``, by the same names.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

from .monomials import exponents, order_of


def matrix(alpha: Tensor) -> Tensor:
    """alpha (..., A) as the matrix m (..., n+1, n+1) of z = sum_ab m_ab u^a v^b; zero where a + b >
    n.
    """
    order = order_of(alpha.shape[-1])
    out = alpha.new_zeros(*alpha.shape[:-1], (order + 1) ** 2)
    out[..., _places(order, alpha.device)] = alpha
    return out.unflatten(-1, (order + 1, order + 1))


@lru_cache
def _places(order: int, device: torch.device) -> Tensor:
    """Where the coefficients stand in the flattened matrix, (A,)."""
    return torch.as_tensor(exponents(order) @ (order + 1, 1), device=device)


def from_matrix(m: Tensor) -> Tensor:
    """The coefficients (..., A) of a matrix (..., n+1, n+1)."""
    return m.flatten(-2)[..., _places(m.shape[-1] - 1, m.device)]


def powers(x: Tensor, order: int, derivative: int = 0) -> Tensor:
    """The derivatives of x^0 .. x^n, (..., n+1)."""
    out = [torch.zeros_like(x)] * min(derivative, order + 1)
    power = torch.ones_like(x)
    for k in range(derivative, order + 1):
        out.append(power * float(math.perm(k, derivative)))
        power = power * x
    return torch.stack(out, -1)


def basis(uv: Tensor, order: int, du: int = 0, dv: int = 0) -> Tensor:
    """The monomials' derivatives d^(du+dv) / du^du dv^dv at uv (..., 2): (..., A)."""
    e = exponents(order)
    return powers(uv[..., 0], order, du)[..., e[:, 0]] * powers(uv[..., 1], order, dv)[..., e[:, 1]]


def derivatives(alpha: Tensor, uv: Tensor, *which: tuple[int, int]) -> tuple[Tensor, ...]:
    """For each (du, dv) in ``which`` the derivative d^(du+dv) z / du^du dv^dv at uv, (..., P)."""
    m, order = matrix(alpha), order_of(alpha.shape[-1])
    along_v = {du: powers(uv[..., 0], order, du) @ m for du in {du for du, _ in which}}
    of_v = {dv: powers(uv[..., 1], order, dv) for dv in {dv for _, dv in which}}
    return tuple((along_v[du] * of_v[dv]).sum(-1) for du, dv in which)


def height(alpha: Tensor, uv: Tensor) -> Tensor:
    """z, (..., P)."""
    return derivatives(alpha, uv, (0, 0))[0]


def height_derivatives(alpha: Tensor, uv: Tensor) -> tuple[Tensor, ...]:
    """(z_u, z_v), each (..., P)."""
    return derivatives(alpha, uv, (1, 0), (0, 1))


def point(alpha: Tensor, uv: Tensor) -> Tensor:
    """phi(u, v) = (u, v, z(u, v)), (..., P, 3)."""
    z = height(alpha, uv)
    return torch.cat([uv.expand(*z.shape, 2), z[..., None]], -1)


def tangents(alpha: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """phi_u = (1, 0, z_u) and phi_v = (0, 1, z_v), each (..., P, 3)."""
    zu, zv = height_derivatives(alpha, uv)
    one, zero = torch.ones_like(zu), torch.zeros_like(zu)
    return torch.stack([one, zero, zu], -1), torch.stack([zero, one, zv], -1)


def normal(alpha: Tensor, uv: Tensor) -> Tensor:
    """Unit normal (..., P, 3), along (-z_u, -z_v, 1)."""
    zu, zv = height_derivatives(alpha, uv)
    return torch.nn.functional.normalize(torch.stack([-zu, -zv, torch.ones_like(zu)], -1), dim=-1)


def metric(alpha: Tensor, uv: Tensor) -> Tensor:
    """First fundamental form J^T J, (..., P, 2, 2)."""
    zu, zv = height_derivatives(alpha, uv)
    return _symmetric(1 + zu * zu, zu * zv, 1 + zv * zv)


def turned_over(alpha: Tensor) -> Tensor:
    """The jets alpha (..., A) in charts with v and z pointing the other way: z'(u, v) = -z(u,
    -v).
    """
    odd = torch.as_tensor(exponents(order_of(alpha.shape[-1]))[:, 1] % 2, device=alpha.device)
    return torch.where(odd == 1, alpha, -alpha)


def second_fundamental_form(alpha: Tensor, uv: Tensor) -> Tensor:
    """(z_uu, z_uv, z_vv) / sqrt(1 + z_u^2 + z_v^2) as a matrix, (..., P, 2, 2); positive where the
    surface bends towards +z.
    """
    zu, zv, zuu, zuv, zvv = derivatives(alpha, uv, (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    n = (1 + zu * zu + zv * zv).sqrt()
    return _symmetric(zuu / n, zuv / n, zvv / n)


def principal_curvatures(alpha: Tensor, uv: Tensor) -> Tensor:
    """Eigenvalues of the shape operator, the smaller first, (..., P, 2); positive where the surface
    bends towards +z.

    At an umbilic, where both are equal and not differentiable, each has the gradient of the mean
    curvature.
    """
    g, h = metric(alpha, uv), second_fundamental_form(alpha, uv)
    E, F, G = g[..., 0, 0], g[..., 0, 1], g[..., 1, 1]
    L, M, N = h[..., 0, 0], h[..., 0, 1], h[..., 1, 1]
    det = E * G - F * F
    mean = (E * N - 2 * F * M + G * L) / (2 * det)
    squared = mean * mean - (L * N - M * M) / det
    apart = squared > torch.finfo(squared.dtype).eps * mean.detach() ** 2
    half = torch.where(apart, torch.where(apart, squared, 1).sqrt(), 0)
    return torch.stack([mean - half, mean + half], -1)


def nearest(alpha: Tensor, x: Tensor, steps: int = 4) -> Tensor:
    """Chart coordinates uv (..., P, 2) of the jets' points nearest to points x (..., P, 3) of their
    charts, found from the points' own (u, v) by Gauss and Newton.

    A step that does not bring the point nearer is not taken. Without gradient.
    """
    with torch.no_grad():
        uv = x[..., :2].clone()
        z, zu, zv = derivatives(alpha, uv, (0, 0), (1, 0), (0, 1))
        for _ in range(steps):
            r = torch.stack([uv[..., 0] - x[..., 0], uv[..., 1] - x[..., 1], z - x[..., 2]], -1)
            a, b = r[..., 0] + zu * r[..., 2], r[..., 1] + zv * r[..., 2]
            det = 1 + zu * zu + zv * zv
            step = (
                torch.stack([(1 + zv * zv) * a - zu * zv * b, (1 + zu * zu) * b - zu * zv * a], -1)
                / det[..., None]
            )
            tried = uv - step
            found = derivatives(alpha, tried, (0, 0), (1, 0), (0, 1))
            nearer = ((tried - x[..., :2]) ** 2).sum(-1) + (found[0] - x[..., 2]) ** 2 < (
                r * r
            ).sum(-1)
            uv = torch.where(nearer[..., None], tried, uv)
            z, zu, zv = (torch.where(nearer, new, old) for new, old in zip(found, (z, zu, zv)))
        return uv


def _symmetric(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return torch.stack([torch.stack([a, b], -1), torch.stack([b, c], -1)], -2)
