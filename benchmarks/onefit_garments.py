"""Measure the garment templates, their blend weights, grading and preprocessing.

    python benchmarks/onefit_garments.py [more.obj ...] [--shapes 60] [-o out/benchmarks]

For the eight templates, and for the garment files given, it prints (in two minutes)

- the mesh: vertices, faces, openings, area, median edge, smallest angle, distance from the standard
  body;
- stretch: the longest of an edge when the left shoulder and hip turn by 40 degrees, with weights
  smoothed (as they are);
- skinned: vertices inside the body, %, in four frames of each kind of motion that networks are
  trained on, plain skinning;
- graded: vertices inside the body, %, over random shapes, the deepest [mm], and milliseconds for
  each;
- back: the distance [mm], mean and largest, from where a template was, when it is graded to random
  shapes, put into the T-pose and read back with ``made_for``;

and the grading to a body of another topology against that of the same body. Writes
``onefit_garments.json``.
"""

import argparse
import json
import os
import time
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from sequences import ROOT

from onefit.body import AnnyBody, skeleton, skinning
from onefit.garment import TEMPLATES, Garment, fitting, standard_body, standard_surface
from onefit.garment.binding import Binding, surface_of
from onefit.motion import Motion, generate
from polyfit import mesh
from polyfit.errors import cli
from polyfit.files import aside
from polyfit.mesh import loops


def lengths(V, F):
    e = mesh.edges_of(F)[0]
    return np.linalg.norm(V[e[:, 0]] - V[e[:, 1]], axis=1)


def mesh_figures(garment):
    V, F = garment.vertices.double().numpy(), garment.faces.numpy()
    side = np.roll(V[F], -1, axis=1) - V[F]
    length = np.linalg.norm(side, axis=2)
    angle = np.degrees(
        np.arccos(
            np.clip(
                -(side * np.roll(side, 1, axis=1)).sum(axis=2)
                / length
                / np.roll(length, 1, axis=1),
                -1,
                1,
            )
        )
    )
    d = 1e3 * standard_surface()(V).distance
    return {
        "vertices": len(V), "faces": len(F), "openings": len(loops(F)),
        "area": mesh.areas(V, F).sum(), "edge_mm": 1e3 * np.median(lengths(V, F)),
        "angle": angle.min(), "distance_mm": (d.min(), np.median(d), d.max()),
    }  # fmt: skip


def stretch(garment):
    """The longest stretch with weights (smoothed, of the nearest points)."""
    body, F = standard_body(), garment.faces.numpy()
    raw = Binding(garment.vertices.double().numpy(), F).on_body(body.blend_weights.numpy())
    poses = []
    for turn in np.radians(40) * np.concatenate([np.eye(3), -np.eye(3)]):
        pose = body.rest_pose.clone()
        for j in (skeleton.INDEX["left_shoulder"], skeleton.INDEX["left_hip"]):
            pose[j] = torch.as_tensor(
                (Rotation.from_rotvec(turn) * Rotation.from_rotvec(pose[j].numpy())).as_rotvec()
            ).float()
        poses.append(pose)
    maps = skinning.transforms(body, torch.stack(poses), torch.zeros(len(poses), 3))
    rest = lengths(garment.vertices.numpy(), F)
    worst = lambda w: max(
        (lengths(x, F) / rest).max() for x in skinning.skin(garment.vertices, w, maps).numpy()
    )
    return worst(garment.blend_weights), worst(torch.as_tensor(raw).float())


def posed_bodies():
    """(transforms (T, 24, 3, 4), surfaces) of four frames of every kind of motion."""
    body, poses = standard_body(), []
    for kind in generate.TRAINING:
        motion = Motion.generate(kind, seconds=3, seed=1)
        poses.append(motion.poses[np.linspace(0, len(motion.poses) - 1, 4).astype(int)])
    poses = torch.cat(poses)
    maps = skinning.transforms(body, poses, torch.zeros(len(poses), 3))
    vertices = skinning.skin(body.vertices, body.blend_weights, maps)
    return maps, [surface_of(replace(body, vertices=v)) for v in vertices]


