"""The raster integrator: its image against geometry, its gradients against central finite
differences.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from polysft_mi.errors import InputError
from polysft_mi.objective import terms as objective
from polysft_mi.scene import plugins
from polysft_mi.surface.patch import JetPatch, Unknowns
from polysft_mi.surface.template import Template

WIDTH, HEIGHT = 96, 72
UNLIT_MESH = {
    "type": "twosided",
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1, 1, 1]}},
}


@pytest.fixture(autouse=True)
def registered():
    plugins.register()


def sensor(width=WIDTH, height=HEIGHT, fov=40, **film):
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.001,
        "to_world": (
            mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0])
        ),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
            "sample_border": True,
            **film,
        },
    }


def write_mesh(path, vertices, faces, uv=None):
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_texcoords=uv is not None)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(np.asarray(uv, np.float32).ravel())
    params.update()
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": True}


def triangles(path, *corners, **options):
    """A scene of loose triangles, each three points."""
    vertices = np.concatenate([np.asarray(c, float) for c in corners])
    mesh = write_mesh(path / "triangles.ply", vertices, np.arange(len(vertices)).reshape(-1, 3))
    return mi.load_dict(
        {"type": "scene", "sensor": sensor(**options), "mesh": {**mesh, "bsdf": UNLIT_MESH}}
    )


def raster(**options):
    return mi.load_dict({"type": "raster", **options})


def picture(scene, spp=1, **options):
    return np.array(mi.render(scene, integrator=raster(**options), spp=spp))


def pixel_size(depth=1.0, width=WIDTH, fov=40):
    return depth * 2 * np.tan(np.radians(fov / 2)) / width


# ---- the image -----------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_antialiasing_is_exact_where_an_edge_along_an_axis_covers_a_part_of_a_pixel(
    tmp_path, axis, share
):
    # a half plane x < (10 + share) pixels right of (or below) the centre: pixel 10 is covered by
    # that share
    p = pixel_size()
    edge = (10 + share) * p
    corners = np.array([[edge, -20, 1], [edge, 20, 1], [-60, 0, 1]], float)
    image = picture(triangles(tmp_path, corners if axis == 0 else corners[:, [1, 0, 2]]))
    line = image[HEIGHT // 2, WIDTH // 2 :, 3] if axis == 0 else image[HEIGHT // 2 :, WIDTH // 2, 3]
    assert line[:10] == pytest.approx(1, abs=1e-6)
    assert line[10] == pytest.approx(share, abs=2e-4)
    assert line[11:] == pytest.approx(0, abs=1e-6)


def test_slanted_edges_keep_the_area(tmp_path):
    p = pixel_size()
    angle = np.radians(np.arange(3) * 120 + 17)
    corners = np.stack([20 * p * np.cos(angle), 20 * p * np.sin(angle), np.ones(3)], 1)
    area = 0.5 * 3 * np.sin(np.radians(120)) * 20**2
    image = picture(triangles(tmp_path, corners))
    assert image[..., 3].sum() == pytest.approx(area, rel=2e-3)
    assert image[..., 0] == pytest.approx(image[..., 3], abs=1e-6)


def test_edge_of_a_sliver_narrower_than_a_pixel_belongs_to_the_sheet(tmp_path):
    # the last strip of the sheet is a tenth of a pixel wide, so no pixel's centre sees the
    # triangles that own the silhouette
    p = pixel_size()
    x = np.array([-5.0, 10.2, 10.3]) * p
    vertices = np.array([[a, b, 1] for b in (-9 * p, 9 * p) for a in x])
    faces = [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]]
    mesh = write_mesh(tmp_path / "sliver.ply", vertices, faces)
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor(), "mesh": {**mesh, "bsdf": UNLIT_MESH}}
    )
    assert picture(scene)[HEIGHT // 2, WIDTH // 2 + 10, 3] == pytest.approx(0.3, abs=1e-3)


def test_more_samples_approach_the_coverage(tmp_path):
    p = pixel_size()
    angle = np.radians(np.arange(3) * 120 + 40)
    scene = triangles(
        tmp_path, np.stack([20 * p * np.cos(angle), 20 * p * np.sin(angle), np.ones(3)], 1)
    )
    reference = picture(scene, spp=400, antialias=False)
    errors = [np.abs(picture(scene, spp=spp) - reference).max() for spp in (1, 16)]
    assert errors[1] < 0.06 < errors[0] < 0.25


def test_both_sides_look_the_same(tmp_path):
    corners = np.array([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0, 0.2, 1.0]])
    assert (
        np.abs(
            picture(triangles(tmp_path, corners)) - picture(triangles(tmp_path, corners[::-1]))
        ).max()
        < 1e-4
    )


def test_crop_window_is_a_part_of_the_image(tmp_path):
    corners = np.array([[-0.2, -0.2, 1], [0.25, -0.1, 1.2], [0, 0.2, 0.9]])
    whole = picture(triangles(tmp_path, corners))
    crop = picture(
        triangles(
            tmp_path, corners, crop_offset_x=30, crop_offset_y=20, crop_width=40, crop_height=31
        )
    )
    # at the window's border antialiasing lacks the neighbours beyond
    assert np.abs(crop[1:-1, 1:-1] - whole[21:50, 31:69]).max() < 1e-4


def test_aovs(tmp_path):
    corners = [
        np.array([[-0.6, -0.5, 1], [0.6, -0.5, 1], [0, 0.5, 2.0]]),
        np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0, 0.1, 0.5]]),
    ]
    image = picture(triangles(tmp_path, *corners), aovs="depth,normal,triangle", spp=4)
    p = pixel_size(1.0)
    for y, x in ((HEIGHT // 2, WIDTH // 2), (HEIGHT // 2 - 20, WIDTH // 2 - 25), (0, 0)):
        # reference: intersect the ray through the pixel's sample nearest the centre by hand (the
        # lower right one of the 2x2)
        d = np.array([(x + 0.75 - WIDTH / 2) * p, (y + 0.75 - HEIGHT / 2) * p, 1])
        best = (0, [0, 0, 0], -1)
        for k, c in enumerate(corners):
            n = np.cross(c[1] - c[0], c[2] - c[0])
            z = (n @ c[0]) / (n @ d)
            b = np.linalg.lstsq(np.stack([c[1] - c[0], c[2] - c[0]], 1), z * d - c[0], rcond=None)[
                0
            ]
            if b.min() > 0 and b.sum() < 1 and (best[2] < 0 or z < best[0]):
                n = n / np.linalg.norm(n)
                best = (z, n * -np.sign(n @ d), k)
        assert image[y, x, 4] == pytest.approx(best[0], abs=1e-5)
        assert image[y, x, 5:8] == pytest.approx(best[1], abs=1e-5)
        assert image[y, x, 8] == best[2]


def test_bsdf_shading_agrees_with_direct_illumination(tmp_path):
    mesh = write_mesh(tmp_path / "m.ply", [[-1, -1, 1], [1, -1, 1.4], [0, 1, 1.0]], [[0, 1, 2]])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(),
            "mesh": {
                **mesh,
                "bsdf": {
                    "type": "twosided",
                    "bsdf": {
                        "type": "diffuse",
                        "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]},
                    },
                },
            },
            "light": {
                "type": "point",
                "position": [0.3, -0.4, 0.2],
                "intensity": {"type": "rgb", "value": [1, 0.8, 0.5]},
            },
        }
    )
    ours = picture(scene, shading="bsdf", antialias=False)
    theirs = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64))
    inner = ours[..., 3] == 1
    inner[1:-1, 1:-1] &= (
        ours[:-2, 1:-1, 3] + ours[2:, 1:-1, 3] + ours[1:-1, :-2, 3] + ours[1:-1, 2:, 3]
    ) == 4
    assert inner.sum() > 1000
    assert np.abs(ours[inner, :3] / theirs[inner, :3] - 1).mean() < 0.01


def test_develops_through_the_film(tmp_path):
    scene = triangles(tmp_path, np.array([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0, 0.2, 1.0]]))
    integrator = raster(aovs="depth")
    image = np.array(mi.render(scene, integrator=integrator, spp=1))
    film = scene.sensors()[0].film()
    assert np.array(film.develop()) == pytest.approx(image, abs=1e-3)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"shading": "phong"}, "known: unlit, bsdf"),
        ({"aovs": "depth,colour"}, "aov 'colour'"),
        ({"shading_samples": 0}, "at least 1"),
    ],
)
def test_unknown_options(options, message):
    with pytest.raises(Exception, match=message):
        raster(**options)


def test_samples_must_be_a_square(tmp_path):
    scene = triangles(tmp_path, np.array([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0, 0.2, 1.0]]))
    with pytest.raises(InputError, match="spp = 3; a square number"):
        raster().render(scene, spp=3)


# ---- gradients -----------------------------------------------------------------------------------


class Sheet:
    """A deforming sheet in a scene; ``kind`` chooses its texture, shape and pose."""

    def __init__(self, folder, kind, resolution=(21, 17)):
        n, m = resolution
        y, x = np.meshgrid(np.linspace(-0.12, 0.12, m), np.linspace(-0.16, 0.16, n), indexing="ij")
        vertices = np.stack([x, y, 0.7 + 0 * x], -1).reshape(-1, 3)
        i = np.arange(n * m).reshape(m, n)
        a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
        uv = np.stack([x.ravel() / 0.32 + 0.5, y.ravel() / 0.24 + 0.5], 1)
        self.patch = JetPatch(Template.fit(vertices, faces, uv, 4))
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
        rest["delta_alpha"] = (0.06 * rng.normal(size=15)).astype(np.float32)
        rest["delta_u"] = (0.01 * np.sin(9 * vertices[:, 1])).astype(np.float32)
        if kind == "self-occluding":  # a wave seen from the side: one of its slopes hides the other
            rest["delta_alpha"] = np.zeros(15, np.float32)
            rest["delta_alpha"][[1, 6]] = -1.6, 2.6
            rest["rotation"] = np.array([0, np.sin(0.55), 0, np.cos(0.55)], np.float32)
        if kind == "behind":
            rest["rotation"] = np.array([0, np.sin(1.45), 0.05, np.cos(1.45)], np.float32)
        if kind == "partly out":
            rest["translation"] = np.array([0.9, -0.5, 0.1], np.float32)
        self.arrays = rest

    def image(self, unknowns):
        self.params[self.key] = dr.ravel(self.patch.vertices(unknowns))
        self.params.update()
        return mi.render(self.scene, self.params, integrator=self.integrator, spp=1)

    def step(self, name, direction, h):
        return Unknowns.from_numpy({**self.arrays, name: self.arrays[name] + h * direction})


DIRECTIONS = ["delta_alpha", "delta_u", "delta_v", "delta_w", "rotation", "translation"]


def direction_of(name, size):
    rng = np.random.default_rng(11)
    if name in (
        "delta_u",
        "delta_v",
        "delta_w",
    ):  # a smooth field over the sheet, as a deformation is
        return np.sin(np.linspace(0, 4, size) + 0.5).astype(np.float32)
    out = rng.normal(size=size).astype(np.float32)
    if name == "rotation":
        out[3] = 0
    return out / np.linalg.norm(out)


@pytest.mark.parametrize("kind", ["smooth", "textured", "self-occluding", "behind", "partly out"])
def test_gradients_against_finite_differences(tmp_path, kind):
    sheet = Sheet(tmp_path, kind)
    rng = np.random.default_rng(5)
    goal = Unknowns.from_numpy(
        {
            **sheet.arrays,
            "translation": sheet.arrays["translation"] + np.array([0.03, -0.02, 0.05], np.float32),
            "delta_alpha": sheet.arrays["delta_alpha"] + (0.03 * rng.normal(size=15)).astype(
                np.float32
            )
        }
    )  # fmt: skip
    target = dr.detach(sheet.image(goal))
    covered = np.array(target)[..., 3]
    assert covered.sum() > 300
    for channels in (slice(0, 3), slice(3, 4)):
        chosen = np.zeros((HEIGHT, WIDTH, 4), np.float32)
        chosen[..., channels] = 1
        chosen = mi.Float(chosen.ravel())

        def loss(unknowns):
            # blurred, so that the loss is smooth where the image has a kink at every pixel that
            # changes sheets
            difference = mi.TensorXf(sheet.image(unknowns).array - target.array, target.shape)
            return dr.sum(chosen * dr.square(objective.blur(difference, 2.0).array))

        unknowns = Unknowns.from_numpy(sheet.arrays)
        for _, value in unknowns.items():
            dr.enable_grad(value)
        dr.backward(loss(unknowns))
        for name in DIRECTIONS:
            direction = direction_of(name, len(sheet.arrays[name]))
            gradient = np.array(dr.grad(getattr(unknowns, name)))
            ad = float(gradient @ direction)
            # the median over steps, for single pixels jump where triangles are seen edge-on
            slopes = [
                (loss(sheet.step(name, direction, h))[0] - loss(sheet.step(name, direction, -h))[0])
                / (2 * h)
                for h in (2.5e-4, 5e-4, 1e-3, 2e-3)
            ]
            fd = float(np.median(slopes))
            # of a direction across the gradient, what its length would give
            assert abs(ad - fd) <= 0.05 * max(
                abs(fd), 0.25 * np.linalg.norm(gradient) * np.linalg.norm(direction), 2.0
            ), f"{kind}, channels {channels}, {name}: AD {ad:.4g}, finite differences {fd:.4g}"


def test_self_occlusion_is_there(tmp_path):
    """The case named so above does show two sheets behind each other."""
    sheet = Sheet(tmp_path, "self-occluding")
    sheet.params[sheet.key] = dr.ravel(sheet.patch.vertices(Unknowns.from_numpy(sheet.arrays)))
    sheet.params.update()
    depth = picture(sheet.scene, aovs="depth")[..., 4]
    jump = np.abs(np.diff(depth, axis=1))[(depth[:, 1:] > 0) & (depth[:, :-1] > 0)]
    assert (jump > 0.03).sum() > 20


@pytest.mark.parametrize("kind", ["smooth", "self-occluding"])
def test_forward_mode_agrees_with_reverse_mode(tmp_path, kind):
    sheet = Sheet(tmp_path, kind)
    weight = mi.Float(np.random.default_rng(2).normal(size=HEIGHT * WIDTH * 4).astype(np.float32))
    for name in DIRECTIONS:
        direction = mi.Float(direction_of(name, len(sheet.arrays[name])))
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
            sheet.params[sheet.key] = dr.ravel(sheet.patch.vertices(unknowns))
            sheet.params.update()
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


def test_a_moved_camera_is_noticed(tmp_path):
    corners = np.array([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0, 0.2, 1.0]])
    scene, integrator = triangles(tmp_path, corners), raster()
    before = np.array(mi.render(scene, integrator=integrator, spp=1))
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("to_world"))
    moved = mi.ScalarTransform4f().look_at(
        origin=[10 * pixel_size(), 0, 0], target=[10 * pixel_size(), 0, 1], up=[0, -1, 0]
    )
    params[key] = mi.Transform4f(moved.matrix)
    params.update()
    after = np.array(mi.render(scene, integrator=integrator, spp=1))
    assert np.abs(after[:, :-10] - before[:, 10:]).max() < 2e-3
    assert np.abs(after - before).max() > 0.5
