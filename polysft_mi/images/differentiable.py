"""The comparison of :mod:`polysft_mi.images.pyramid` on Dr.Jit tensors: an image blurred and freed
from lighting, differentiable. Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from .pyramid import FLOOR, POOL

_LEAST_SHARE = 1e-3  # of a window that must be inside, or what is there counts for less


def compared(image, weight, level, normalise):
    """The image (H, W, 3) as it is compared at a :class:`polysft_mi.images.pyramid.Level`: blurred
    and, with ``normalise``, freed from lighting. It is premultiplied by its ``weight`` (H, W, 1);
    only what is inside counts. Zero outside.
    """
    if level.sigma > 0:
        inside = _per_channel(weight)
        share = dr.maximum(_per_channel(blur(weight, level.sigma)), _LEAST_SHARE)
        image = mi.TensorXf(blur(image, level.sigma).array / share * inside, image.shape)
    return normalised(image, weight, level.window) if normalise else image


def blur(image, sigma):
    """Gaussian blur of (H, W, C) by ``sigma`` [pixels], zeros beyond its border."""
    if sigma <= 0:
        return image
    radius = reach(sigma)
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    taps = (taps / taps.sum()).tolist()
    return dr.convolve(dr.convolve(image, taps, axis=0), taps, axis=1)


def reach(sigma):
    """How far [pixels] a :func:`blur` by ``sigma`` [pixels] reaches."""
    return max(1, int(np.ceil(2.5 * sigma))) if sigma > 0 else 0


def srgb(image):
    """Linear colours, 0 to 1, as sRGB (IEC 61966-2-1); a tensor of the same shape."""
    x = dr.clip(image.array, 0, 1)
    power = 1.055 * dr.power(dr.maximum(x, 0.0031308), 1 / 2.4) - 0.055
    return mi.TensorXf(dr.select(x <= 0.0031308, 12.92 * x, power), image.shape)


def normalised(image, weight, window):
    """(H, W, 3), premultiplied by its ``weight`` (H, W, 1), less its local mean, over its local
    standard deviation (one for all channels) and :data:`polysft_mi.images.pyramid.FLOOR`, under a
    window of standard deviation ``window`` [pixels]. Zero outside the weight.
    """
    height, width, channels = image.shape
    pool = int(min(POOL, max(1, window // 2)))
    small = max(1, height // pool), max(1, width // pool)

    def local(x):
        x = dr.resample(x, (*small, x.shape[2]), filter="box") if pool > 1 else x
        return blur(x, window / pool)

    share = dr.maximum(local(weight).array, _LEAST_SHARE)
    inside = _per_channel(weight)
    mean = local(image).array / _repeated(share, channels)
    # of the squares of what is inside: image is premultiplied, and weights are nearly 0 or 1
    power = local(mi.TensorXf(dr.square(image.array), image.shape)).array / _repeated(
        share, channels
    )
    variance = _mean_of_channels(power - dr.square(mean), channels)
    scale = dr.rsqrt(dr.maximum(variance, 0) + FLOOR * FLOOR)
    shifted = _enlarged(mi.TensorXf(mean * _repeated(scale, channels), (*small, channels)), image)
    scale = _enlarged(mi.TensorXf(scale, (*small, 1)), weight)
    out = image.array * _per_channel(scale) - shifted.array * inside
    return mi.TensorXf(out, image.shape)


def _enlarged(small, like):
    return dr.resample(small, (*like.shape[:2], small.shape[2]), filter="linear")


def _per_channel(weight):
    """(H, W, 1) as a Float of 3 H W."""
    return _repeated(weight.array, 3)


def _repeated(values, channels):
    return dr.gather(
        mi.Float, values, dr.arange(mi.UInt32, channels * dr.width(values)) // channels
    )


def _mean_of_channels(values, channels):
    pixel = channels * dr.arange(mi.UInt32, dr.width(values) // channels)
    return sum(dr.gather(mi.Float, values, pixel + c) for c in range(channels)) / channels
