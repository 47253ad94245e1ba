"""The four analytic families that PolyFit is trained on (paper, supplement, "Training dataset"):
surfaces z = f(u, v) with their exact normals.

    jet             sum_i sum_j alpha_{i-j,j} u^(i-j) v^j, i <= 4
    trigonometric   alpha cos(theta sqrt(u^2 + v^2))
    gaussian        alpha exp(-((u - u0)^2 + (v - v0)^2) / (2 sigma^2))
    bessel          alpha J0(k sqrt((u - u0)^2 + (v - v0)^2))

with alpha in [-0.5, 0.5], theta in [pi, 2 pi], sigma in [0.5, 1], k = 5, over (u, v) in [-1, 1]^2,
and summed, as in the paper. The paper leaves the centres (u0, v0) open; here they are uniform in
[-1, 1]^2. Numbers are uniform in their ranges, and each function of a patch draws its own.
"""

import math

import torch

from polyfit import jets
from polyfit.errors import InputError

FAMILIES = ("jet", "trigonometric", "gaussian", "bessel")

_AMPLITUDE = 0.5
ORDER = 4
THETA = (math.pi, 2 * math.pi)
SIGMA = (0.5, 1.0)
_BESSEL_K = 5.0


def _uniform(shape, low, high, generator):
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def jet(alpha, uv):
    """Height (B, P) and slopes (B, P, 2) of the 4-jets ``alpha`` (B, 15) at ``uv`` (B, P, 2)."""
    return jets.height(alpha, uv), torch.stack(jets.height_derivatives(alpha, uv), -1)


def trigonometric(alpha, theta, uv):
    """Height (B, P) and slopes (B, P, 2) of alpha cos(theta r); ``alpha``, ``theta`` (B,)."""
    r = uv.norm(dim=-1)
    alpha, theta = alpha[:, None], theta[:, None]
    # sin(theta r) / r -> theta at the centre
    slope = -alpha * theta * theta * torch.special.sinc(theta * r / math.pi)
    return alpha * torch.cos(theta * r), slope[..., None] * uv


def gaussian(alpha, centre, sigma, uv):
    """Height (B, P) and slopes (B, P, 2) of a Gaussian; ``alpha``, ``sigma`` (B,), ``centre`` (B,
    2).
    """
    d = uv - centre[:, None]
    z = alpha[:, None] * torch.exp(-0.5 * (d * d).sum(-1) / sigma[:, None] ** 2)
    return z, -(z / sigma[:, None] ** 2)[..., None] * d


def bessel(alpha, centre, uv):
    """Height (B, P) and slopes (B, P, 2) of alpha J0(k r) about ``centre`` (B, 2); ``alpha``
    (B,).
    """
    d = uv - centre[:, None]
    x = _BESSEL_K * d.norm(dim=-1)
    # J1(x) / x -> 1/2 at the centre
    ratio = torch.where(
        x > 1e-6, torch.special.bessel_j1(x) / x.clamp_min(1e-6), torch.full_like(x, 0.5)
    )
    return (
        alpha[:, None] * torch.special.bessel_j0(x),
        -(alpha[:, None] * _BESSEL_K**2 * ratio)[..., None] * d,
    )


def sample(patches, points, generator, families=FAMILIES):
    """``patches`` random surfaces at ``points`` random places each: points (B, P, 3) and unit
    normals (B, P, 3), float64, z up.

    ``families`` names the functions that are summed; ``generator`` is a CPU ``torch.Generator``.
    Raises InputError for a name that is none of ``FAMILIES``.
    """
    unknown = sorted(set(families) - set(FAMILIES))
    if unknown or not families:
        raise InputError(
            f"families {', '.join(unknown) or 'empty'}: choose among {', '.join(FAMILIES)}"
        )
    uv = _uniform((patches, points, 2), -1, 1, generator)
    z, slope = (
        torch.zeros(patches, points, dtype=torch.float64),
        torch.zeros(patches, points, 2, dtype=torch.float64),
    )

    def amplitude(*shape):
        return _uniform((patches, *shape), -_AMPLITUDE, _AMPLITUDE, generator)

    def centre():
        return _uniform((patches, 2), -1, 1, generator)

    for name in families:
        if name == "jet":
            part = jet(amplitude((ORDER + 1) * (ORDER + 2) // 2), uv)
        elif name == "trigonometric":
            part = trigonometric(amplitude(), _uniform((patches,), *THETA, generator), uv)
        elif name == "gaussian":
            part = gaussian(amplitude(), centre(), _uniform((patches,), *SIGMA, generator), uv)
        else:
            part = bessel(amplitude(), centre(), uv)
        z, slope = z + part[0], slope + part[1]
    normals = torch.nn.functional.normalize(
        torch.cat([-slope, torch.ones_like(z)[..., None]], -1), dim=-1
    )
    return torch.cat([uv, z[..., None]], -1), normals
