"""Pictures of meshes by what can be measured in them: relief from the side; on the stage of drapes
how bright a ball and the floor below it are, and that there is no grain.
"""

import cv2
import numpy as np
import pytest
import surfaces

from polyfit.pictures import SideView, Triangles, stage


def ball(radius=0.5, height=0.7, n=48):
    """Vertices (N, 3) [m] and faces (F, 3) of a closed ball."""
    u, v = np.linspace(0, 2 * np.pi, 2 * n + 1)[:-1], np.linspace(0, np.pi, n + 1)[1:-1]
    u, v = np.meshgrid(u, v)
    rings = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], -1)
    V = np.concatenate([[[0, 0, 1.0]], rings.reshape(-1, 3), [[0, 0, -1.0]]])
    m, k = 2 * n, np.arange(2 * n)
    following = (k + 1) % m
    F = [np.stack([0 * k, 1 + k, 1 + following], 1)]
    for r in range(n - 2):
        a, b = 1 + r * m + k, 1 + r * m + following
        F += [np.stack([a, a + m, b + m], 1), np.stack([a, b + m, b], 1)]
    a, b = 1 + (n - 2) * m + k, 1 + (n - 2) * m + following
    F.append(np.stack([a, np.full_like(k, len(V) - 1), b], 1))
    return radius * V + [0, 0, height], np.concatenate(F)


COLOUR = (0.4, 0.2, 0.1)


@pytest.fixture(scope="module")
def picture():
    V, F = ball()
    (image,) = stage.render([(V[None], F, COLOUR)], size=(96, 96), spp=16)
    return image


