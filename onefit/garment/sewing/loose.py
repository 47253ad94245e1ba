"""Garments with slack. A tight shell cannot fold, so these are cut wider than the body: boxy and
straight, or with a skirt that is a flat ring of cloth around the waist, whose hem is a circle.

What is sewn here is the *cut*: its lengths are those of the cloth at rest. It does not hang yet; it
is let fall once (:mod:`onefit.garment.sewing.fall`). Metres, OneFit's axes.
"""

from dataclasses import dataclass

import numpy as np

from polyfit.mesh import loops

from .block import armhole
from .patterns import (
    along_arm,
    arm_hole,
    below_neckline,
    lower,
    minimum,
    ramp,
    sleeved_top,
    sleeveless_top,
    upper_arm_to,
)
from .sew import meshed


@dataclass(frozen=True)
class Cut:
    """A garment before it falls: ``vertices`` (N, 3) [m], the cloth as it is cut, ``faces`` (F, 3),
    and ``start`` (N, 3) [m], where it begins to fall: around the body and outside of it. Of cloth
    that is cut in panels, ``panels`` (F, 3, 2) [m] are the corners of each face in its own, and
    ``vertices`` only tell what is near to what.
    """

    vertices: np.ndarray
    faces: np.ndarray
    start: np.ndarray
    panels: np.ndarray | None = None

    @property
    def sides(self) -> np.ndarray:
        """The lengths at rest (F, 3) [m] of the faces' sides, from each corner to the next."""
        corners = self.vertices[self.faces] if self.panels is None else self.panels
        return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)


def boxy_tshirt(b):
    """Straight from the chest down, the sleeves wide and almost to the elbow."""
    s, _ = along_arm(b.x, b.y, b.z)
    sleeve = ramp(s, -0.02, 0.12) * ramp(b.armhole, -0.05, 0.05)
    ease = 0.010 + 0.020 * ramp(b.z, 0.44, 0.20) * (1 - sleeve) + 0.026 * sleeve
    reach = upper_arm_to(0.21)
    return straight(b) - ease, lambda *p: minimum(
        below_neckline(*p, 0.475, 0.53, 6), p[2] + 0.07, reach(*p)
    )


def shirt(b):
    """Long wide sleeves that are narrow at the wrist, a collar that stands, an open neck, and a hem
    that is longer in front and behind than at the sides.
    """
    s, t = along_arm(b.x, b.y, b.z)
    sleeve = ramp(s, -0.02, 0.12) * ramp(b.armhole, -0.05, 0.05)
    ease = (
        0.009
        + 0.022 * ramp(b.z, 0.44, 0.20) * (1 - sleeve)
        + sleeve * (0.022 - 0.018 * ramp(t, 0.12, 0.18))
        - 0.002 * ramp(b.z, 0.50, 0.54)
    )

    def inside(x, y, z):
        reach = np.where(armhole(x, z) > 0, 0.205 - along_arm(x, y, z)[1], 1)
        neck = below_neckline(x, y, z, 0.545, 0.575, 0)
        opening = np.abs(x) - 0.30 * (z - 0.43) + 2 * ramp(y, -0.06, 0.0)
        hem = z + 0.13 - 0.055 * ramp(np.abs(x), 0.07, 0.17)
        return minimum(neck, opening, hem, reach)

    return straight(b) - ease, inside


def straight(b):
    """The top with sleeves of which the trunk hangs straight down from its widest place."""
    trunk = np.minimum.accumulate(b.torso[:, :, ::-1], axis=2)[:, :, ::-1]
    return np.minimum(sleeved_top(b), trunk)


def wide_trousers(b):
    """Fitted at the waist, with legs that fall straight from the widest place of the thigh."""
    ease = 0.005 + 0.013 * ramp(b.z, 0.13, 0.0)
    apart = np.where(b.z < -0.10, 0.008 - b.side, -1.0)  # the legs do not meet
    field = np.minimum(lower(b), _straight_legs(b)) - ease
    return np.maximum(field, apart), lambda x, y, z: minimum(0.15 - z, z + 0.70)


_LEG_SLOPE = 0.16  # of the legs, outwards a metre down


def _straight_legs(b):
    """Each leg as wide as it was anywhere above, along its own slope."""
    low = np.searchsorted(b.z.ravel(), -0.12)  # below the crotch
    half = b.x.ravel() > 0
    x = b.x.ravel()[half]
    out = np.full_like(b.legs, 1.0)
    above = b.legs[half][:, :, low]
    for k in range(low, -1, -1):
        shifted = np.array([np.interp(x - _LEG_SLOPE * b.spacing, x, row) for row in above.T]).T
        above = np.minimum(shifted, b.legs[half][:, :, k])
        out[half, :, k] = above
    return np.minimum(out, out[::-1])


def _bodice(b):
    """A sleeveless top down to the waist."""
    return sleeveless_top(b, 0.8) - 0.006, lambda *p: minimum(
        below_neckline(*p, 0.43, 0.51, 8), arm_hole(*p), p[2] - 0.17
    )


