"""Sequences that nobody has tuned anything on: cloth simulated by Newton, rendered by Mitsuba's
path tracer.

    pip install newton
    python benchmarks/simulate.py OUT --seed 3
    python benchmarks/sft.py --data OUT --only flag bend paper curtain \\
        --methods gauss-newton -o RESULTS

Newton is NVIDIA's simulator on Warp; it runs on the CPU too. OUT receives the folders flag, bend,
paper, curtain, skirt, pillow, roll, pushed and tube, about two minutes each on one core.

Each folder has the form that ``scenes/flag.xml`` and its sisters expect: ``template.obj`` (metres,
camera frame), ``texture.png``, ``camera.json``, ``frames``, ``masks`` (480x360) and ``gt.npz``, the
true vertices (T, N, 3), with those that the camera sees (T, N). The seed decides motion, wind,
light and texture.

    flag     pinned along its left edge, in gusts
    bend     stiff, its two ends pushed together and apart again
    paper    stiffer
    curtain  hung on five to seven hooks that are drawn together, in light wind
    skirt    a cone that is open at both ends; its waist turns and sways
    pillow   closed; its two ends are pushed together and turned against each other
    roll     a sheet that is rolled up by 250 degrees, held along one edge, in wind
    pushed   thinner than bend, its two ends pushed together by a fifth: it bulges either way
    tube     a sleeve, open at both ends, which are turned as on an arm that bends
"""

import argparse
import os
from dataclasses import dataclass

import numpy as np
from simulate_pictures import add_cameras, render
from simulate_shapes import DEPTH, ROUNDED, Shape

from polyfit.backend import set_variant
from polyfit.mesh import edges_of
from polysft_mi.errors import InputError, cli

FRAMES, FPS = 45, 60.0
SUBSTEPS, ITERATIONS = 10, 40  # of a frame, and of Newton's vertex block descent in each
STRETCHING = 1e4  # [N/m]: strains stay about 0.1 %
DENSITY, AIR = 0.15, 1.2  # [kg/m^2], [kg/m^3]


@dataclass(frozen=True)
class Kind:
    """``size`` (width, height) [m] and ``cells`` across and down of a sheet (other shapes have
    their own), ``bending`` stiffness [N m], ``gravity`` [m/s^2] down in the image, ``pressed``: the
    share of its width that the pinned points come closer, ``wind``: (along the sheet, across it)
    [m/s], ``self_contact``.
    """

    size: tuple | None
    cells: tuple | None
    bending: float
    gravity: float
    pressed: float
    wind: tuple
    self_contact: bool = False


KINDS = {
    "flag": Kind((0.30, 0.21), (36, 25), 2e-3, 0.6, 0.0, (1.2, 0.35)),
    "bend": Kind((0.33, 0.22), (38, 26), 5e-2, 0.3, 0.13, (0.0, 0.9)),
    "paper": Kind((0.31, 0.22), (36, 26), 3e-1, 0.3, 0.16, (0.0, 0.9)),
    "curtain": Kind((0.32, 0.25), (40, 30), 1e-4, 9.81, 0.12, (0.2, 0.8), True),
    "skirt": Kind(None, None, 3e-4, 9.81, 0.0, (0.3, 0.5), True),
    "pillow": Kind(None, None, 3e-3, 0.3, 0.12, (0.0, 0.6), True),
    "roll": Kind(None, None, 5e-3, 0.6, 0.0, (0.6, 0.8), True),
    "pushed": Kind((0.31, 0.22), (36, 26), 1e-2, 0.3, 0.2, (0.0, 0.5)),
    "tube": Kind(None, None, 2e-3, 0.6, 0.1, (0.0, 0.5), True),
}


# ---- motion --------------------------------------------------------------------------------------


def sheet(kind):
    """Vertices (N, 3) [m] of the flat sheet, row by row from the top, and their texture coordinates
    (N, 2), v upwards.
    """
    (w, h), (nx, ny) = kind.size, kind.cells
    v, u = np.meshgrid(np.linspace(0, 1, ny + 1), np.linspace(0, 1, nx + 1), indexing="ij")
    return np.stack([(u - 0.5) * w, (v - 0.5) * h, np.full_like(u, DEPTH)], -1).reshape(
        -1, 3
    ), np.stack([u, 1 - v], -1).reshape(-1, 2)


def pinned(name, kind, rng):
    """Which vertices are held, (N,) bool."""
    (nx, _ny), each = kind.cells, np.arange((kind.cells[0] + 1) * (kind.cells[1] + 1))
    column, row = each % (nx + 1), each // (nx + 1)
    if name == "flag":
        return column == 0
    if name == "curtain":
        return (row == 0) & np.isin(column, np.round(np.linspace(0, nx, rng.integers(5, 8))))
    return (column == 0) | (column == nx)


