"""The patterns of the templates: a block and a garment's measures go in; the signed distance of its
cloth, and a function that is positive where the cloth is, come out.

Torso, arms, legs and a _flared skirt are joined by a smooth union, less the ease that the garment
has there; neck, hem and cuffs are zeros of smooth functions. Metres, OneFit's axes.
"""

import numpy as np

from .block import armhole

_SHOULDER, _ELBOW, _WRIST = np.array(
    [[0.162, -0.017, 0.467], [0.329, -0.021, 0.279], [0.446, -0.179, 0.164]]
)  # its left arm's joints [m]


def smooth_union(a, b, radius):
    """Minimum of two signed distances with a fillet where they meet; at most radius / 4 below the
    sharp one [m].
    """
    h = np.maximum(radius - np.abs(a - b), 0) / radius
    return np.minimum(a, b) - h * h * radius / 4


def ramp(x, start, end):
    """0 before ``start``, 1 after ``end``, smooth between (of zero slope at both)."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def along_arm(x, y, z):
    """Metres along the upper arm from the shoulder joint, and along the lower arm from the elbow,
    of the arm on the point's side.
    """
    p = np.stack(np.broadcast_arrays(np.abs(x), y, z), axis=-1)
    unit = lambda v: v / np.linalg.norm(v)
    return (p - _SHOULDER) @ unit(_ELBOW - _SHOULDER), (p - _ELBOW) @ unit(_WRIST - _ELBOW)


def below_neckline(x, y, z, front, back, narrow):
    """Positive below a neckline that lies ``front`` high at y = -0.09 and ``back`` high at y = 0.05
    [m]; ``narrow`` [1/m] bends it up at the sides.
    """
    return front + (back - front) * (y + 0.09) / 0.14 + narrow * x * x - z


def arm_hole(x, y, z, centre=(0.20, -0.02, 0.47), radii=(0.08, 0.10, 0.095)):
    """Positive outside a rounded cylinder around each shoulder, which runs on outwards; about
    metres.
    """
    d = [np.minimum(np.abs(x) - centre[0], 0), y - centre[1], z - centre[2]]
    return (np.sqrt(sum((v / r) ** 2 for v, r in zip(d, radii))) - 1) * min(radii)


def _flared(x, y, z, waist, hem):
    """About the signed distance to an elliptic cone: ``waist`` and ``hem`` are (z, half width, half
    depth, centre's y) [m].
    """
    t = (z - waist[0]) / (hem[0] - waist[0])
    a, b, c = (
        np.maximum(w + t * (h - w), 0.02 * (k < 2) - 1 * (k == 2))
        for k, (w, h) in enumerate(zip(waist[1:], hem[1:]))
    )
    slope = (hem[1] - waist[1]) / (waist[0] - hem[0])
    return (np.sqrt((x / a) ** 2 + ((y - c) / b) ** 2) - 1) * np.minimum(a, b) / np.hypot(1, slope)


def minimum(*fields):
    out = fields[0]
    for field in fields[1:]:
        out = np.minimum(out, field)
    return out


def upper_arm_to(length):
    """Positive on the torso and on the arm up to ``length`` [m] behind the shoulder joint."""
    return lambda x, y, z: np.where(armhole(x, z) > 0, length - along_arm(x, y, z)[0], 1)


def sleeved_top(b, snug=0):
    """``snug``, 0 to 1: how far the cloth follows the skin, instead of spanning the body's
    hollows.
    """
    loose = smooth_union(smooth_union(b.torso, b.arms, 0.04), b.skin, 0.01)
    return loose + snug * (b.skin - loose)


def sleeveless_top(b, snug=0):
    loose = smooth_union(b.torso, b.trunk, 0.01)
    return loose + snug * (b.trunk - loose)


def lower(b, snug=0):
    loose = smooth_union(smooth_union(b.hips, b.legs, 0.02), b.body, 0.01)
    return loose + snug * (np.maximum(b.body, b.armhole) - loose)


def tshirt(
    b,
    snug=0,
    ease=0.008,
    waist_ease=0.010,
    sleeve_ease=0.012,
    sleeve=0.165,
    hem=-0.02,
    front=0.47,
    back=0.53,
    narrow=6,
):
    s, _ = along_arm(b.x, b.y, b.z)
    ease = (
        ease
        + waist_ease * ramp(b.z, 0.35, -0.05)
        + sleeve_ease * ramp(s, 0.0, 0.17) * ramp(b.armhole, -0.02, 0.06)
    )
    sleeve = upper_arm_to(sleeve)
    return sleeved_top(b, snug) - ease, lambda *p: minimum(
        below_neckline(*p, front, back, narrow), p[2] - hem, sleeve(*p)
    )


def long_sleeve_top(
    b,
    snug=0,
    ease=0.007,
    waist_ease=0.009,
    sleeve_ease=0.004,
    sleeve=0.195,
    hem=-0.04,
    front=0.475,
    back=0.535,
    narrow=6,
):
    _, t = along_arm(b.x, b.y, b.z)
    ease = (
        ease
        + waist_ease * ramp(b.z, 0.35, -0.05)
        + sleeve_ease * ramp(t, 0.0, 0.2) * ramp(b.armhole, -0.02, 0.06)
    )

    def inside(x, y, z):
        reach = np.where(armhole(x, z) > 0, sleeve - along_arm(x, y, z)[1], 1)
        return minimum(below_neckline(x, y, z, front, back, narrow), z - hem, reach)

    return sleeved_top(b, snug) - ease, inside


def tank(b, snug=0, ease=0.006, waist_ease=0.012, hem=0.01, front=0.425, back=0.50, narrow=8):
    ease = ease + waist_ease * ramp(b.z, 0.35, 0.0)
    return sleeveless_top(b, snug) - ease, lambda *p: minimum(
        below_neckline(*p, front, back, narrow), arm_hole(*p), p[2] - hem
    )


def dress(
    b,
    snug=0,
    ease=0.006,
    waist=(0.135, 0.09),
    flare=(0.31, 0.26),
    hem=-0.34,
    fitted=-0.12,
    top=np.inf,
    front=0.435,
    back=0.51,
    narrow=8,
):
    """Half widths and depths of the cone at the ``waist`` and, ``flare``, at its ``hem``; fitted to
    the body down to ``fitted``; ``top``: the upper rim of a skirt.
    """
    cone = _flared(b.x, b.y, b.z, (0.20, *waist, -0.035), (hem, *flare, -0.03))
    body = sleeveless_top(b, snug) - ease
    field = smooth_union(np.where(b.z > fitted, body, np.maximum(body, fitted - b.z)), cone, 0.06)
    return field, lambda *p: minimum(
        below_neckline(*p, front, back, narrow), arm_hole(*p), p[2] - hem, top - p[2]
    )


def skirt(b):
    return dress(
        b, snug=1, waist=(0.06, 0.03), flare=(0.33, 0.30), hem=-0.40, fitted=-0.06, top=0.14
    )


def trousers(b, snug=0, ease=0.005, hip_ease=0.007, leg_ease=0.012, waist=0.14, hem=-0.70):
    ease = ease + hip_ease * ramp(b.z, 0.12, 0.0) + leg_ease * ramp(b.z, -0.05, -0.45)
    return lower(b, snug) - ease, lambda x, y, z: minimum(waist - z, z - hem)


def shorts(b, snug=0, ease=0.005, hip_ease=0.009, leg_ease=0.015, waist=0.14, hem=-0.27):
    ease = ease + hip_ease * ramp(b.z, 0.12, 0.0) + leg_ease * ramp(b.z, -0.05, -0.27)
    return lower(b, snug) - ease, lambda x, y, z: minimum(waist - z, z - hem)


def jumpsuit(b):
    s, _ = along_arm(b.x, b.y, b.z)
    body = sleeved_top(b) + (lower(b) - sleeved_top(b)) * ramp(b.z, 0.17, 0.03)
    ease = 0.008 + 0.006 * ramp(b.z, 0.25, 0.0) + 0.010 * ramp(b.z, -0.05, -0.45)
    ease = ease + 0.010 * ramp(s, 0.0, 0.14) * ramp(b.armhole, -0.02, 0.06)
    sleeve = upper_arm_to(0.14)
    return body - ease, lambda *p: minimum(
        below_neckline(*p, 0.465, 0.53, 6), p[2] + 0.69, sleeve(*p)
    )


# The pattern of each template, whose arguments are its measures [m], and how many vertices it is
# sewn with
PATTERNS = {
    "tshirt": (tshirt, 4000), "dress": (dress, 6000), "tank": (tank, 3000),
    "long_sleeve_top": (long_sleeve_top, 5000), "shorts": (shorts, 2500),
    "trousers": (trousers, 5000), "jumpsuit": (jumpsuit, 7500), "skirt": (skirt, 4000),
}  # fmt: skip
