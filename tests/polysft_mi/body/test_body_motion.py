"""Files of a body's motion."""

import numpy as np
import pytest

from polyfit.mesh import write_ply
from polysft_mi.body import BodyMotion, MeshMotion, read_motion
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
        ({"fps": "thirty"}, "fps = thirty; a positive number is needed"),
        ({"fps": np.zeros(0)}, r"fps = \[\]; a positive number is needed"),
        ({"betas": np.zeros(10)}, "has betas, so its poses are SMPL's; give its body's file too"),
        ({"shape": np.zeros(10)}, r"shape \(10,\); gender, age, .* are needed, each from 0 to 1"),
        ({"shape": np.full(6, np.nan)}, r"body.npz: shape \[nan, .* each from 0 to 1"),
    ],
)
def test_what_cannot_be_used_is_refused(known, tmp_path, change, message):
    arrays = {name: x for name, x in {**known, **change}.items() if x is not None}
    with pytest.raises(InputError, match=message):
        read(tmp_path / "body.npz", **arrays)


def test_a_body_that_does_not_stand_is_told(tmp_path):
    """Its root turned as in a world with -y up, as SMPL's programs write it for a level camera."""
    poses = np.zeros((FRAMES, 24, 3))
    poses[:, 0] = np.pi / 2, 0, 0
    np.savez(tmp_path / "body.npz", poses=poses, translation=np.zeros((FRAMES, 3)))
    read = lambda up: BodyMotion.read(tmp_path / "body.npz", FRAMES, range(FRAMES), up=up)
    assert not read("-y").note
    for up in ("z", "y"):
        assert f"with {up} up the body lies" in read(up).note and "--body-up -y" in read(up).note


def test_of_another_video(known, tmp_path):
    with pytest.raises(InputError, match="6 poses; 9 frames, the video's, are needed"):
        read(tmp_path / "body.npz", range(9), 9, **known)


def test_no_such_file(tmp_path):
    with pytest.raises(InputError, match="no such file of a body's motion"):
        BodyMotion.read(tmp_path / "none.npz", 2, [0, 1])
    (tmp_path / "text.npz").write_text("poses")
    with pytest.raises(InputError, match="not a file of a body's motion"):
        BodyMotion.read(tmp_path / "text.npz", 2, [0, 1])


def test_a_damaged_file_and_an_array_alone_are_refused(known, tmp_path):
    np.savez_compressed(tmp_path / "deflated.npz", **known)
    whole = (tmp_path / "deflated.npz").read_bytes()
    (tmp_path / "deflated.npz").write_bytes(whole[:70] + b"\xff" * 250 + whole[320:])
    with open(tmp_path / "one.npz", "wb") as file:
        np.save(file, known["poses"])
    for name in ("deflated.npz", "one.npz"):
        with pytest.raises(InputError, match=f"{name}: not a file of a body's motion"):
            read_motion(tmp_path / name, FRAMES, list(range(FRAMES)))


@pytest.fixture
def meshes():
    rng = np.random.default_rng(1)
    return {"vertices": rng.normal(size=(FRAMES, 5, 3)), "faces": np.array([[0, 1, 2], [2, 3, 4]])}


def read_meshes(path, selected=range(FRAMES), count=FRAMES, **how):
    return read_motion(path, count, list(selected), **how)


def test_meshes_in_a_file_and_in_a_folder_say_the_same(meshes, tmp_path):
    rest = meshes["vertices"][0] + 1
    np.savez(tmp_path / "body.npz", **meshes, rest=rest, fps=24)
    (tmp_path / "body").mkdir()
    for name, mesh in [
        ("rest", rest),
        *((f"{k:03d}", x) for k, x in enumerate(meshes["vertices"])),
    ]:
        write_ply(tmp_path / "body" / f"{name}.ply", mesh, meshes["faces"])
    of_file, of_folder = (read_meshes(tmp_path / name) for name in ("body.npz", "body"))
    assert isinstance(of_file, MeshMotion) and (of_file.fps, of_folder.fps) == (24, 30)
    for name in ("rest", "faces", "frames"):
        assert np.allclose(getattr(of_file, name), getattr(of_folder, name), atol=1e-6)
    some = read_meshes(tmp_path / "body.npz", [1, 3, 5], up="y")
    assert np.array_equal(some.frames, of_file.frames[1::2]) and some.fps == 12
    assert some.upright.apply([0, 1, 0]) == pytest.approx([0, 0, 1])
    np.savez(tmp_path / "bare.npz", **meshes)
    assert np.array_equal(read_meshes(tmp_path / "bare.npz").rest, meshes["vertices"][0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"vertices": None},
            r"vertices \(T, V, 3\) and faces \(F, 3\) are needed, and .* has faces",
        ),
        ({"vertices": np.zeros((FRAMES, 15))}, r"vertices \(6, 15\) and faces \(2, 3\)"),
        ({"rest": np.zeros((4, 3))}, r"rest \(4, 3\); \(5, 3\), as in each frame, is needed"),
        ({"rest": np.full((5, 3), np.nan)}, "must be finite numbers"),
        ({"faces": np.array([[0, 1, 5]])}, "whole numbers from 0 to 4"),
        ({"faces": np.zeros((0, 3), int)}, "whole numbers from 0 to 4"),
        ({"fps": -1}, "fps = -1; a positive number is needed"),
        ({"rest": 100 * np.eye(5, 3)}, "body.npz: a body of 100 m; metres are needed, not cm"),
        ({"vertices": np.zeros((4, 5, 3))}, "4 meshes; 6 frames, the video's, are needed"),
    ],
)
def test_meshes_that_cannot_be_used_are_refused(meshes, tmp_path, change, message):
    arrays = {name: x for name, x in {**meshes, **change}.items() if x is not None}
    np.savez(tmp_path / "body.npz", **arrays)
    with pytest.raises(InputError, match=message):
        read_meshes(tmp_path / "body.npz")


def test_folders_that_cannot_be_used_are_refused(meshes, tmp_path):
    with pytest.raises(InputError, match="no meshes"):
        read_meshes(tmp_path)
    for k, faces in enumerate([meshes["faces"], meshes["faces"][:1]]):
        write_ply(tmp_path / f"{k}.ply", meshes["vertices"][k], faces)
    with pytest.raises(InputError, match="1.ply: other faces than 0.ply"):
        read_meshes(tmp_path)
    with pytest.raises(InputError, match="is of meshes; SMPL.pkl is for poses alone"):
        read_meshes(tmp_path, model="SMPL.pkl")
