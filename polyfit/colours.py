"""Colours of pictures: sRGB and linear light, and a hue for each patch. NumPy only."""

import colorsys

import numpy as np


def srgb(linear):
    """Linear values (...) as sRGB in [0, 1] (IEC 61966-2-1); not a number is 0."""
    x = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def linear(srgb):
    """Linear values (...) in [0, 1] of sRGB in [0, 1]."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear RGB (ITU-R BT.709)


def grey(colour, weights=LUMINANCE, is_coded=False):
    """Linear RGB (..., 3) without its colours: its channels by ``weights`` (3,), three times.
    ``is_coded``: it is sRGB's that are summed, as programs do that take colours from a video.
    """
    shown = srgb(colour) if is_coded else colour
    mixed = np.repeat((shown @ weights.astype(shown.dtype))[..., None], 3, axis=-1)
    return linear(mixed) if is_coded else mixed


def patch_colours(patch, weight):
    """Colours (N, 3) uint8 of vertices by the patches that hold them, ``patch`` (N, M), in the
    shares ``weight`` (N, M): a hue for each patch, blended where they overlap.
    """
    hue = np.arange(patch.max() + 1) * 0.618034 + 0.58  # far apart, however many there are
    own = np.array([colorsys.hsv_to_rgb(h % 1, 0.55, 0.88) for h in hue])
    return np.round(255 * np.einsum("nm,nmc->nc", weight, own[patch])).astype(np.uint8)


def range_of(values, signed=False):
    """(low, high) of a scale of colours for values (...), those that are not finite left out: from
    0 to what 99 % of them stay below; with ``signed`` as far to the other side, too.
    """
    known = np.isfinite(values)
    top = float(np.quantile(np.abs(values[known]), 0.99) if known.any() else 1) or 1.0
    return (-top if signed else 0.0), top
