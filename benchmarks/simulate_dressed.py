"""Videos of garments on moving bodies, with their truth: cloth by Newton, which shares no code with
OneFit, filmed by Mitsuba's path tracer in a room.

    pip install newton
    python benchmarks/simulate_dressed.py OUT --garment tshirt --motion dance --seed 3
    python benchmarks/dressed.py --data OUT --only tshirt_dance_3 --kinds body --docs OUT

OUT receives the folder GARMENT_MOTION_SEED, in some six minutes on one core, as
``polysft prepare --body`` takes it: ``template.obj`` on the body's rest (z up, facing -y),
``texture.png``, ``camera.json`` with ``world_to_camera``, ``frames``, ``masks`` of the cloth that
is seen, ``body.npz``; and ``gt.npz``, the true vertices (T, N, 3) [m, camera frame], with those
that the camera sees. The body's motion in ``body.npz`` is as an estimator gives it: joints are 2.5
degrees off, the root 1.5 cm, slowly changing. The seed decides motion, texture, light and errors.
"""

import argparse
import json
import os

import cloth_simulation
import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from simulate_pictures import placer, texture

from polyfit.backend import set_variant
from polyfit.errors import InputError, cli
from polyfit.mesh import TexCoords
from polysft_mi.surface.meshio import write_obj

FRAMES, FPS = 45, 30.0
SIZE, FOCAL, AWAY = (360, 480), 600.0, 1.9  # of the images [pixels]; of the camera [m]
SAMPLES, NOISE = 48, 1.5  # paths a pixel; standard deviation of the noise [levels of 255]
SKIN = (0.55, 0.38, 0.3)  # reflectance, linear RGB
NEAR = 4e-3  # [m]: what a ray meets within so far of a vertex is the vertex
DEEPEST = 0.01  # [m] that cloth may lie in the body
JOINT_ERROR, ROOT_ERROR = np.radians(2.5), 0.015  # root mean squares [rad], [m]


def split_in_two(vertices, faces):
    """:class:`polyfit.mesh.TexCoords` of a garment's vertices (N, 3) [m], which faces -y, and faces
    (F, 3), front and back beside each other; and width over height of its texture.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    for _ in range(3):  # of a face and those around it
        around = np.zeros_like(vertices)
        np.add.at(around, faces, normal[:, None])
        normal = around[faces].mean(1)
    back = normal[:, 1] > 0
    x, z = vertices[:, 0], vertices[:, 2]
    across, high = (x - x.min()) / np.ptp(x), (z - z.min()) / np.ptp(z)
    flat = lambda shift: np.stack([0.02 + 0.46 * across + shift, 0.02 + 0.96 * high], 1)
    coordinates = np.concatenate([flat(0), flat(0.5)])
    return TexCoords(coordinates, faces + len(vertices) * back[:, None]), 2 * np.ptp(x) / np.ptp(z)


def as_estimated(poses, translation, rng):
    """Poses (T, J, 3) [rad] and the root's places (T, 3) [m], with errors that change slowly."""
    time = np.arange(len(poses)) / FPS

    def slow(size, rms):
        rate, phase = rng.uniform(0.1, 0.6, (3, size)), rng.uniform(0, 2 * np.pi, (3, size))
        waves = np.sin(2 * np.pi * rate * time[:, None, None] + phase).sum(1)
        return rms * np.sqrt(2 / 3) * waves / np.sqrt(3)  # three numbers make an error

    turn = Rotation.from_rotvec(slow(poses[0].size, JOINT_ERROR).reshape(-1, 3))
    off = (Rotation.from_rotvec(poses.reshape(-1, 3)) * turn).as_rotvec().reshape(poses.shape)
    return off, translation + slow(3, ROOT_ERROR)


