"""n-jets in Dr.Jit: the functions of ``polyfit.jets``, by the same names, on Mitsuba's types.

Arrays: ``alpha`` is a Float of A = (n+1)(n+2)/2 coefficients in the paper's order
(``polyfit.exponents``), shared by all points, or :class:`Coefficients` of several jets; ``u`` and
``v`` are Floats of N chart coordinates. Lengths are in the chart's unit. Import only after a
Mitsuba variant is set.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from polyfit.jets import exponents, order_of


def _powers(x, order):
    out = [None, x]  # x^0 is never multiplied in
    for _ in range(order - 1):
        out.append(out[-1] * x)
    return out


def _term(coefficient, pu, pv, a, b):
    for powers, k in ((pu, a), (pv, b)):
        if k:
            coefficient = coefficient * powers[k]
    return coefficient


@dataclass
class Coefficients:
    """Coefficients of several jets: ``alpha`` Float of K A, ``size``: A, and ``patch``, UInt32 of
    N: which jet each point has."""

    alpha: mi.Float
    size: int
    patch: mi.UInt32


def _coefficients(alpha, like):
    """alpha_k for every point: a gather, whose gradient is one scatter in the same kernel, in
    double so that its order does not show.
    """
    if not isinstance(alpha, Coefficients):
        alpha = Coefficients(alpha, dr.width(alpha), dr.zeros(mi.UInt32, dr.width(like)))
    first, values = alpha.patch * alpha.size, mi.Float64(alpha.alpha)
    return [mi.Float(dr.gather(mi.Float64, values, first + k)) for k in range(alpha.size)]


def _height_and_derivatives(alpha, u, v):
    """(z, z_u, z_v), Floats of N."""
    coefficients = _coefficients(alpha, u)
    order = order_of(len(coefficients))
    pu, pv = _powers(u, order), _powers(v, order)
    z, zu, zv = mi.Float(0), mi.Float(0), mi.Float(0)
    for c, (a, b) in zip(coefficients, exponents(order).tolist()):
        z = z + _term(c, pu, pv, a, b)
        if a:
            zu = zu + _term(c * a, pu, pv, a - 1, b)
        if b:
            zv = zv + _term(c * b, pu, pv, a, b - 1)
    return z, zu, zv


def height(alpha, u, v):
    """z(u, v), a Float of N."""
    return _height_and_derivatives(alpha, u, v)[0]


def point(alpha, u, v):
    """phi(u, v) = (u, v, z), a Point3f of N."""
    return mi.Point3f(u, v, height(alpha, u, v))


def tangents(alpha, u, v):
    """phi_u = (1, 0, z_u) and phi_v = (0, 1, z_v), Vector3f of N."""
    _, zu, zv = _height_and_derivatives(alpha, u, v)
    one, zero = dr.ones(mi.Float, dr.width(zu)), dr.zeros(mi.Float, dr.width(zu))
    return mi.Vector3f(one, zero, zu), mi.Vector3f(zero, one, zv)


def normal(alpha, u, v):
    """Unit normal (-z_u, -z_v, 1) / |.|, a Normal3f of N."""
    _, zu, zv = _height_and_derivatives(alpha, u, v)
    return dr.normalize(mi.Normal3f(-zu, -zv, 1))


def metric(alpha, u, v):
    """First fundamental form (E, F, G) = (1 + z_u^2, z_u z_v, 1 + z_v^2), Floats of N."""
    _, zu, zv = _height_and_derivatives(alpha, u, v)
    return 1 + zu * zu, zu * zv, 1 + zv * zv
