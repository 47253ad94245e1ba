"""The eight garment templates, made around Anny's standard rest body.

    python -m onefit.tailor                       # all eight, a minute
    python -m onefit.tailor --body body.ply       # the body that they are made around

Each garment is a level set: the body's signed distance with its hollows closed by a rolling ball
(cloth spans the gap between the breasts and that of the spine), torso, arms, legs and a flared
skirt joined by a smooth union, less the ease that the garment has there. It is cut open at neck,
hem and cuffs by smooth functions, remeshed by clusters (ACVD), and its triangles are evened out by
sliding along the surface and along the loops. Everything is deterministic. Metres, OneFit's axes.
"""

import argparse
import os
from functools import cached_property

import numpy as np

from polyfit import mesh
from polyfit.errors import InputError, cli, optional_imports
from polyfit.files import aside
from polyfit.mesh import write_ply

with optional_imports(__name__):
    from .binding import standard_body
    from .garment import FOLDER
    from .nearest import ClosestSurface
    from .remesh import loops, remeshed

SPACING = 0.008  # of the grid [m]
LOW, HIGH = np.array([-0.536, -0.424, -0.80]), np.array([0.536, 0.36, 0.80])  # its corners [m]
SHOULDER, ELBOW, WRIST = np.array(
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


class Block:
    """The signed distances that garments are made of, on one grid around the standard body [m]."""

    def __init__(self, vertices, faces, spacing=SPACING):
        self.spacing = spacing
        shape = np.round((HIGH - LOW) / spacing).astype(int) + 1
        axes = [(LOW[k] + spacing * np.arange(shape[k])).astype(np.float32) for k in range(3)]
        self.x, self.y, self.z = np.meshgrid(*axes, indexing="ij", sparse=True)
        self.side = np.abs(self.x)
        self.points = np.stack(np.broadcast_arrays(self.x, self.y, self.z), axis=-1)
        self.surface = ClosestSurface(vertices, faces)
        self.body = self._distance(self.surface, 0.26)
        self.armhole = armhole(self.x, self.z)

    @cached_property
    def skin(self):
        """The body with hollows narrower than 6 cm filled."""
        return self._closed(self.body, 0.03)

    @cached_property
    def torso(self):
        """Without arms and neck, hollows narrower than 40 cm filled: between the legs too."""
        return self._closed(np.maximum(np.maximum(self.body, self.armhole), self.z - 0.505), 0.20)

    @cached_property
    def trunk(self):
        """As the skin, without arms."""
        return self._closed(np.maximum(self.body, self.armhole), 0.03)

    @cached_property
    def arms(self):
        return self._closed(np.maximum(self.body, 0.02 - self.armhole), 0.08)

    @cached_property
    def hips(self):
        """From the waist to the crotch, hollows narrower than 20 cm filled."""
        return self._closed(
            np.maximum(
                self.body, np.maximum(np.maximum(self.z - 0.22, -0.065 - self.z), self.armhole)
            ),
            0.10,
        )

    @cached_property
    def legs(self):
        """Each leg by itself, from the hip to the ankle."""
        left = np.maximum(
            np.maximum(self.body, self.z - 0.03), np.maximum(-0.72 - self.z, 0.01 - self.x)
        )
        left = self._closed(left, 0.15)
        return np.minimum(left, left[::-1])

    def mesh(self, field, level=0.0):
        """Level set as ``(vertices [m], faces)``, wound away from where the field is lower."""
        from skimage.measure import marching_cubes

        V, F, _, _ = marching_cubes(
            field,
            level,
            spacing=(self.spacing,) * 3,
            gradient_direction="descent",
            allow_degenerate=False,
        )
        return V + LOW, F.astype(np.int64)

    def _distance(self, surface, reach):
        return (
            surface(self.points.reshape(-1, 3), reach)
            .distance.reshape(self.points.shape[:3])
            .astype(np.float32)
        )

    def _closed(self, field, radius):
        """Signed distance to the solid ``field`` < 0 after a ball of this radius was rolled over it
        from outside [m].
        """
        distance = self._signed(field, 0, radius + 0.02)
        return self._signed(distance, radius, radius + 0.08) + np.float32(radius)

    def _signed(self, field, level, reach):
        """True signed distance to the level set of a field that need be a distance only in its
        sign.
        """
        return np.sign(field - level) * np.abs(
            self._distance(ClosestSurface(*self.mesh(field, level)), reach)
        )


def armhole(x, z):
    """Negative on the torso's side of the planes through the armpits [m]."""
    return np.abs(x) - 0.15 - 0.6 * np.maximum(0.35 - z, 0)


def along_arm(x, y, z):
    """Metres along the upper arm from the shoulder joint, and along the lower arm from the elbow,
    of the arm on the point's side.
    """
    p = np.stack(np.broadcast_arrays(np.abs(x), y, z), axis=-1)
    unit = lambda v: v / np.linalg.norm(v)
    return (p - SHOULDER) @ unit(ELBOW - SHOULDER), (p - ELBOW) @ unit(WRIST - ELBOW)


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


def flared(x, y, z, waist, hem):
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
    cone = flared(b.x, b.y, b.z, (0.20, *waist, -0.035), (hem, *flare, -0.03))
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


def sewn(block, name, count=None, bumps=0.0, stretch=(1.0, 1.0, 1.0), **measures):
    """``(vertices (N, 3), faces (F, 3))`` of the pattern ``name``, with its own measures [m] but
    for those given.

    ``count`` of the vertices; ``bumps``: a field [m] on the block's grid that is added to the ease;
    ``stretch`` (3,): triangles are even in a space stretched so.
    """
    pattern, own = PATTERNS[name]
    field, inside = pattern(block, **measures)
    V, F = _clipped(*block.mesh(field - bumps), inside)
    V, F = remeshed(V * stretch, F, count or own)
    return V / stretch, F


def _clipped(V, F, inside):
    """The largest part of the surface where ``inside`` (x, y, z) is positive, cut along its
    zeros.
    """
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(V, F)
    surface["inside"] = inside(*V.T)
    part = surface.clip_scalar(scalars="inside", value=0.0, invert=False).triangulate()
    part = part.clean(tolerance=1e-6, absolute=True).extract_largest()
    return np.array(part.points, dtype=np.float64), part.regular_faces.astype(np.int64)


def write(names, folder):
    """Sew the named templates into ``folder``."""
    body = standard_body()
    block = Block(body.vertices.numpy(), body.faces.numpy())
    os.makedirs(folder, exist_ok=True)
    for name in names:
        V, F = sewn(block, name)
        path = os.path.join(folder, f"{name}.npz")
        with aside(path) as temporary:
            np.savez_compressed(temporary, vertices=V.astype(np.float32), faces=F.astype(np.int32))
        print(
            f"{path}: {len(V)} vertices, {len(F)} faces, {mesh.areas(V, F).sum():.3f} m^2,"
            f" {len(loops(F))} loops"
        )


def main():
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m onefit.tailor", description=__doc__, formatter_class=raw
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"templates to sew (default: all): {', '.join(PATTERNS)}",
    )
    parser.add_argument(
        "-o",
        "--output",
        default=FOLDER,
        metavar="FOLDER",
        help="of the .npz files (default: the package's own)",
    )
    parser.add_argument(
        "--body",
        metavar="FILE.ply",
        help="write the standard body, to make garments around, and sew nothing",
    )
    args = parser.parse_args()
    if unknown := [n for n in args.names if n not in PATTERNS]:
        raise InputError(f"{unknown[0]}: no such template; there are {', '.join(PATTERNS)}")
    if args.body:
        body = standard_body()
        write_ply(args.body, body.vertices.numpy(), body.faces.numpy())
        print(f"written: {args.body}")
    else:
        write(args.names or PATTERNS, args.output)


if __name__ == "__main__":
    cli(main)