def inside(surfaces, vertices):
    """Share of vertices inside [%], mean over the bodies, and the deepest [mm]."""
    d = [s(v).distance for s, v in zip(surfaces, vertices)]
    return 100 * np.mean([(x < 0).mean() for x in d]), 1e3 * max(0.0, -min(x.min() for x in d))


def back(garment, bodies):
    pose, error = torch.zeros(1, 24, 3), []
    for body in bodies:
        V = skinning.skin(
            garment.graded(body),
            garment.blend_weights,
            skinning.transforms(body, pose, torch.zeros(1, 3)),
        )[0]
        read = Garment.of_mesh(
            garment.name,
            V.double().numpy(),
            garment.faces.numpy(),
            made_for=fitting.in_pose(body, pose[0]),
        )
        error.append(1e3 * (read.vertices - garment.vertices).norm(dim=1).numpy())
    return np.mean(error), np.max(error)


def other_topology(body):
    """The same surface with four times the triangles, as another kind of body."""
    faces, edges = mesh.subdivided(body.faces.numpy())
    finer = lambda x: torch.as_tensor(np.concatenate([x.numpy(), x.numpy()[edges].mean(axis=1)]))
    return replace(
        body,
        kind="other",
        vertices=finer(body.vertices),
        blend_weights=finer(body.blend_weights),
        faces=torch.as_tensor(faces),
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("garments", nargs="*")
    parser.add_argument("--shapes", type=int, default=60)
    parser.add_argument("-o", "--output", default=os.path.join(ROOT, "out", "benchmarks"))
    args = parser.parse_args()
    model, rng = AnnyBody(), np.random.default_rng(5)
    bodies = [model.body(model.random_shape(rng)) for _ in range(args.shapes)]
    surfaces = [surface_of(b) for b in bodies]
    maps, posed = posed_bodies()
    result = {}
    for garment in [Garment.template(name) for name in TEMPLATES] + [
        Garment.read(path) for path in args.garments
    ]:
        figures = result[garment.name] = mesh_figures(garment)
        figures["stretch"], figures["stretch_unsmoothed"] = stretch(garment)
        figures["skinned_inside"] = inside(
            posed, skinning.skin(garment.vertices, garment.blend_weights, maps).numpy()
        )[0]
        garment.graded(bodies[0])
        start = time.perf_counter()
        graded = [garment.graded(b).numpy() for b in bodies]
        figures["graded_ms"] = 1e3 * (time.perf_counter() - start) / len(bodies)
        figures["graded_inside"], figures["graded_deepest_mm"] = inside(surfaces, graded)
        text = (
            "{vertices} / {faces}, {openings} openings, {area:.2f} m2, edge {edge_mm:.0f} mm, angle"
            " {angle:.0f}; stretch {stretch:.1f}"
        )
        text += " ({stretch_unsmoothed:.1f}); skinned {skinned_inside:.2f} % inside"
        text += (
            "; graded {graded_inside:.3f} % inside, {graded_deepest_mm:.1f} mm, {graded_ms:.1f} ms"
        )
        if garment.name in TEMPLATES:
            figures["back_mm"] = back(garment, bodies[:3])
            other = [
                garment.graded(other_topology(b)) - torch.as_tensor(g)
                for b, g in zip(bodies[:2], graded)
            ]
            figures["other_topology_mm"] = 1e3 * float(torch.stack(other).norm(dim=2).mean())
            text += (
                "; back {back_mm[0]:.1f}, {back_mm[1]:.1f} mm; other topology"
                " {other_topology_mm:.1f} mm"
            )
        low, median, high = figures["distance_mm"]
        print(
            f"{garment.name}: {text.format(**figures)}; {low:.0f} to {high:.0f} mm ({median:.0f})"
            " from the body",
            flush=True,
        )
    os.makedirs(args.output, exist_ok=True)
    path = os.path.join(args.output, "onefit_garments.json")
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump(result, file, indent=1, default=float)
    print(f"written: {path}")


if __name__ == "__main__":
    cli(main)
