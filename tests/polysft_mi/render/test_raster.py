"""The raster integrator's image, against geometry and other integrators; its options."""

import mitsuba as mi
import numpy as np
import pytest
from raster_scenes import (
    HEIGHT,
    UNLIT_MESH,
    WIDTH,
    picture,
    pixel_size,
    raster,
    sensor,
    triangles,
    write_mesh,
)

from polysft_mi.errors import InputError
from polysft_mi.scene import plugins


@pytest.fixture(autouse=True)
def registered():
    plugins.register()


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
