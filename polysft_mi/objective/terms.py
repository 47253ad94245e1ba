"""The terms of the objective (paper, section "PolySfT", Losses), each a function of Dr.Jit arrays.

What the paper leaves open is decided here and nowhere else (``docs/conventions.md`` repeats it):

- Images are compared in linear RGB. Photometric and silhouette losses are sums over pixels divided
  by the area of the surface in the image (the target mask's, or the rendered interior's where there
  are no masks), so that neither the background nor the resolution weighs in.
- The photometric norm is |r| by default: shading that the texture does not have, and what one patch
  cannot follow, weigh less than in r^2.
- With masks, the target is cut out by its mask and the rendering stands over black. Without, the
  photometric loss lives inside the rendered silhouette (pixels that the surface fills, detached)
  and there is no silhouette loss.
- Edge lengths, jet coefficients and uv are measured in the chart's unit s. Inextensibility is the
  sum over edges, as in eq. isometry_mesh; per-frame terms are averaged over the window; temporal
  consistency is eq. tc.

Import only after a Mitsuba variant is set.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.images import POOL

_INTERIOR = 0.999  # alpha above which a pixel counts as filled by the surface


def robust(squared, norm, scale):
    """rho of squared residuals r^2: r^2 (``l2``), |r| (``l1``), or scale^2 (sqrt(1 + r^2/scale^2) -
    1) * 2 (``charbonnier``, r^2 near 0).
    """
    if norm == "l2":
        return squared
    if norm == "l1":
        return dr.sqrt(squared + 1e-12)
    return 2 * scale * scale * (dr.sqrt(1 + squared / (scale * scale)) - 1)


def photometric(render, target, weight, area, *, norm="l1", scale=0.1):
    """Mean over the surface of rho(|I - T|^2 / 3).

    ``render``, ``target``: lists of 3 Floats of P pixels; ``weight``: Float of P, detached;
    ``area``: Float of 1, pixels.
    """
    squared = sum(dr.square(a - b) for a, b in zip(render, target)) / 3
    return dr.sum(weight * robust(squared, norm, scale)) / area


def silhouette(alpha, mask, area):
    """Mean over the surface of (alpha - mask)^2; Floats of P pixels."""
    return dr.sum(dr.square(alpha - mask)) / area


def interior(alpha):
    """1 where the surface fills the pixel, else 0, detached; Float of P."""
    return dr.select(dr.detach(alpha) > _INTERIOR, mi.Float(1), 0)


def edge_lengths(points, edges):
    """Lengths of the edges (pair of UInt32 of E) between points (Point3f of N): a Float of E [unit
    of the points].
    """
    flat = mi.Float64(
        dr.ravel(points)
    )  # double for the gradients: their sum over a vertex's edges then does not depend on the order
    a, b = (mi.Point3f(dr.gather(mi.Point3d, flat, i)) for i in edges)
    return dr.norm(a - b)


def inextensibility(points, edges, rest, scale):
    """Sum over edges of ((e_P - e_T) / s)^2 (eq. isometry_mesh without its weight)."""
    return dr.sum(dr.square((edge_lengths(points, edges) - rest) / scale))


def volume(points, faces):
    """The volume [unit of the points, cubed] within a closed mesh of ``points`` (Point3f of N) and
    ``faces`` (F, 3), NumPy, wound alike: a Float of 1; negative where they are wound inwards.
    """
    flat = mi.Float64(dr.ravel(points))
    a, b, c = (dr.gather(mi.Vector3d, flat, mi.UInt32(k.astype(np.uint32))) for k in faces.T)
    return mi.Float(dr.sum(dr.dot(a, dr.cross(b, c))) / 6)


def temporal(window):
    """(1 / (W-1)) sum_t |δα_t|^2 + |δuv_t|^2 over a list of W Unknowns (eq. tc without its weight);
    0 where W = 1.
    """
    total = mi.Float(0)
    for a, b in itertools.pairwise(window):
        for name in ("delta_alpha", "delta_u", "delta_v"):
            total += dr.sum(dr.square(getattr(b, name) - getattr(a, name)))
    return total / max(1, len(window) - 1)


def gain(render, target, weight):
    """The gain g (Float of 1, detached) for which g render fits target best in the least-squares
    sense where weight is 1.
    """
    with dr.suspend_grad():
        top = sum(dr.sum(weight * a * b) for a, b in zip(render, target))
        bottom = sum(dr.sum(weight * a * a) for a in render)
        return dr.clip(top / dr.maximum(bottom, 1e-12), 0.25, 4)


def _gaussian_taps(sigma):
    """A normalised, truncated Gaussian of standard deviation sigma [pixels], as a list."""
    radius = max(1, int(np.ceil(2.5 * sigma)))
    x = np.arange(-radius, radius + 1)
    k = np.exp(-0.5 * (x / sigma) ** 2)
    return (k / k.sum()).tolist()


def blur(image, sigma):
    """Gaussian blur of an image tensor (H, W, C), zeros beyond its border; differentiable."""
    if sigma <= 0:
        return image
    taps = _gaussian_taps(sigma)
    return dr.convolve(dr.convolve(image, taps, axis=0), taps, axis=1)


def _smooth(image, sigma):
    """A wide Gaussian blur (H, W, C) for slowly varying statistics: shrink, blur, enlarge;
    differentiable.
    """
    height, width, channels = image.shape
    small = dr.resample(
        image, (max(1, height // POOL), max(1, width // POOL), channels), filter="box"
    )
    return dr.resample(blur(small, sigma / POOL), image.shape, filter="linear")


def normalise_locally(image, weight, sigma=8.0, floor=0.02):
    """Colours (H, W, 3) less their local mean, over their local standard deviation, both inside
    ``weight`` (H, W, 1) and under a window of standard deviation ``sigma`` [pixels]; ``floor``
    keeps flat areas from being blown up. Zero outside ``weight``.
    """
    pixel = dr.arange(mi.UInt32, 3 * weight.shape[0] * weight.shape[1]) // 3
    inside = dr.gather(mi.Float, weight.array, pixel)
    share = dr.maximum(dr.gather(mi.Float, _smooth(weight, sigma).array, pixel), 1e-3)
    mean = _smooth(mi.TensorXf(image.array * inside, image.shape), sigma).array / share
    centred = (image.array - mean) * inside
    variance = _smooth(mi.TensorXf(dr.square(centred), image.shape), sigma).array / share
    return mi.TensorXf(centred * dr.rsqrt(dr.maximum(variance, 0) + floor * floor), image.shape)
