"""Sequences that nobody has tuned anything on: cloth simulated by Newton, rendered by Mitsuba's
path tracer.

    pip install newton
    python benchmarks/simulate.py OUT --seed 3
    python benchmarks/sft.py --data OUT --only flag bend paper curtain \\
        --methods gauss-newton -o RESULTS

Newton is NVIDIA's simulator on Warp; it runs on the CPU too. OUT receives the folders flag, bend,
paper and curtain, about two minutes each on one core.

Each folder has the form that the scenes of those names expect: ``template.obj`` (metres, camera
frame), ``texture.png``, ``camera.json``, ``frames``, ``masks`` (480x360) and ``gt.npz``, the true
vertices (T, N, 3). The seed decides motion, wind, light and texture.

    flag     pinned along its left edge, in gusts
    bend     stiff, its two ends pushed together and apart again
    paper    stiffer
    curtain  hung on five to seven hooks that are drawn together, in light wind
"""

import argparse
import json
import os
from dataclasses import dataclass

import cv2
import numpy as np

from polyfit.mesh import edges_of
from polysft_mi.backend import set_variant
from polysft_mi.errors import InputError, cli
from polysft_mi.surface.meshio import write_obj

FRAMES, FPS = 45, 60.0
SUBSTEPS, ITERATIONS = 10, 40  # of a frame, and of Newton's vertex block descent in each
STRETCHING = 1e4  # [N/m]: strains stay about 0.1 %
DENSITY, AIR = 0.15, 1.2  # [kg/m^2], [kg/m^3]
DEPTH = 0.62  # of the flat sheet [m]
SIZE, FOCAL = (480, 360), 552.0  # of the images [pixels]
SAMPLES, NOISE = 32, 1.5  # paths a pixel; standard deviation of the noise [levels of 255]
BACKGROUND = np.array([45, 49, 57]) / 255


@dataclass(frozen=True)
class Kind:
    """``size`` (width, height) [m], ``cells`` across and down, ``bending`` stiffness [N m],
    ``gravity`` [m/s^2] down in the image, ``pressed``: the share of its width that the pinned
    points come closer, ``wind``: (along the sheet, across it) [m/s], ``self_contact``.
    """

    size: tuple
    cells: tuple
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
        elif self.name != "flag":
            out[:, 2] += 0.015 * swing * np.sign(self.start[:, 0])
        return out

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


def simulate(name, seed):
    """Vertices (FRAMES, N, 3) [m, camera frame] and faces (F, 3) of a sequence."""
    try:
        import newton
        import warp as wp
    except ImportError:
        raise InputError("newton is not installed; 'pip install newton' brings it") from None
    wp.config.quiet = True
    kind, rng = KINDS[name], np.random.default_rng([seed, list(KINDS).index(name)])
    rest, _ = sheet(kind)
    held = pinned(name, kind, rng)
    weather = Weather(name, kind, rest, held, rng)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=wp.vec3(0.0, kind.gravity, 0.0))
    (w, h), (nx, ny) = kind.size, kind.cells
    builder.add_cloth_grid(
        pos=wp.vec3(*rest[0].tolist()), rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, 0.0),
        dim_x=nx, dim_y=ny, cell_x=w / nx, cell_y=h / ny, mass=DENSITY * w * h / len(rest),
        tri_ke=STRETCHING, tri_ka=STRETCHING, tri_kd=1e-6, edge_ke=kind.bending, edge_kd=1e-4,
        particle_radius=0.002,
    )  # fmt: skip
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
    faces = model.tri_indices.numpy().reshape(-1, 3)
    dt, out = 1 / FPS / SUBSTEPS, [rest]
    for step in range(1, (FRAMES - 1) * SUBSTEPS + 1):
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
    return np.array(out), faces


# ---- pictures ------------------------------------------------------------------------------------