class Weather:
    """Where the pinned points are, and what the wind does, at a time [s]."""

    def __init__(self, name, kind, rest, held, rng):
        self.name, self.kind, self.start, self.held = name, kind, rest[held], held
        self.phase, self.rate, self.across = (
            rng.uniform(0, 2 * np.pi, 6),
            rng.uniform(0.4, 1.6, 6),
            24 * rng.normal(size=(4, 2)),
        )
        self.side = rng.choice([-1.0, 1.0])

    def points(self, time):
        """Positions of the pinned points [m]."""
        share = np.sin(min(1.0, 1.25 * time * FPS / FRAMES) * np.pi / 2) ** 2
        out, swing = self.start.copy(), np.sin(2 * np.pi * self.rate[0] * time) * min(1.0, 3 * time)
        out[:, 0] *= 1 - self.kind.pressed * share
        if self.name == "curtain":
            out[:, 2] += 0.012 * share * np.where(np.arange(len(out)) % 2, 1, -1)
        elif self.name in ROUNDED:
            self._turn(out, share, swing)
        elif self.name != "flag":
            out[:, 2] += 0.015 * swing * np.sign(self.start[:, 0])
        return out

    def _turn(self, out, share, swing):
        """A skirt's waist and a roll's edge turn about an upright axis and sway; a pillow's ends
        turn against each other, and a tube's as those of a sleeve on an arm that bends.
        """
        end = np.sign(self.start[:, 0])
        axis, angle = {
            "skirt": (1, 0.5 * self.side * share),
            "pillow": (0, 0.35 * self.side * share * end),
            "roll": (1, 0.3 * swing),
            "tube": (1, 0.45 * self.side * share * end),
        }[self.name]
        a, b = [k for k in range(3) if k != axis]
        two_ends = self.name in ("pillow", "tube")
        for part in (end < 0, end >= 0) if two_ends else (np.full(len(out), True),):
            middle = out[part].mean(0)
            x, y = out[part, a] - middle[a], out[part, b] - middle[b]
            cos, sin = (np.broadcast_to(f(angle), len(out))[part] for f in (np.cos, np.sin))
            out[part, a] = middle[a] + cos * x - sin * y
            out[part, b] = middle[b] + sin * x + cos * y
        if self.name != "pillow":
            out[:, 0] += 0.03 * swing

    def wind(self, centres, time):
        """Velocity of the air (F, 3) [m/s] at the triangles' centres (F, 3) [m]."""
        along, across = self.kind.wind
        sine = lambda k, rate: np.sin(2 * np.pi * rate * self.rate[k] * time + self.phase[k])
        out = np.tile(
            [
                along * (1 + 0.3 * sine(0, 1)),
                0.0,
                across * self.side * (sine(1, 1) + 0.6 * sine(2, 2.3)),
            ],
            (len(centres), 1),
        )
        for k, direction in enumerate(self.across):
            out[:, 2] += (
                0.6
                * across
                * np.sin(
                    centres[:, :2] @ direction + 2 * np.pi * self.rate[k] * time + self.phase[k]
                )
            )
        return out * min(1.0, 4 * time)


