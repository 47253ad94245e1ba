"""Frames of HDR videos (HLG, as telephones write it, and PQ) in sRGB.

Light is counted in shares of the white of a sheet of paper, 203 cd/m2 (ITU-R BT.2408). Up to
``KNEE`` it keeps its value; what is brighter is brought below 1, the hue kept.
"""

import numpy as np

from polyfit.colours import srgb

_CURVES = {16: "PQ", 18: "HLG"}  # FFmpeg's numbers of transfer characteristics
_BT2020 = 9  # and of primaries
_UNSPECIFIED = 2
_PAPER = 203.0  # [cd/m2]
_KNEE = 0.75
# BT.2020's primaries to BT.709's, linear light
_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    dtype=np.float32,
)


def curve_of(frame):
    """The name of a decoded frame's HDR transfer, or None."""
    return _CURVES.get(int(frame.color_trc))


def as_srgb(image, frame):
    """Pixels (H, W, 3) uint16 of a decoded ``frame`` in its HDR transfer, as uint8 sRGB."""
    light = _LINEAR[curve_of(frame)](np.arange(65536) / 65535).astype(np.float32)[image]
    if curve_of(frame) == "HLG":  # of the scene: what a screen of 1,000 cd/m2 makes of it
        luminance = light @ np.array([0.2627, 0.6780, 0.0593], dtype=np.float32)
        light *= 1000.0 / _PAPER * np.maximum(luminance, 1e-6)[..., None] ** 0.2
    if int(frame.color_primaries) in (_BT2020, _UNSPECIFIED):
        light = np.maximum(light @ _TO_BT709.T, 0)
    brightest = light.max(axis=2, keepdims=True)
    over = np.maximum(brightest - _KNEE, 0) / (1 - _KNEE)
    kept = np.where(over > 0, _KNEE + (1 - _KNEE) * (1 - np.exp(-over)), brightest)
    light *= kept / np.maximum(brightest, 1e-9)
    return _SRGB[np.minimum(light * (len(_SRGB) - 1) + 0.5, len(_SRGB) - 1).astype(np.int32)]


def _of_pq(signal):
    """Light of SMPTE ST 2084 (signal 0 to 1)."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = signal ** (1 / m2)
    return 10_000 / _PAPER * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1)


def _of_hlg(signal):
    """Light of the scene, 0 to 1, of ARIB STD-B67 (signal 0 to 1)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def _srgb_table(count=1 << 14):
    """8-bit sRGB (IEC 61966-2-1) of ``count`` even steps of light from 0 to 1."""
    return np.round(255 * srgb(np.linspace(0, 1, count))).astype(np.uint8)


_LINEAR = {"PQ": _of_pq, "HLG": _of_hlg}
_SRGB = _srgb_table()