def linear(image):
    x = image / 255
    return np.where(x < 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_the_open_top_of_a_ball_has_the_sky_and_the_key_light(picture):
    """An upward face sees all of the sky and, nearly, all of the key light."""
    V, F = ball()
    lit = stage.Stage(V.astype(np.float32), F, np.tile(COLOUR, (len(V), 1)), 0.0)
    lit.move(V.astype(np.float32))
    lit.light(np.array([0, 0, 0.7]))
    front = np.array(lit.front)
    assert front[:, 0] == pytest.approx(stage.SKY, rel=0.02)  # the highest vertex
    assert front[:, -1].max() < 0.5 * stage.SKY.max()  # the lowest sees the floor alone
    shadow = np.array(lit.shadow)
    assert shadow[0] == 1 and shadow[-1] == 0
    up = lit.sun.mean(1)[2]
    ground = np.array(lit.ground.tensor())
    middle = ground[len(ground) // 2, len(ground) // 2]
    assert (middle < 0.6 * lit.open).all()  # under the ball
    assert ground[0, -1] == pytest.approx(stage.FLOOR * (stage.SKY + stage.KEY * up), rel=0.1)


def test_a_rim_that_lies_on_skin_does_not_darken_it():
    """The skin 3 mm beside a cap, 6 mm above it, has the light of skin without a cap, nearly."""
    skin, faces = ball(n=128)
    cap, over = ball(0.506, n=88)
    rim = 17 * np.pi / 88
    over = over[(cap[over, 2] > 0.7 + 0.506 * np.cos(rim + 0.01)).all(1)]
    V = np.concatenate([skin, cap]).astype(np.float32)
    part = np.repeat([0, 1], [len(skin), len(cap)])
    found = []
    for F in (faces, np.concatenate([faces, over + len(skin)])):
        lit = stage.Stage(V, F, np.tile(COLOUR, (len(V), 1)), 0.0, 0.0, part)
        lit.move(V)
        lit.light(np.array([0, 0, 0.7]))
        found.append(np.array(lit.front)[:, : len(skin)])
    polar = np.arccos(np.clip((skin[:, 2] - 0.7) / 0.5, -1, 1))
    beside = np.abs(polar - 25 * np.pi / 128) < 0.01
    assert beside.sum() == 256
    assert found[1][:, beside] == pytest.approx(found[0][:, beside], rel=0.1)


def test_the_picture_has_the_balls_colour_and_no_grain(picture):
    x = linear(picture.astype(float))
    middle = x[40:56, 40:56]
    assert middle.mean((0, 1)) / middle.mean() == pytest.approx(
        np.array(COLOUR) / np.mean(COLOUR), rel=0.12
    )
    # neighbouring pixels of a smooth ball differ by its shading alone, a plane in so small a window
    plane = middle[..., 0] - middle[..., 0].mean()
    v, u = np.mgrid[:16, :16]
    A = np.stack([(u**i * v**j).ravel() for i in range(3) for j in range(3 - i)], 1)
    rest = plane.ravel() - A @ np.linalg.lstsq(A, plane.ravel(), rcond=None)[0]
    assert np.abs(rest).max() < 0.02 * middle[..., 0].mean()


def test_the_camera_keeps_what_moves_in_the_picture():
    V, F = ball(0.3)
    moving = np.stack([V, V + [1.5, 0, 0]])
    blue = [(moving, F, (0.0, 0.0, 0.6))]
    seen = lambda image: np.argwhere(image[..., 2].astype(int) - image[..., 0] > 60)
    fixed = [seen(i) for i in stage.render(blue, size=(60, 80), spp=4)]
    followed = [seen(i) for i in stage.render(blue, size=(60, 80), spp=4, follow=True)]
    for where in fixed + followed:
        assert len(where) and where.min() > 0 and (where.max(0) < [59, 79]).all()
    assert abs(fixed[1][:, 1].mean() - fixed[0][:, 1].mean()) > 20
    assert np.abs(followed[1].mean(0) - followed[0].mean(0)).max() < 1


def test_a_coarse_mesh_is_drawn_through_its_vertices():
    V, F = surfaces.sphere(radius=0.05, subdivisions=1)  # the middles of edges are at 0.0476
    (finer,), faces, _ = stage._smooth(V[None], F, COLOUR)
    assert len(faces) == 4 * len(F) and np.abs(finer[: len(V)] - V).max() < 0.001
    radius = np.linalg.norm(finer, axis=1)
    assert radius.min() > 0.049 and radius.max() < 0.051


BACKGROUND = (243, 243, 243)


def sheet(depth=lambda x, y: 0 * x):
    V, F = surfaces.sheet(depth, 0.1, 21)
    return V + (0, 0, 0.6), F[:, ::-1]


def covered(image):
    return (np.abs(image.astype(int) - BACKGROUND).max(-1) > 12).mean()


def test_shaded_sheet_covers_its_area_and_is_even():
    V, F = sheet()
    front = SideView(np.eye(3), np.array([0, 0, 0.6]), 0.15)
    image = Triangles(V, F).shaded(front, size=(180, 120))
    assert image.shape == (120, 180, 3) and image.dtype == np.uint8
    assert covered(image) == pytest.approx((0.2 / 0.3 * 120) ** 2 / (180 * 120), rel=0.02)
    assert np.ptp(image[30:90, 60:120].reshape(-1, 3), axis=0).max() <= 1
    assert tuple(image[2, 2]) == BACKGROUND
    back = Triangles(V, F[:, ::-1]).shaded(front, size=(180, 120))
    assert (
        back[60, 90, 2] > back[60, 90, 0] and image[60, 90, 0] > image[60, 90, 2]
    )  # cool and warm
    assert back[60, 90].max() > 150 and image[60, 90].max() > 150  # and both lit


def test_relief_shows_by_shading():
    V, F = sheet(lambda x, y: 0.02 * np.sin(60 * x))
    front = SideView(np.eye(3), np.array([0, 0, 0.6]), 0.15)
    image = Triangles(V, F).shaded(front, size=(120, 120)).astype(int)
    assert np.ptp(image[60, 25:95, 0]) > 40  # across the waves
    assert np.ptp(image[25:95, 60, 0]) <= 2  # along them


def test_the_nearer_surface_hides_the_other():
    V, F = sheet()
    both, faces = (
        np.concatenate([V, 0.5 * V + (0, 0, 0.1)]),
        np.concatenate([F, (F + len(V))[:, ::-1]]),
    )
    front = SideView(np.eye(3), np.array([0, 0, 0.6]), 0.15)
    for order in (faces, faces[::-1]):
        image = Triangles(both, order).shaded(front, size=(120, 120)).astype(int)
        assert image[60, 60, 2] > image[60, 60, 0]  # the small one in front, from behind
        assert image[28, 60, 0] > image[28, 60, 2]


def test_views_around_keep_the_surface_in_the_picture():
    V, F = sheet(lambda x, y: 0.05 * np.cos(20 * x))
    for azimuth, elevation in [(0, 0), (40, 25), (-70, -30), (180, 10)]:
        view = SideView.around(V, azimuth, elevation)
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) == pytest.approx(1)
        image = Triangles(V, F).shaded(view, size=(90, 90))
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert (border == BACKGROUND).all() and covered(image) > 0.1
        background = np.all(image == BACKGROUND, axis=-1).astype(np.uint8)
        assert cv2.connectedComponents(background)[0] == 2  # no holes between triangles
    right = SideView.around(V, 40, 0).rotation
    assert (right @ (1, 0, 0))[2] < 0  # seen from the right, the right side is the nearer one
    above = SideView.around(V, 0, 25).rotation
    assert (above @ (0, -1, 0))[2] < 0  # and from above the upper one


def test_grid_and_degenerate_triangles():
    V, F = sheet()
    front = SideView(np.eye(3), np.array([0, 0, 0.6]), 0.11)
    plain = Triangles(V, F).shaded(front, size=(200, 200)).astype(int)
    faces = np.concatenate([F, [[0, 0, 1], [0, 1, 2]]])
    lines = Triangles(V, faces).shaded(front, uv=V[faces, :2], size=(200, 200)).astype(int)
    dark = (plain - lines)[..., 0] > 10
    assert 0.05 < dark.mean() < 0.4
