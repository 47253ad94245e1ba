"""Pictures by what can be measured in them, and that a run outlives a picture that fails."""

import os

import cv2
import numpy as np
import pytest

from polysft_mi.pictures.figures import contact_sheet, frame_plot, loss_curves, loss_plot


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
    _, step, _ = loss_curves(RECORDS[:3] + RECORDS[10:12])
    assert step.tolist() == [1, 6, 11, 12, 17]  # records now and then keep their place
    assert sorted(os.listdir(tmp_path)) == ["loss.png", "odd.png", "one.png"]


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


def test_a_picture_that_fails_is_a_warning(tmp_path):
    with pytest.warns(RuntimeWarning, match="loss.png: picture not written"):
        assert loss_plot(tmp_path / "loss.png", []) is None
    with pytest.warns(RuntimeWarning, match="not written"):
        assert frame_plot(tmp_path / "nowhere" / "a.png", {"frame": [0], "e3d": [1]}) is None
    with pytest.warns(RuntimeWarning, match="not written"):
        assert contact_sheet(tmp_path / "a.png", []) is None
    assert os.listdir(tmp_path) == []
