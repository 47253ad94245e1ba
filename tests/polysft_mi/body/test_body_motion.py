"""Files of a body's motion."""

import numpy as np
import pytest

from polysft_mi.body import BodyMotion
from polysft_mi.errors import InputError

FRAMES = 6


@pytest.fixture
def known():
    rng = np.random.default_rng(0)
    return {"poses": rng.normal(size=(FRAMES, 24, 3)), "translation": rng.normal(size=(FRAMES, 3))}


def read(path, selected=range(FRAMES), count=FRAMES, **arrays):
    np.savez(path, **arrays)
    return BodyMotion.read(path, count, list(selected))


def test_forms_say_the_same(known, tmp_path):
    path = tmp_path / "body.npz"
    plain = read(path, **known, fps=25)
    assert plain.fps == 25 and plain.shape is None
    assert np.array_equal(plain.poses, known["poses"])
    flat = read(path, poses=known["poses"].reshape(FRAMES, 72), trans=known["translation"])
    assert np.array_equal(flat.poses, plain.poses) and flat.fps == 30
    assert np.array_equal(flat.translation, plain.translation)


def test_of_the_frames_that_are_used(known, tmp_path):
    path, some = tmp_path / "body.npz", [1, 3, 5]
    of_all = read(path, some, **known, fps=30)
    assert np.array_equal(of_all.poses, known["poses"][some]) and of_all.fps == 15
    own = read(path, some, **{name: x[some] for name, x in known.items()})
    assert np.array_equal(own.translation, of_all.translation)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, r"no poses; poses \(T, 24, 3\) and translation .* has translation"),
        ({"poses": np.zeros((FRAMES, 22, 3))}, r"poses \(6, 22, 3\) and translation \(6, 3\)"),
        ({"translation": np.zeros((FRAMES, 2))}, r"\(6, 2\); poses \(T, 24, 3\) and translation"),
        ({"translation": np.full((FRAMES, 3), np.nan)}, "must be finite numbers"),
        ({"fps": 0}, "fps = 0; a positive number is needed"),
        ({"betas": np.zeros(10)}, "has betas, so its poses are SMPL's; give its body's file too"),
    ],
)
def test_what_cannot_be_used_is_refused(known, tmp_path, change, message):
    arrays = {name: x for name, x in {**known, **change}.items() if x is not None}
    with pytest.raises(InputError, match=message):
        read(tmp_path / "body.npz", **arrays)


def test_of_another_video(known, tmp_path):
    with pytest.raises(InputError, match="6 poses; 9 frames, the video's, are needed"):
        read(tmp_path / "body.npz", range(9), 9, **known)


def test_no_such_file(tmp_path):
    with pytest.raises(InputError, match="no such file of a body's motion"):
        BodyMotion.read(tmp_path / "none.npz", 2, [0, 1])
    (tmp_path / "text.npz").write_text("poses")
    with pytest.raises(InputError, match="not a file of a body's motion"):
        BodyMotion.read(tmp_path / "text.npz", 2, [0, 1])
