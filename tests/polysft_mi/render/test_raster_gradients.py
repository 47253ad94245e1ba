"""The raster integrator's gradients, against central finite differences; its
loop compiles nothing anew.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from problems import tube_template
from raster_scenes import (
    HEIGHT,
    WIDTH,
    picture,
    raster,
    sensor,
    write_mesh,
)
from scipy.spatial.transform import Rotation

from polysft_mi.images import differentiable
from polysft_mi.scene import plugins
from polysft_mi.surface.patch import JetAtlas, Unknowns
from polysft_mi.surface.template import Template


@pytest.fixture(autouse=True)
def registered():
    plugins.register()


class Sheet:
    """A deforming surface in a scene; ``kind`` chooses its texture, shape and pose: a sheet of one
    patch, or the tube of several, whose texture has a seam.
    """

    def __init__(self, folder, kind, resolution=(21, 17)):
        n, m = resolution
        y, x = np.meshgrid(np.linspace(-0.12, 0.12, m), np.linspace(-0.16, 0.16, n), indexing="ij")
        vertices = np.stack([x, y, 0.7 + 0 * x], -1).reshape(-1, 3)
        i = np.arange(n * m).reshape(m, n)
        a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
        uv = np.stack([x.ravel() / 0.32 + 0.5, y.ravel() / 0.24 + 0.5], 1)
        self.corner = None
        template = tube_template(13, 32) if kind == "tube" else Template.fit(vertices, faces, uv, 4)
        self.patch = JetAtlas(template)
        if kind == "tube":
            source, uv, faces = template.texcoords.split(template.faces)
            vertices = template.vertices[source]
            self.corner = mi.UInt32(source.astype(np.uint32))
        mesh = write_mesh(folder / "sheet.ply", vertices, faces, uv)
        v, u = np.meshgrid(np.linspace(0, 1, 192), np.linspace(0, 1, 256), indexing="ij")
        frequency = 5 if kind != "textured" else 30
        texture = 0.5 + 0.35 * np.stack(
            [np.sin(frequency * u), np.cos(0.8 * frequency * v), np.sin(0.7 * frequency * (u + v))],
            -1,
        )
        bitmap = mi.Bitmap(texture.astype(np.float32))
        reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
        bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
        self.scene = mi.load_dict(
            {"type": "scene", "sensor": sensor(), "sheet": {**mesh, "bsdf": bsdf}}
        )
        self.params = mi.traverse(self.scene)
        self.key = next(k for k in self.params.keys() if k.endswith("vertex_positions"))
        self.integrator = raster()
        rng = np.random.default_rng(3)
        rest = self.patch.rest().to_numpy()
        size = rest["delta_alpha"].shape
        rest["delta_alpha"] = (0.06 * rng.normal(size=size)).astype(np.float32)
        rest["delta_u"] = (0.01 * np.sin(9 * template.vertices[:, 1])).astype(np.float32)
        if kind == "tube":
            turns = Rotation.from_rotvec(0.05 * rng.normal(size=(len(template), 3)))
            rest["rotation"] = turns.as_quat().astype(np.float32)
        if kind == "self-occluding":  # a wave seen from the side: one of its slopes hides the other
            rest["delta_alpha"] = np.zeros((1, 15), np.float32)
            rest["delta_alpha"][0, [1, 6]] = -1.6, 2.6
            rest["rotation"] = np.array([[0, np.sin(0.55), 0, np.cos(0.55)]], np.float32)
        if kind == "behind":
            rest["rotation"] = np.array([[0, np.sin(1.45), 0.05, np.cos(1.45)]], np.float32)
        if kind == "partly out":
            rest["translation"] = np.array([[0.9, -0.5, 0.1]], np.float32)
        self.arrays = rest

    def place(self, unknowns):
        points = self.patch.vertices(unknowns)
        if self.corner is not None:
            points = dr.gather(mi.Point3f, dr.ravel(points), self.corner)
        self.params[self.key] = dr.ravel(points)
        self.params.update()

    def image(self, unknowns):
        self.place(unknowns)
        return mi.render(self.scene, self.params, integrator=self.integrator, spp=1)

    def step(self, name, direction, h):
        return Unknowns.from_numpy({**self.arrays, name: self.arrays[name] + h * direction})


DIRECTIONS = ["delta_alpha", "delta_u", "delta_v", "delta_w", "rotation", "translation"]


def direction_of(name, shape):
    rng = np.random.default_rng(11)
    if name in (
        "delta_u",
        "delta_v",
        "delta_w",
    ):  # a smooth field over the sheet, as a deformation is
        return np.sin(np.linspace(0, 4, *shape) + 0.5).astype(np.float32)
    out = rng.normal(size=shape).astype(np.float32)
    if name == "rotation":
        out[:, 3] = 0
    return out / np.linalg.norm(out)


@pytest.mark.parametrize(
    "kind", ["smooth", "textured", "self-occluding", "behind", "partly out", "tube"]
)
def test_gradients_against_finite_differences(tmp_path, kind):
    sheet = Sheet(tmp_path, kind)
    rng = np.random.default_rng(5)
    shift = (0.03 * rng.normal(size=sheet.arrays["delta_alpha"].shape)).astype(np.float32)
    goal = Unknowns.from_numpy(
        {
            **sheet.arrays,
            "translation": sheet.arrays["translation"] + np.array([0.03, -0.02, 0.05], np.float32),
            "delta_alpha": sheet.arrays["delta_alpha"] + shift
        }
    )  # fmt: skip
    target = dr.detach(sheet.image(goal))
    covered = np.array(target)[..., 3]
    assert covered.sum() > 300
    colour = mi.Float(np.tile([1, 1, 1, 0], HEIGHT * WIDTH))

    def losses(unknowns):
        """Of the colours, and of alpha."""
        # blurred, so that the loss is smooth where the image has a kink at every pixel that
        # changes sheets
        difference = mi.TensorXf(sheet.image(unknowns).array - target.array, target.shape)
        squared = dr.square(differentiable.blur(difference, 2.0).array)
        return dr.sum(colour * squared), dr.sum((1 - colour) * squared)

    # the median over steps, for single pixels jump where triangles are seen edge-on
    directions = {name: direction_of(name, sheet.arrays[name].shape) for name in DIRECTIONS}
    numeric = {}
    for name, direction in directions.items():
        slopes = []
        for h in (2.5e-4, 5e-4, 1e-3, 2e-3):
            ends = [losses(sheet.step(name, direction, x)) for x in (h, -h)]
            dr.eval(ends)
            slopes.append([(a[0] - b[0]) / (2 * h) for a, b in zip(*ends)])
        numeric[name] = np.median(slopes, axis=0)

    for k, channels in enumerate(("colours", "alpha")):
        unknowns = Unknowns.from_numpy(sheet.arrays)
        for _, value in unknowns.items():
            dr.enable_grad(value)
        dr.backward(losses(unknowns)[k])
        for name, direction in directions.items():
            gradient = np.array(dr.grad(getattr(unknowns, name))).reshape(direction.shape)
            ad, fd = float((gradient * direction).sum()), numeric[name][k]
            # of a direction across the gradient, what its length would give
            share = 0.15 if kind == "tube" else 0.05  # its outline passes from edge to edge
            assert abs(ad - fd) <= share * max(
                abs(fd), 0.25 * np.linalg.norm(gradient) * np.linalg.norm(direction), 2.0
            ), f"{kind}, {channels}, {name}: AD {ad:.4g}, finite differences {fd:.4g}"


def test_self_occlusion_is_there(tmp_path):
    """The case named so above does show two sheets behind each other."""
    sheet = Sheet(tmp_path, "self-occluding")
    sheet.place(Unknowns.from_numpy(sheet.arrays))
    depth = picture(sheet.scene, aovs="depth")[..., 4]
    jump = np.abs(np.diff(depth, axis=1))[(depth[:, 1:] > 0) & (depth[:, :-1] > 0)]
    assert (jump > 0.03).sum() > 20


@pytest.mark.parametrize("kind", ["smooth", "self-occluding", "tube"])
def test_forward_mode_agrees_with_reverse_mode(tmp_path, kind):
    sheet = Sheet(tmp_path, kind)
    weight = mi.Float(np.random.default_rng(2).normal(size=HEIGHT * WIDTH * 4).astype(np.float32))
    for name in DIRECTIONS:
        direction = mi.Float(direction_of(name, sheet.arrays[name].shape).ravel())
        unknowns = Unknowns.from_numpy(sheet.arrays)
        value = getattr(unknowns, name)
        dr.enable_grad(value)
        dr.backward(dr.sum(weight * sheet.image(unknowns).array))
        reverse = dr.sum(dr.grad(value) * direction)[0]
        unknowns = Unknowns.from_numpy(sheet.arrays)
        value = getattr(unknowns, name)
        dr.enable_grad(value)
        dr.set_grad(value, direction)
        image = sheet.image(unknowns)
        forward = dr.sum(weight * dr.forward_to(image.array, flags=dr.ADFlag.Default))[0]
        assert forward == pytest.approx(reverse, rel=2e-3, abs=0.02), name


def test_direct_call_is_the_same_as_mi_render(tmp_path):
    sheet = Sheet(tmp_path, "smooth")
    gradients = []
    for direct in (True, False):
        unknowns = Unknowns.from_numpy(sheet.arrays)
        dr.enable_grad(unknowns.delta_alpha)
        image = sheet.image(unknowns) if not direct else None
        if direct:
            sheet.place(unknowns)
            image = sheet.integrator.render(sheet.scene, spp=1)
        dr.backward(dr.sum(dr.square(image.array - 0.3)))
        gradients.append(np.array(dr.grad(unknowns.delta_alpha)))
    assert gradients[0] == pytest.approx(
        gradients[1], rel=1e-3, abs=1e-3 * float(np.abs(gradients[1]).max())
    )


def test_no_kernel_is_compiled_and_no_memory_grows_in_a_loop(tmp_path):
    sheet = Sheet(tmp_path, "smooth")

    def iterate(k):
        unknowns = Unknowns.from_numpy(
            {**sheet.arrays, "translation": sheet.arrays["translation"] + 0.01 * k}
        )
        for _, value in unknowns.items():
            dr.enable_grad(value)
        dr.backward(dr.sum(dr.square(sheet.image(unknowns).array - 0.3)))
        dr.eval([dr.grad(value) for _, value in unknowns.items()])

    for k in range(2):
        iterate(k)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        for k in range(2, 14):  # the region in the image grows by a pixel now and then
            iterate(k)
        history = dr.kernel_history((dr.KernelType.JIT,))
    assert len(history) > 50
    assert [h for h in history if not h["cache_hit"]] == []
