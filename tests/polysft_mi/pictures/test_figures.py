"""Pictures by what can be measured in them, and that a run outlives a picture that fails."""

import os

import cv2
import numpy as np
import pytest
from processes import python

from polysft_mi.pictures import figures
from polysft_mi.pictures.figures import View, contact_sheet, frame_plot, loss_plot, shade_surface

BACKGROUND = (243, 243, 243)


def sheet(depth=lambda x, y: 0 * x, n=21):
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, n), np.linspace(-0.1, 0.1, n))
    V = np.stack([x, y, 0.6 + depth(x, y)], -1).reshape(-1, 3)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (i.ravel() for i in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    F = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return V, F


def covered(image):
    return (np.abs(image.astype(int) - BACKGROUND).max(-1) > 12).mean()


def test_shaded_sheet_covers_its_area_and_is_even():
    V, F = sheet()
    front = View(np.eye(3), np.array([0, 0, 0.6]), 0.15)
    image = shade_surface(V, F, front, size=(180, 120))
    assert image.shape == (120, 180, 3) and image.dtype == np.uint8
    assert covered(image) == pytest.approx((0.2 / 0.3 * 120) ** 2 / (180 * 120), rel=0.02)
    assert np.ptp(image[30:90, 60:120].reshape(-1, 3), axis=0).max() <= 1
    assert tuple(image[2, 2]) == BACKGROUND
    back = shade_surface(V, F[:, ::-1], front, size=(180, 120))
    assert (
        back[60, 90, 2] > back[60, 90, 0] and image[60, 90, 0] > image[60, 90, 2]
    )  # cool and warm
    assert back[60, 90].max() > 150 and image[60, 90].max() > 150  # and both lit


def test_relief_shows_by_shading():
    V, F = sheet(lambda x, y: 0.02 * np.sin(60 * x))
    image = shade_surface(
        V, F, View(np.eye(3), np.array([0, 0, 0.6]), 0.15), size=(120, 120)
    ).astype(int)
    assert np.ptp(image[60, 25:95, 0]) > 40  # across the waves
    assert np.ptp(image[25:95, 60, 0]) <= 2  # along them


def test_the_nearer_surface_hides_the_other():
    V, F = sheet()
    both, faces = (
        np.concatenate([V, 0.5 * V + (0, 0, 0.1)]),
        np.concatenate([F, (F + len(V))[:, ::-1]]),
    )
    front = View(np.eye(3), np.array([0, 0, 0.6]), 0.15)
    for order in (faces, faces[::-1]):
        image = shade_surface(both, order, front, size=(120, 120)).astype(int)
        assert image[60, 60, 2] > image[60, 60, 0]  # the small one in front, from behind
        assert image[28, 60, 0] > image[28, 60, 2]


def test_views_around_keep_the_surface_in_the_picture():
    V, F = sheet(lambda x, y: 0.05 * np.cos(20 * x))
    for azimuth, elevation in [(0, 0), (40, 25), (-70, -30), (180, 10)]:
        view = View.around(V, azimuth, elevation)
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) == pytest.approx(1)
        image = shade_surface(V, F, view, size=(90, 90))
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert (border == BACKGROUND).all() and covered(image) > 0.1
        background = np.all(image == BACKGROUND, axis=-1).astype(np.uint8)
        assert cv2.connectedComponents(background)[0] == 2  # no holes between triangles
    right = View.around(V, 40, 0).rotation
    assert (right @ (1, 0, 0))[2] < 0  # seen from the right, the right side is the nearer one
    above = View.around(V, 0, 25).rotation
    assert (above @ (0, -1, 0))[2] < 0  # and from above the upper one


def test_grid_and_degenerate_triangles():
    V, F = sheet()
    front = View(np.eye(3), np.array([0, 0, 0.6]), 0.11)
    plain = shade_surface(V, F, front, size=(200, 200)).astype(int)
    faces = np.concatenate([F, [[0, 0, 1], [0, 1, 2]]])
    lines = shade_surface(V, faces, front, uv=V[faces, :2], size=(200, 200)).astype(int)
    dark = (plain - lines)[..., 0] > 10
    assert 0.05 < dark.mean() < 0.4
    assert shade_surface(V + (0, 0, 0), F[:0], front, size=(20, 20)).min() == 243


