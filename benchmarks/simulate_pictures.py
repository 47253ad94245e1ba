"""Pictures of what ``simulate.py`` lets move: textures, and frames by Mitsuba's path tracer."""

import json
import os

import cv2
import numpy as np
from scipy.spatial import cKDTree

from polysft_mi.surface.meshio import write_obj

SIZE, FOCAL = (480, 360), 552.0  # of the images [pixels]
SAMPLES, NOISE = 32, 1.5  # paths a pixel; standard deviation of the noise [levels of 255]
BACKGROUND = np.array([45, 49, 57]) / 255
NEAR = 2e-3  # [m]: what a ray meets within so far of a vertex is the vertex


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


def texture(rng, aspect, plain=False, height=512):
    """An sRGB texture (H, W, 3) uint8 of one of four kinds: clouds, bars, squares, dots; or a
    ``plain`` one: slow changes of colour, and three large flat regions.
    """
    width = round(height * aspect)
    style = rng.integers(4)
    if plain:
        y, x = np.mgrid[:height, :width] / height - 0.5
        slow = rng.uniform(-0.5, 0.5, (2, 3))
        image = rng.uniform(0.4, 0.6, 3) + x[..., None] * slow[0] / aspect + y[..., None] * slow[1]
        image = np.ascontiguousarray(image, np.float32)
        for k in range(3):
            at = int((k + rng.uniform(0.3, 0.7)) * width / 3), int(rng.uniform(0.3, 0.7) * height)
            axes = int(rng.uniform(0.1, 0.15) * width), int(rng.uniform(0.15, 0.25) * height)
            colour = rng.uniform(0.1, 0.9, 3).tolist()
            cv2.ellipse(image, at, axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
    elif style == 0:
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


def render(folder, vertices, shape, rng, plain=False):
    """Write texture, template, camera, frames and masks of vertices (T, N, 3) [m, camera frame] of
    a :class:`simulate_shapes.Shape` into ``folder``; ``rng`` draws texture (a
    ``plain`` one), light and noise.
    Returns which vertices the camera sees, (T, N) bool.
    """
    import mitsuba as mi

    os.makedirs(folder, exist_ok=True)
    at = lambda *names: os.path.join(folder, *names)
    image = texture(rng, shape.aspect, plain)
    cv2.imwrite(at("texture.png"), image[..., ::-1])
    write_obj(at("template.obj"), vertices[0], shape.faces, shape.uv)
    film(folder, folder, vertices, np.eye(4), rng)
    cloth = {"type": "obj", "filename": at("template.obj")}
    scene = mi.load_dict({"type": "scene", "cloth": cloth})
    place = placer(scene, vertices[0])
    return np.array([visible(place(x), x) for x in vertices])


def add_cameras(folder, out, vertices, angles, seed):
    """Film vertices (T, N, 3) [m] of the template in ``folder`` from further ``angles`` [degrees],
    into folders in ``out``, whose names are returned.
    """
    names = [f"{angle:+04.0f}" for angle in angles]
    for k, (name, angle) in enumerate(zip(names, angles, strict=True)):
        rng = np.random.default_rng([seed, k, 2])
        film(folder, os.path.join(out, name), vertices, around(vertices, angle), rng)
    return names


def around(vertices, degrees):
    """world_to_camera (4, 4) of a camera that looks at the middle of vertices (..., 3) [m] from as
    far as the origin, turned about the upright axis.
    """
    middle = vertices.reshape(-1, 3).mean(0)
    turn, _ = cv2.Rodrigues(np.array([0, np.radians(degrees), 0]))
    at = middle - turn @ middle
    forward = (middle - at) / np.linalg.norm(middle - at)
    right = np.cross([0, 1, 0], forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    return np.vstack([np.column_stack([axes, -axes @ at]), (0, 0, 0, 1)])


def film(folder, out, vertices, world_to_camera, rng):
    """Write frames, masks and ``camera.json`` into ``out``: the vertices (T, N, 3) [m] of the
    template in ``folder``, from a camera at ``world_to_camera`` (4, 4); ``rng`` draws light and
    noise.
    """
    import mitsuba as mi

    for name in ("frames", "masks"):
        os.makedirs(os.path.join(out, name), exist_ok=True)
    at = lambda *names: os.path.join(folder, *names)
    width, height = SIZE
    camera = dict(width=width, height=height, fx=FOCAL, fy=FOCAL, cx=width / 2, cy=height / 2)
    if not np.array_equal(world_to_camera, np.eye(4)):
        camera["world_to_camera"] = np.round(world_to_camera, 9).tolist()
    with open(os.path.join(out, "camera.json"), "w", encoding="utf-8") as file:
        json.dump(camera, file, indent=1)
    image = cv2.imread(at("texture.png"))
    origin = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    down, forward = world_to_camera[1, :3], world_to_camera[2, :3]
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective", "fov": float(np.degrees(2 * np.arctan(width / 2 / FOCAL))),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(
                origin.tolist(), (origin + forward).tolist(), (-down).tolist()
            ),
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
    place, gain = placer(scene, vertices[0]), None
    for t, x in enumerate(vertices):
        place(x)
        nearest = (x @ forward + world_to_camera[2, 3]).min()
        light = np.array(mi.render(scene, spp=SAMPLES, seed=t))[..., :3]
        mask = (
            np.array(mi.render(scene, integrator=depth, spp=16, seed=t))[..., -1] > 0.5 * nearest
        )  # most of its rays meet the sheet
        gain = gain or 1.25 * (image.mean() / 255) ** 2.2 / np.median(light[mask].mean(-1))
        srgb = np.where(mask[..., None], np.clip(gain * light, 0, 1) ** (1 / 2.2), BACKGROUND)
        levels = 255 * srgb + rng.normal(0, NOISE, srgb.shape)
        cv2.imwrite(
            os.path.join(out, "frames", f"{t:03d}.png"),
            np.clip(np.round(levels), 0, 255).astype(np.uint8)[..., ::-1],
        )
        cv2.imwrite(os.path.join(out, "masks", f"{t:03d}.png"), 255 * mask.astype(np.uint8))


def placer(scene, rest, name="cloth"):
    """A function that puts vertices (N, 3) [m] into a scene whose mesh ``name`` is loaded with
    those of ``rest``, and returns the scene.
    """
    import mitsuba as mi

    parameters = mi.traverse(scene)
    key = next(
        k for k in parameters.keys() if k.startswith(name) and k.endswith("vertex_positions")
    )
    start = np.array(parameters[key]).reshape(-1, 3)
    corner = cKDTree(rest).query(start)[1]  # Mitsuba orders an OBJ's vertices itself

    def place(x):
        parameters[key] = x[corner].astype(np.float32).ravel()
        parameters.update()
        return scene

    return place


def visible(scene, x):
    """Which of the vertices x (N, 3) [m] the camera at the origin sees, (N,) bool."""
    import mitsuba as mi

    far = np.linalg.norm(x, axis=1)
    ray = mi.Ray3f(mi.Point3f(0.0), mi.Vector3f((x / far[:, None]).T.astype(np.float32)))
    met = np.array(scene.ray_intersect_preliminary(ray).t)
    pixel = FOCAL * x[:, :2] / x[:, 2:] + np.array(SIZE) / 2
    return (met > far - NEAR) & ((pixel > 0) & (pixel < SIZE)).all(1)
