"""The sheet: its size in words, its pose in a frame, and what is said of a bent one."""

import numpy as np
import pytest
from clips import CAMERA, HEIGHT, WIDTH, placed, refused

from polysft_mi.capture.sheet import Matches, from_matches, from_obj, grid, parse_size
from polysft_mi.capture.sheet.placing import MAX_FLAT_RESIDUAL
from polysft_mi.surface import meshio


@pytest.mark.parametrize(
    "words, size",
    [
        (["0.297", "0.210"], (0.297, 0.21)),
        (["297mm", "210mm"], (0.297, 0.21)),
        (["297", "210mm"], (0.297, 0.21)),
        (["29.7cm", "21cm"], (0.297, 0.21)),
        (["297x210mm"], (0.297, 0.21)),
        (["A4"], (0.297, 0.21)),
        (["a3"], (0.42, 0.297)),
        (["11in", "8.5in"], (0.2794, 0.2159)),
        (["30cm"], (0.3, 0.3)),
        (["2", "1.5"], (2, 1.5)),
    ],
)
def test_sizes(words, size):
    assert parse_size(words, 1.4) == pytest.approx(size)


def test_size_of_a_standing_sheet():
    assert parse_size(["A4"], 0.7) == pytest.approx((0.21, 0.297))


@pytest.mark.parametrize(
    "words, said",
    [
        (["297", "210"], "297mm 210mm"),
        (["29.7", "21"], "29.7cm 21cm"),
        (["11", "8.5"], "11in 8.5in"),
        (["297m", "210m"], "20 m"),
        (["0.1mm", "1m"], "5 mm"),
        (["0", "1"], "positive"),
        (["-1", "1"], "not a length"),
        (["A9"], "not a length"),
        (["1", "2", "3"], "3 lengths"),
        (["297px", "210px"], "'297px'"),
        (["nan", "1"], "not a length"),
        (["inf"], "not a length"),
    ],
)
def test_sizes_that_no_sheet_has(words, said):
    assert said in refused(parse_size, words)


def test_fewer_than_four_matches():
    made = Matches(np.random.default_rng(0).random((3, 2)), np.zeros((3, 2)), np.zeros(3, bool))
    found, after = from_matches(made, grid(WIDTH, HEIGHT, 5), CAMERA)
    assert found is None and not after.agree.any()


def test_bent_first_frame_is_said(tmp_path):
    """Matches of a sheet that is a cylinder, against the flat one."""
    flat = grid(WIDTH, HEIGHT, 33)
    x = flat.vertices[:, 0]
    lines = []
    for _k, curvature in enumerate((0.3, 5.0)):  # 1/m
        bent = np.column_stack(
            [
                np.sin(curvature * x) / curvature,
                flat.vertices[:, 1],
                (1 - np.cos(curvature * x)) / curvature,
            ]
        )
        R, t = placed()
        pixels = CAMERA.project(bent @ R.T + t)
        found, after = from_matches(
            Matches(flat.uv.clip(1e-6, 1 - 1e-6), pixels, np.zeros(len(x), bool)), flat, CAMERA
        )
        missed = np.sqrt((found.residual**2).mean()) / np.hypot(320, 240)
        lines.append(missed > MAX_FLAT_RESIDUAL)
        assert after.agree.sum() >= 10
    assert lines == [False, True]


def test_a_template_of_ones_own_is_centred_and_its_tile_is_the_photo(tmp_path):
    """Far out, as on a map, and with texture coordinates in another tile: the same sheet."""
    flat, path = grid(WIDTH, HEIGHT, 12), tmp_path / "a.obj"

    def written(vertices, uv):
        rows = ["v {:.9f} {:.9f} {:.9f}".format(*p) for p in vertices]
        rows += ["vt {} {}".format(*t) for t in uv]
        rows += ["f {0}/{0} {1}/{1} {2}/{2}".format(*f) for f in flat.faces + 1]
        path.write_text("\n".join(rows))
        return path

    far = from_obj(written(flat.vertices + [5e5, 4e6, 100], flat.uv + [2, -1]))
    np.testing.assert_allclose(far.vertices, flat.vertices, atol=1e-8)
    np.testing.assert_allclose(far.uv, flat.uv, atol=1e-9)
    meshio.write_obj(tmp_path / "b.obj", *far.mesh(far.vertices))
    back = from_obj(tmp_path / "b.obj")
    np.testing.assert_allclose(back.vertices, flat.vertices, atol=1e-8)
    said = refused(from_obj, written(flat.vertices, flat.uv * [2, 1]))
    assert "a.obj: texture coordinates from 0 to 2 and 0 to 1; the image fills 0 to 1" in said