def _noise(rng, height, width, first, channels):
    """Smooth noise (height, width, channels) of unit variance, in six octaves from ``first`` knots
    across.
    """
    out = 0
    for octave in range(6):
        knots = first * 2**octave
        coarse = rng.normal(size=(max(2, knots * height // width), knots, channels)).astype(
            np.float32
        )
        out = out + 0.6**octave * cv2.resize(
            coarse, (width, height), interpolation=cv2.INTER_CUBIC
        ).reshape(height, width, channels)
    return out / out.std()


def texture(rng, aspect, height=512):
    """An sRGB texture (H, W, 3) uint8 of one of four kinds: clouds, bars, squares, dots."""
    width = round(height * aspect)
    style = rng.integers(4)
    if style == 0:
        image = 0.5 + 0.28 * _noise(rng, height, width, 4, 3)
    elif style == 1:
        image = np.full((height, width, 3), 0.92, np.float32)
        for _ in range(90):
            x, y, a, b = (
                rng.integers(0, width),
                rng.integers(0, height),
                rng.integers(8, 120),
                rng.integers(4, 40),
            )
            image[y : y + b, x : x + a] = rng.uniform(0, 0.9, 3)
    elif style == 2:
        count = rng.integers(7, 12)
        y, x = np.mgrid[:height, :width] * count // width
        image = np.where(((x + y) % 2)[..., None], rng.uniform(0.1, 0.9, 3), [0.9, 0.88, 0.8]) * (
            1 + 0.06 * _noise(rng, height, width, 30, 1)
        )
    else:
        image = np.tile(np.float32([0.85, 0.82, 0.77]), (height, width, 1))
        for _ in range(60):
            at, radius = (
                (int(rng.integers(0, width)), int(rng.integers(0, height))),
                int(rng.integers(6, 45)),
            )
            cv2.circle(
                image,
                at,
                radius,
                rng.uniform(0, 0.8, 3).tolist(),
                -1 if rng.random() < 0.6 else 5,
                cv2.LINE_AA,
            )
    return (255 * np.clip(image, 0.02, 0.98)).astype(np.uint8)


def render(folder, vertices, faces, uv, rng):
    """Write texture, template, camera, frames and masks of vertices (T, N, 3) [m, camera frame],
    faces (F, 3) and texture coordinates (N, 2) into ``folder``; ``rng`` draws texture, light and
    noise.
    """
    import mitsuba as mi

    for name in ("frames", "masks"):
        os.makedirs(os.path.join(folder, name), exist_ok=True)
    at = lambda *names: os.path.join(folder, *names)
    image = texture(rng, np.ptp(uv[:, 0]) * np.ptp(vertices[0, :, 0]) / np.ptp(vertices[0, :, 1]))
    cv2.imwrite(at("texture.png"), image[..., ::-1])
    write_obj(at("template.obj"), vertices[0], faces, uv)
    width, height = SIZE
    with open(at("camera.json"), "w", encoding="utf-8") as file:
        json.dump(
            dict(width=width, height=height, fx=FOCAL, fy=FOCAL, cx=width / 2, cy=height / 2),
            file,
            indent=1,
        )
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective", "fov": float(np.degrees(2 * np.arctan(width / 2 / FOCAL))),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
            "film": {
                "type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
                "pixel_format": "rgb"
            },
        }, "sky": {"type": "constant", "radiance": 0.35},
        "lamp": {
            "type": "sphere", "center": [rng.uniform(-0.9, 0.9), -0.9, -0.3], "radius": 0.18,
            "emitter": {"type": "area", "radiance": 9.0}
        },
        "cloth": {
            "type": "obj", "filename": at("template.obj"),
            "bsdf": {
                "type": "twosided",
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "bitmap", "filename": at("texture.png")}
                }
            }
        },
    })  # fmt: skip
    depth = mi.load_dict({"type": "aov", "aovs": "z:depth"})
    parameters = mi.traverse(scene)
    key = next(
        k for k in parameters.keys() if k.startswith("cloth") and k.endswith("vertex_positions")
    )
    start = np.array(parameters[key]).reshape(-1, 3)
    corner = np.linalg.norm(start[:, None] - vertices[0], axis=-1).argmin(
        1
    )  # Mitsuba orders an OBJ's vertices itself
    gain = None
    for t, x in enumerate(vertices):
        parameters[key] = x[corner].astype(np.float32).ravel()
        parameters.update()
        light = np.array(mi.render(scene, spp=SAMPLES, seed=t))[..., :3]
        mask = (
            np.array(mi.render(scene, integrator=depth, spp=16, seed=t))[..., -1]
            > 0.5 * x[:, 2].min()
        )  # most of its rays meet the sheet
        gain = gain or 1.25 * (image.mean() / 255) ** 2.2 / np.median(light[mask].mean(-1))
        srgb = np.where(mask[..., None], np.clip(gain * light, 0, 1) ** (1 / 2.2), BACKGROUND)
        levels = 255 * srgb + rng.normal(0, NOISE, srgb.shape)
        cv2.imwrite(
            at("frames", f"{t:03d}.png"),
            np.clip(np.round(levels), 0, 255).astype(np.uint8)[..., ::-1],
        )
        cv2.imwrite(at("masks", f"{t:03d}.png"), 255 * mask.astype(np.uint8))


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
    args = parser.parse_args(argv)
    if args.seed < 0:
        raise InputError(f"--seed {args.seed}: 0 or more")
    set_variant("llvm_ad_rgb")
    for name in args.only:
        folder = os.path.join(args.out, name)
        if os.path.exists(folder):
            raise InputError(f"{folder}: exists already; another OUT is needed")
        vertices, faces = simulate(name, args.seed)
        render(
            folder,
            vertices,
            faces,
            sheet(KINDS[name])[1],
            np.random.default_rng([args.seed, list(KINDS).index(name), 1]),
        )
        np.savez_compressed(
            os.path.join(folder, "gt.npz"),
            vertices=vertices.astype(np.float32),
            faces=faces.astype(np.int32),
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