def waistband(b):
    """A band of 4 cm around the waist."""
    return sleeveless_top(b, 1) - 0.004, lambda x, y, z: minimum(0.18 - z, z - 0.14)


# The pattern, its vertices, and how long the ring of a skirt is that is sewn to its lower rim [m]
LOOSE_PATTERNS = {
    "boxy_tshirt": (boxy_tshirt, 5000, 0), "shirt": (shirt, 6000, 0),
    "wide_trousers": (wide_trousers, 6000, 0), "waisted_dress": (_bodice, 1250, 0.42),
    "circle_skirt": (waistband, 165, 0.44),
}  # fmt: skip


def cut(block, name):
    """The :class:`Cut` of the garment ``name`` of :data:`LOOSE_PATTERNS`."""
    pattern, count, length = LOOSE_PATTERNS[name]
    V, F = meshed(block, *pattern(block), count)
    if not length:
        return Cut(V, F, V)
    return with_ring(V, F, length)


_SLOPE = np.radians(48)  # of a skirt before it falls, below the horizontal
_WAVES = 9  # of its hem, so that it is about as long there as it was cut


def with_ring(V, F, length):
    """The :class:`Cut` of a top with a flat ring of cloth, ``length`` [m] wide, sewn to its lowest
    loop, which is level: the hem is 2 pi ``length`` longer than the waist.

    The ring starts to fall as a cone with waves.
    """
    rim = min(loops(F), key=lambda loop: V[loop, 2].mean())
    waist = V[rim, :2]
    edge = np.linalg.norm(np.diff(waist, axis=0, append=waist[:1]), axis=1).mean()
    along, out = _outline(waist)
    level = V[rim, 2].mean()
    flat, start = [waist], [V[rim]]
    count = round(length / (edge * np.sqrt(3) / 2))
    for k in range(1, count + 1):
        r = length * k / count
        n = round((along[-1] + 2 * np.pi * r) / edge)
        s = (np.arange(n) + 0.5 * (k % 2)) / n
        at, normal = out(s, r)
        flat.append(at + r * normal)
        wide, wave = r * np.cos(_SLOPE), 2 * np.pi * _WAVES * s + 0.9 * np.sin(4 * np.pi * s)
        longer = (along[-1] + 2 * np.pi * r) / (along[-1] + 2 * np.pi * wide)
        amplitude = np.sqrt(longer**2 - 1) * np.sqrt(2) * (along[-1] / 2 / np.pi + wide) / _WAVES
        across = wide + amplitude * np.cos(wave)
        start.append(
            np.column_stack([at + across[:, None] * normal, 0 * s + level - r * np.sin(_SLOPE)])
        )
    points = np.concatenate(flat)
    G = _triangles(points, len(waist))
    number = np.concatenate([rim, len(V) + np.arange(len(points) - len(rim))])
    G = number[G]
    G = G if _walks(F, G) else G[:, ::-1]
    cut = np.concatenate([V, np.column_stack([points, np.full(len(points), level)])[len(rim) :]])
    return Cut(cut, np.concatenate([F, G]), np.concatenate([V, np.concatenate(start[1:])]))


def _outline(waist):
    """``along`` (n + 1,) [m], the length of a closed polygon (n, 2) up to its corners, and a
    function of s (0 to 1) and r [m] to the places whose parallel at a distance r is evenly walked,
    and the normals there that lead out.
    """
    from scipy.interpolate import CubicSpline

    closed = np.concatenate([waist, waist[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    spline = CubicSpline(along, closed, bc_type="periodic")
    fine = np.linspace(0, along[-1], 2001)
    tangent = spline(fine, 1)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if ((spline(fine) - waist.mean(0)) * normal).sum() < 0:
        normal = -normal
    # a normal turns by a little from corner to corner of a mesh's loop: its own harmonics are kept
    angle = np.unwrap(np.arctan2(normal[:, 1], normal[:, 0]))
    turn = angle[-1] - angle[0]
    ripple = np.fft.rfft(angle[:-1] - np.linspace(0, turn, 2000, endpoint=False))
    ripple[6:] = 0
    angle = np.linspace(0, turn, 2001) + np.append(r := np.fft.irfft(ripple, 2000), r[0])
    normal = np.column_stack([np.cos(angle), np.sin(angle)])

    def out(s, r):
        parallel = spline(fine) + r * normal
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(parallel, axis=0), axis=1))])
        at = np.interp(s * length[-1], length, fine)
        return spline(at), np.column_stack(
            [np.interp(at, fine, np.cos(angle)), np.interp(at, fine, np.sin(angle))]
        )

    return along, out


def _triangles(points, hole):
    """Delaunay's triangles (F, 3) of points (N, 2) without those in the polygon of the first
    ``hole``.
    """
    from matplotlib.path import Path
    from scipy.spatial import Delaunay

    F = Delaunay(points).simplices
    return F[~Path(points[:hole]).contains_points(points[F].mean(1))]


def _walks(F, G):
    """Whether faces G walk their common edges with F the other way round, as they should."""
    edges = lambda f: {tuple(e) for k in range(3) for e in np.roll(f, -k, axis=1)[:, :2].tolist()}
    return not edges(F) & edges(G)