def check_outside(cloth, body, body_faces):
    """Raise InputError where limbs have gone through ``cloth`` (T, N, 3), as fast ones do: more
    than a hundredth of it lies deeper than DEEPEST in ``body`` (T, V, 3) [m].
    """
    from onefit.body import ClosestSurface

    surface = ClosestSurface(body[0], body_faces)
    for t, (x, skin) in enumerate(zip(cloth, body, strict=True)):
        surface.follow(skin.astype(np.float32))
        inside = float((surface(x.astype(np.float32)).distance < -DEEPEST).mean())
        if inside > 0.01:
            raise InputError(
                f"in frame {t} the body has gone through the cloth ({inside:.0%} is inside):"
                " another seed, motion or garment is needed"
            )


def film(folder, rest, cloth, body, body_faces, world_to_camera, rng):
    """Write frames and masks of the template in ``folder``, whose vertices ``rest`` (N, 3) are at
    ``cloth`` (T, N, 3), on ``body`` (T, V, 3) [m, world], from a camera at ``world_to_camera`` (4,
    4) that looks along y; ``rng`` draws wall, light and noise. Returns which vertices it sees, (T,
    N) bool.
    """
    import mitsuba as mi

    at = lambda *names: os.path.join(folder, *names)
    for name in ("frames", "masks"):
        os.makedirs(at(name), exist_ok=True)
    write_obj(at("body.obj"), body[0], body_faces, np.zeros((len(body[0]), 2)))
    wall = (255 * rng.uniform(0.3, 0.6) * np.ones((64, 64))).astype(np.float32)
    wall += 25 * cv2.resize(rng.normal(size=(9, 9)).astype(np.float32), (64, 64))
    cv2.imwrite(at("wall.png"), np.clip(wall, 0, 255).astype(np.uint8))
    T, (width, height) = mi.ScalarTransform4f, SIZE
    diffuse = lambda reflectance: {"type": "diffuse", "reflectance": reflectance}
    bitmap = lambda name: {"type": "bitmap", "filename": at(name)}
    ground = float(body[..., 2].min())
    eye = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    lamp = T().translate([rng.uniform(-1.2, 1.2), -1.5, ground + 2.6]).scale(0.35)
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 4},
        "sensor": {
            "type": "perspective", "fov": float(np.degrees(2 * np.arctan(width / 2 / FOCAL))),
            "fov_axis": "x",
            "to_world": T().look_at(eye.tolist(), (eye + (0, 1, 0)).tolist(), [0, 0, 1]),
            "film": {
                "type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
        },
        "sky": {"type": "constant", "radiance": 0.35},
        "lamp": {
            "type": "sphere", "to_world": lamp, "emitter": {"type": "area", "radiance": 6.0}
        },
        "wall": {
            "type": "rectangle", "bsdf": diffuse(bitmap("wall.png")),
            "to_world": T().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(5),
        },
        "floor": {
            "type": "rectangle", "bsdf": diffuse({"type": "rgb", "value": 0.35}),
            "to_world": T().translate([0, 0, ground]).scale(5),
        },
        "body": {
            "type": "obj", "filename": at("body.obj"),
            "bsdf": diffuse({"type": "rgb", "value": SKIN}),
        },
        "cloth": {
            "type": "obj", "filename": at("template.obj"),
            "bsdf": {"type": "twosided", "bsdf": diffuse(bitmap("texture.png"))},
        },
    })  # fmt: skip
    places = [placer(scene, rest), placer(scene, body[0], "body")]
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x - width / 2, y - height / 2, np.full(x.shape, FOCAL)], -1)
    pixels = pixels.reshape(-1, 3) @ world_to_camera[:3, :3]
    the_cloth = next(shape for shape in scene.shapes() if shape.id() == "cloth")
    seen, gain = [], None
    for t, x in enumerate(cloth):
        for place, to in zip(places, (x, body[t]), strict=True):
            place(to)
        light = np.array(mi.render(scene, spp=SAMPLES, seed=t))[..., :3]
        mask = np.array(_met(scene, eye, pixels).shape == mi.ShapePtr(the_cloth))
        mask = mask.reshape(height, width)
        gain = gain or 0.8 / np.percentile(light[mask], 95)
        levels = 255 * np.clip(gain * light, 0, 1) ** (1 / 2.2)
        levels += rng.normal(0, NOISE, levels.shape)
        image = np.clip(np.round(levels), 0, 255).astype(np.uint8)
        cv2.imwrite(at("frames", f"{t:03d}.png"), image[..., ::-1])
        cv2.imwrite(at("masks", f"{t:03d}.png"), 255 * mask.astype(np.uint8))
        seen.append(_visible(scene, x, eye, world_to_camera))
    for name in ("body.obj", "wall.png"):
        os.remove(at(name))
    return np.array(seen)


