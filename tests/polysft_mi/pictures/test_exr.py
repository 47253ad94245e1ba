"""Multi-layer EXR files read back, by OpenEXR and by an independent reader."""

import json
import os

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from polysft_mi.pictures.exr import read_exr, write_exr


@pytest.fixture
def layers():
    rng = np.random.default_rng(0)
    h, w = 18, 23
    depth = rng.uniform(0.5, 0.7, (h, w))
    depth[:4] = np.inf
    return {
        "target": rng.random((h, w, 3)),
        "render": rng.random((h, w, 3)),
        "error": rng.random((h, w)),
        "mask_target": rng.integers(0, 2, (h, w)).astype(float),
        "mask_render": rng.random((h, w, 1)),
        "depth": depth,
        "normal": rng.normal(size=(h, w, 3)),
        "uv": rng.random((h, w, 2)),
    }


NAMES = (
    "target.R target.G target.B render.R render.G render.B R G B error.Y mask_target.Y"
    " mask_render.Y depth.Z"
)
NAMES = set(NAMES.split()) | {"normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V"}


def test_values_names_types_and_header(tmp_path, layers):
    path = tmp_path / "000.exr"
    write_exr(
        path,
        layers,
        {"frame": np.int64(12), "loss": 0.25, "software": "polysft-mi", "weights": [1, 0.1]},
    )
    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = {k: c.pixels for k, c in file.channels().items()}
        header = dict(file.header())
    assert set(planes) == NAMES
    for layer, suffixes in {
        "target": "RGB",
        "error": "Y",
        "mask_target": "Y",
        "mask_render": "Y",
    }.items():
        for k, s in enumerate(suffixes):
            plane = planes[f"{layer}.{s}"]
            assert plane.dtype == np.float16
            np.testing.assert_allclose(plane, np.atleast_3d(layers[layer])[..., k], atol=5e-4)
    for layer, suffixes in {"depth": "Z", "normal": "XYZ", "uv": "UV"}.items():
        for k, s in enumerate(suffixes):
            plane = planes[f"{layer}.{s}"]
            assert plane.dtype == np.float32
            np.testing.assert_array_equal(plane, np.float32(np.atleast_3d(layers[layer])[..., k]))
    for s in "RGB":
        np.testing.assert_array_equal(planes[s], planes[f"render.{s}"])
    assert header["frame"] == 12 and header["loss"] == 0.25 and header["software"] == "polysft-mi"
    assert json.loads(header["weights"]) == [1, 0.1]
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    np.testing.assert_allclose(
        header["chromaticities"], (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290), rtol=1e-6
    )
    assert os.listdir(tmp_path) == ["000.exr"]


def test_read_exr_gives_the_layers_back(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers, {"frame": 1})
    back, header = read_exr(tmp_path / "a.exr")
    assert set(back) == set(layers) and header["frame"] == 1
    for name, image in layers.items():
        np.testing.assert_allclose(back[name], np.atleast_3d(image), atol=1e-3)


def test_large_colours_stay_finite(tmp_path):
    image = np.full((4, 4, 3), 1e6)
    write_exr(tmp_path / "a.exr", {"render": image})
    assert np.isfinite(read_exr(tmp_path / "a.exr")[0]["render"]).all()


def test_mitsuba_reads_the_layers(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers)
    seen = {name: np.array(image) for name, image in mi.Bitmap(str(tmp_path / "a.exr")).split()}
    np.testing.assert_allclose(seen.pop("<root>"), layers["render"], atol=1e-3)
    assert set(seen) == set(layers)
    for name, image in layers.items():
        np.testing.assert_allclose(np.atleast_3d(seen[name]), np.atleast_3d(image), atol=1e-3)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({}, "at least one"),
        ({"render": np.zeros((4, 4, 3)), "error": np.zeros((4, 5))}, "error has shape"),
        ({"render": np.zeros((4, 4, 2))}, "render has 2 channels"),
        ({"depth": np.zeros((4, 4, 3))}, "depth has 3 channels; 1"),
        ({"render": np.zeros((0, 4, 3))}, "shape"),
    ],
)
def test_refuses_layers_that_make_no_image(tmp_path, wrong, words):
    with pytest.raises(ValueError, match=words):
        write_exr(tmp_path / "a.exr", wrong)
    assert os.listdir(tmp_path) == []


def test_what_cannot_be_written_or_read_is_an_oserror_that_names_the_file(tmp_path, layers):
    with pytest.raises(OSError) as error:
        write_exr(tmp_path / "nowhere" / "a.exr", layers)
    assert error.value.filename.endswith("a.exr")
    (tmp_path / "b.exr").write_bytes(b"no image")
    with pytest.raises(OSError) as error:
        read_exr(tmp_path / "b.exr")
    assert error.value.filename.endswith("b.exr")


def test_an_interrupted_write_keeps_what_was_there(tmp_path, layers, monkeypatch):
    path = tmp_path / "a.exr"
    write_exr(path, {"render": layers["render"]})
    before = path.read_bytes()

    def interrupted(self, name):
        with open(name, "wb") as file:
            file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(OpenEXR.File, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_exr(path, layers)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.exr"]