def drag(x, v, faces, wind):
    """Force of the air on each vertex (N, 3) [N], normal to the triangles ``faces`` (F, 3), of
    positions ``x`` (N, 3) [m], velocities ``v`` (N, 3) [m/s] and the air's velocity ``wind`` (F, 3)
    [m/s]."""
    corner = x[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / double
    relative = wind - v[faces].mean(1)
    force = (
        AIR
        / 4
        * double
        * (relative * normal).sum(1, keepdims=True)
        * np.linalg.norm(relative, axis=1, keepdims=True)
        * normal
    )
    return np.stack(
        [np.bincount(faces.ravel(), np.repeat(force[:, k] / 3, 3), len(x)) for k in range(3)], 1
    )


def simulate(name, seed, frames=FRAMES):
    """Vertices (``frames``, N, 3) [m, camera frame] of a sequence, and its
    :class:`simulate_shapes.Shape`. Fewer frames are the first ones of the same motion.
    """
    try:
        import newton
        import warp as wp
    except ImportError:
        raise InputError("newton is not installed; 'pip install newton' brings it") from None
    wp.config.quiet = True
    kind, rng = KINDS[name], np.random.default_rng([seed, list(KINDS).index(name)])
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=wp.vec3(0.0, kind.gravity, 0.0))
    cloth = dict(
        rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, 0.0), tri_ke=STRETCHING, tri_ka=STRETCHING,
        tri_kd=1e-6, edge_ke=kind.bending, edge_kd=1e-4, particle_radius=0.002,
    )  # fmt: skip
    if name in ROUNDED:
        shape = ROUNDED[name]()
        rest, held, faces = shape.vertices, shape.held, shape.faces
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0), scale=1.0, density=DENSITY, indices=faces.ravel().tolist(),
            vertices=[wp.vec3(*x) for x in rest.tolist()], **cloth,
        )  # fmt: skip
    else:
        rest, uv = sheet(kind)
        held = pinned(name, kind, rng)
        (w, h), (nx, ny) = kind.size, kind.cells
        builder.add_cloth_grid(
            pos=wp.vec3(*rest[0].tolist()), dim_x=nx, dim_y=ny, cell_x=w / nx, cell_y=h / ny,
            mass=DENSITY * w * h / len(rest), **cloth,
        )  # fmt: skip
    weather = Weather(name, kind, rest, held, rng)
    for i in np.flatnonzero(held):
        builder.particle_mass[i] = 0.0
        builder.particle_flags[i] &= ~int(newton.ParticleFlags.ACTIVE)
    builder.color()
    model = builder.finalize(device="cpu")
    contact = dict(
        particle_enable_self_contact=True,
        particle_self_contact_margin=0.0015,
        particle_self_contact_gap=0.0015,
    )
    solver = newton.solvers.SolverVBD(
        model, iterations=ITERATIONS, **(contact if kind.self_contact else {})
    )
    now, after, control = model.state(), model.state(), model.control()
    if name not in ROUNDED:
        faces = model.tri_indices.numpy().reshape(-1, 3)
        shape = Shape(rest, faces, uv, held, kind.size[0] / kind.size[1])
    dt, out = 1 / FPS / SUBSTEPS, [rest]
    for step in range(1, (frames - 1) * SUBSTEPS + 1):
        x, v = now.particle_q.numpy(), 0.999 * now.particle_qd.numpy()
        x[held], v[held] = weather.points(step * dt), 0.0
        now.particle_q.assign(x)
        now.particle_qd.assign(v)
        now.clear_forces()
        now.particle_f.assign(
            drag(x, v, faces, weather.wind(x[faces].mean(1), step * dt)).astype(np.float32)
        )
        solver.step(now, after, control, None, dt)
        now, after = after, now
        if step % SUBSTEPS == 0:
            out.append(now.particle_q.numpy().astype(np.float64))
    if not np.isfinite(out).all():
        raise RuntimeError(f"{name}, seed {seed}: the simulation blew up")
    return np.array(out), shape


def main(argv=None):
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python benchmarks/simulate.py", description=__doc__, formatter_class=raw
    )
    parser.add_argument("out", metavar="OUT", help="folder of the sequences' folders")
    parser.add_argument(
        "--only",
        nargs="+",
        default=list(KINDS),
        choices=list(KINDS),
        metavar="KIND",
        help=f"of {', '.join(KINDS)}",
    )
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument(
        "--frames", type=int, default=FRAMES, help=f"the first ones alone (default: {FRAMES})"
    )
    parser.add_argument("--plain", action="store_true", help="textures with few details")
    parser.add_argument(
        "--cameras",
        type=int,
        default=1,
        choices=(1, 2, 3),
        help="2, 3: further ones in OUT/KIND/cameras, 50 degrees to the right, and to the left",
    )
    args = parser.parse_args(argv)
    if args.seed < 0:
        raise InputError(f"--seed {args.seed}: 0 or more")
    if not 1 <= args.frames <= FRAMES:
        raise InputError(f"--frames {args.frames}: 1 to {FRAMES}")
    set_variant("llvm_ad_rgb")
    for name in args.only:
        folder = os.path.join(args.out, name)
        if os.path.exists(folder):
            raise InputError(f"{folder}: exists already; another OUT is needed")
        vertices, shape = simulate(name, args.seed, args.frames)
        rng = np.random.default_rng([args.seed, list(KINDS).index(name), 1])
        seen = render(folder, vertices, shape, rng, args.plain)
        add_cameras(
            folder,
            os.path.join(folder, "cameras"),
            vertices,
            [50, -50][: args.cameras - 1],
            args.seed,
        )
        faces = shape.faces
        np.savez_compressed(
            os.path.join(folder, "gt.npz"),
            vertices=vertices.astype(np.float32),
            faces=faces.astype(np.int32),
            seen=seen,
        )
        a, b = edges_of(faces)[0].T
        length = np.linalg.norm(vertices[:, a] - vertices[:, b], axis=-1)
        strain = 100 * np.abs(length / length[0] - 1).mean()
        print(
            f"{folder}: {len(vertices)} frames, moved by"
            f" {1e3 * np.linalg.norm(vertices - vertices[0], axis=-1).mean():.0f} mm, lengths"
            f" change by {strain:.2f} %"
        )


if __name__ == "__main__":
    cli(main)