def _met(scene, eye, ways):
    """What the rays from ``eye`` (3,) [m, world] along ``ways`` (R, 3) meet first."""
    import mitsuba as mi

    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    rays = mi.Ray3f(mi.Point3f(eye.tolist()), mi.Vector3f(ways.T.astype(np.float32)))
    return scene.ray_intersect_preliminary(rays)


def _visible(scene, x, eye, world_to_camera):
    """Which of the vertices x (N, 3) [m, world] the camera at ``eye`` sees, (N,) bool."""
    far = np.linalg.norm(x - eye, axis=1)
    own = x @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    pixel = FOCAL * own[:, :2] / own[:, 2:] + np.array(SIZE) / 2
    met = np.array(_met(scene, eye, x - eye).t)
    return (met > far - NEAR) & ((pixel > 0) & (pixel < SIZE)).all(1)


def make(folder, name, kind, seed):
    """Write a sequence into ``folder``."""
    from onefit_reference import simulated

    import onefit
    from onefit.body import skinning
    from onefit.garment import standard_body
    from onefit.physics import MATERIALS

    rng = np.random.default_rng([seed, 7])
    garment, body = onefit.Garment.template(name).remeshed(1100), standard_body()
    motion = onefit.Motion.generate(kind, seconds=FRAMES / FPS, seed=1_000_003 + seed)
    cache = os.path.join(folder, "simulation")
    settings = cloth_simulation.Settings()
    cloth = simulated(cache, garment, motion, body, MATERIALS["cotton"], settings)
    cloth = cloth.double().numpy()[:FRAMES]
    maps = skinning.transforms(body, motion.poses, motion.translation)
    skin = skinning.skin(body.vertices, body.blend_weights, maps).double().numpy()[:FRAMES]
    check_outside(cloth, skin, body.faces.numpy())
    rest, faces = garment.graded(body).double().numpy(), garment.faces.numpy()
    middle = (cloth.max((0, 1)) + cloth.min((0, 1))) / 2
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = axes
    world_to_camera[:3, 3] = -axes @ (middle - (0, AWAY, 0))
    texcoords, aspect = split_in_two(rest, faces)
    at = lambda *names: os.path.join(folder, *names)
    cv2.imwrite(at("texture.png"), texture(rng, aspect)[..., ::-1])
    write_obj(at("template.obj"), rest, faces, texcoords)
    width, height = SIZE
    camera = dict(width=width, height=height, fx=FOCAL, fy=FOCAL, cx=width / 2, cy=height / 2)
    with open(at("camera.json"), "w", encoding="utf-8") as file:
        json.dump(camera | {"world_to_camera": world_to_camera.tolist()}, file, indent=1)
    poses, places = (x.double().numpy()[:FRAMES] for x in (motion.poses, motion.translation))
    poses, places = as_estimated(poses, places, rng)
    np.savez(at("body.npz"), poses=poses, translation=places, fps=FPS)
    seen = film(folder, rest, cloth, skin, body.faces.numpy(), world_to_camera, rng)
    true = cloth @ axes.T + world_to_camera[:3, 3]
    np.savez_compressed(at("gt.npz"), vertices=true.astype(np.float32), faces=faces, seen=seen)


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", metavar="OUT", help="folder of the sequences' folders")
    parser.add_argument("--garment", default="tshirt", help="a template of OneFit's")
    parser.add_argument("--motion", default="dance", help="a kind of onefit.Motion.generate")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: 0 or more")
    set_variant()
    torch.set_num_threads(1)
    folder = os.path.join(options.out, f"{options.garment}_{options.motion}_{options.seed}")
    make(folder, options.garment, options.motion, options.seed)
    print(f"written: {folder}")


if __name__ == "__main__":
    cli(main)