def image_of(path):
    image = cv2.imread(str(path))
    assert image is not None
    return image


RECORDS = [
    {
        "frame": f,
        "iteration": i,
        "loss": 0.1 / (1 + i),
        "rgb": 0.08 / (1 + i),
        "silhouette": 0.0,
        "inextensibility": 1e-3,
        "temporal": None,
    }
    for f in range(3)
    for i in range(0, 50, 5)
]


def test_loss_plot_shows_terms_and_survives_bad_values(tmp_path):
    assert loss_plot(tmp_path / "loss.png", RECORDS) == str(tmp_path / "loss.png")
    rgb = np.array([0x2E, 0x57, 0xC4])  # B, G, R of the photometric curve
    assert (np.abs(image_of(tmp_path / "loss.png").astype(int) - rgb).max(-1) < 30).sum() > 100
    odd = (
        [{"event": "start"}]
        + RECORDS
        + [{"frame": 3, "iteration": 0, "loss": float("nan")}, {"frame": 4, "loss": float("inf")}]
    )
    assert loss_plot(tmp_path / "odd.png", odd) is not None
    assert loss_plot(tmp_path / "one.png", RECORDS[:1]) is not None
    assert sorted(os.listdir(tmp_path)) == ["loss.png", "odd.png", "one.png"]


def test_records_now_and_then_keep_their_place():
    assert figures._advance(None, RECORDS[0]) == 1
    assert figures._advance(RECORDS[0], RECORDS[1]) == 5
    assert figures._advance(RECORDS[9], RECORDS[10]) == 1


def test_frame_plot_has_a_panel_a_figure(tmp_path):
    per_frame = {"frame": [0, 2, 4], "e3d": [0.01, 0.02, 0.01], "en_deg": [5.0, float("inf"), 7.0]}
    assert frame_plot(tmp_path / "two.png", per_frame)
    assert frame_plot(tmp_path / "one.png", {k: per_frame[k] for k in ("frame", "e3d")})
    assert image_of(tmp_path / "two.png").shape[0] > 1.6 * image_of(tmp_path / "one.png").shape[0]


def test_contact_sheet_holds_its_pictures(tmp_path):
    h, w = 60, 80
    red, green = np.zeros((h, w, 3), np.uint8), np.zeros((h, w, 3))
    red[..., 0], green[..., 1] = 255, 1.0
    error = np.full((h, w), np.nan)
    error[:30] = 0.2
    rows = [
        {"label": f"frame {k}", "target": red, "render": green, "error": error, "surface": red}
        for k in range(3)
    ]
    rows[1]["render"] = None
    assert contact_sheet(tmp_path / "sheet.png", rows, "where it was taken " * 20)
    image = image_of(tmp_path / "sheet.png").astype(int)
    count = lambda bgr: (np.abs(image - bgr).max(-1) < 20).sum()
    assert count((0, 0, 255)) / count((0, 255, 0)) == pytest.approx(6 / 2, rel=0.1)


def test_a_picture_that_fails_is_a_warning(tmp_path, monkeypatch):
    with pytest.warns(RuntimeWarning, match="loss.png: picture not written"):
        assert loss_plot(tmp_path / "loss.png", []) is None
    with pytest.warns(RuntimeWarning, match="not written"):
        assert frame_plot(tmp_path / "nowhere" / "a.png", {"frame": [0], "e3d": [1]}) is None
    with pytest.warns(RuntimeWarning, match="not written"):
        assert contact_sheet(tmp_path / "a.png", []) is None
    assert os.listdir(tmp_path) == []


def test_importing_loads_no_heavy_module():
    script = (
        "import sys, polysft_mi.pictures.figures, polysft_mi.results.metrics,"
        " polysft_mi.evaluate, polysft_mi.pictures.exr, polysft_mi.pictures.video,"
        " polysft_mi.surface.meshio\nprint([m for m in ('matplotlib', 'OpenEXR',"
        " 'trimesh', 'skimage', 'scipy', 'rich', 'mitsuba', 'torch', 'cv2') if m in sys.modules])"
    )
    done = python("-c", script)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
