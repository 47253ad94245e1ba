"""n-jets: heights z(u, v) = sum_i sum_j alpha_{i-j,j} u^(i-j) v^j and their closed-form geometry (paper, section "PolyFit").

``alpha`` has A = (n+1)(n+2)/2 entries, in the paper's order: i = 0..n, and j = 0..i within each i, that is
1, u, v, u^2, uv, v^2, u^3, ... All lengths are in the canonical unit (:class:`polyfit.frames.CanonicalFrame`).
The same functions stand in Dr.Jit in ``polysft_mi.jet``, by the same names.
"""

import numpy as np
import torch


def exponents(order):
    """Exponents (of u, of v) of the coefficients, shape (A, 2)."""
    return np.array([(i - j, j) for i in range(order + 1) for j in range(i + 1)], dtype=np.int64)


def order_of(size):
    """Order n of a jet with ``size`` coefficients. Raises ValueError where there is none."""
    order = int((np.sqrt(8 * size + 1) - 3) / 2 + 0.5)
    if (order + 1) * (order + 2) // 2 != size:
        raise ValueError(f"{size} is not the number of coefficients of a jet")
    return order


def _powers(x, order):
    """x^0 .. x^n, (..., n+1)."""
    out = [torch.ones_like(x)]
    for _ in range(order):
        out.append(out[-1] * x)
    return torch.stack(out, -1)


def basis(uv, order, du=0, dv=0):
    """The monomials' derivatives d^(du+dv) / du^du dv^dv at uv (..., 2): (..., A)."""
    e = exponents(order)
    columns = []
    for axis, d in ((0, du), (1, dv)):
        p = _powers(uv[..., axis], order)
        k = e[:, axis]
        factor = np.prod([k - m for m in range(d)], axis=0) if d else np.ones(len(k))
        factor = torch.as_tensor(np.where(k >= d, factor, 0), dtype=uv.dtype, device=uv.device)
        columns.append(factor * p[..., np.maximum(k - d, 0)])
    return columns[0] * columns[1]


def height(alpha, uv):
    """z, (...,), of the jets alpha (..., A) at uv (..., 2)."""
    return (basis(uv, order_of(alpha.shape[-1])) * alpha).sum(-1)


def height_derivatives(alpha, uv):
    """(z_u, z_v), each (...,)."""
    n = order_of(alpha.shape[-1])
    return (basis(uv, n, 1, 0) * alpha).sum(-1), (basis(uv, n, 0, 1) * alpha).sum(-1)


def point(alpha, uv):
    """phi(u, v) = (u, v, z(u, v)), (..., 3)."""
    return torch.cat([uv, height(alpha, uv)[..., None]], -1)


def tangents(alpha, uv):
    """phi_u = (1, 0, z_u) and phi_v = (0, 1, z_v), each (..., 3)."""
    zu, zv = height_derivatives(alpha, uv)
    one, zero = torch.ones_like(zu), torch.zeros_like(zu)
    return torch.stack([one, zero, zu], -1), torch.stack([zero, one, zv], -1)


def normal(alpha, uv):
    """Unit normal (-z_u, -z_v, 1) / |.|, (..., 3)."""
    zu, zv = height_derivatives(alpha, uv)
    return torch.nn.functional.normalize(torch.stack([-zu, -zv, torch.ones_like(zu)], -1), dim=-1)


def metric(alpha, uv):
    """First fundamental form J^T J, (..., 2, 2)."""
    zu, zv = height_derivatives(alpha, uv)
    f = zu * zv
    return torch.stack([torch.stack([1 + zu * zu, f], -1), torch.stack([f, 1 + zv * zv], -1)], -2)


def _legendre(order):
    """Coefficients of the Legendre polynomials P_0..P_n in powers of x, (n+1, n+1)."""
    from numpy.polynomial import legendre

    rows = np.zeros((order + 1, order + 1))
    for i in range(order + 1):
        c = legendre.leg2poly(np.eye(order + 1)[i])
        rows[i, : len(c)] = c
    return rows


def fit(points, order):
    """Least-squares jet through points (P, 3) of a chart with |u|, |v| <= 1: alpha (A,), float64.

    Solved in the basis P_{i-j}(u) P_j(v) of Legendre polynomials, which spans the same polynomials and keeps the system
    well conditioned up to order 10, and turned into the paper's monomials at the end. Raises ValueError where the points are fewer than
    the coefficients or do not determine them.
    """
    e = exponents(order)
    points = points.to(torch.float64)
    if len(points) < len(e):
        raise ValueError(f"a jet of order {order} has {len(e)} coefficients, more than the {len(points)} points")
    leg = torch.as_tensor(_legendre(order), device=points.device)
    pu, pv = (_powers(points[:, k], order) @ leg.T for k in (0, 1))
    system = pu[:, e[:, 0]] * pv[:, e[:, 1]]
    solution, _, rank, _ = torch.linalg.lstsq(system, points[:, 2:], rcond=1e-10, driver="gelsd")
    if int(rank) < len(e):
        raise ValueError(f"the points determine only {int(rank)} of the {len(e)} coefficients of a jet of order {order}")
    to_monomials = torch.zeros(len(e), len(e), dtype=torch.float64, device=points.device)
    at = {tuple(x): k for k, x in enumerate(e)}
    for k, (a, b) in enumerate(e):
        for i in range(a + 1):
            for j in range(b + 1):
                to_monomials[at[i, j], k] += leg[a, i] * leg[b, j]
    return to_monomials @ solution[:, 0]
