"""Arguments of the writers of moving meshes that are refused in one line."""

from dataclasses import replace

import numpy as np
import pytest

from polyfit import InputError
from polyfit.animation import Skeleton, SkinnedMesh, write_frames, write_glb, write_skinned_glb
from polyfit.mesh import TexCoords

V, F = np.eye(3)[None], np.array([[0, 1, 2]])
SKELETON = Skeleton(
    ("root", "arm"), (-1, 0), np.zeros((2, 3)), np.stack([np.eye(4)] * 2), np.zeros((2, 2, 3)),
    np.zeros((2, 3)),
)  # fmt: skip
MESH = SkinnedMesh(
    "cloth", V[0], F, np.zeros((3, 4), int), np.eye(4)[[0, 0, 1]], V, np.zeros((2, 1))
)


@pytest.mark.parametrize(
    ("uv", "message"),
    [
        (TexCoords(np.zeros((3, 2)), F[:0]), r"of faces \(0, 3\); \(M, 2\) and \(1, 3\) of"),
        (TexCoords(np.zeros((2, 2)), F), "name texture coordinates 0 to 2; 0 to 1, or -1, exist"),
        (TexCoords(np.zeros((3, 2)), F + 0.5), r"\(1, 3\) of whole numbers are needed"),
        (TexCoords(np.zeros((3, 3)), F), r"texture coordinates \(3, 3\) of faces"),
    ],
)
def test_texture_coordinates_of_another_mesh(tmp_path, uv, message):
    with pytest.raises(InputError, match=f"^animation: .*{message}"):
        write_glb(tmp_path / "a.glb", V, F, uv)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (dict(labels=[0.5]), "label = 0.5; a whole number, 0 or more"),
        (dict(labels=[-1]), "label = -1; a whole number, 0 or more"),
        (dict(up="x"), "up = 'x'; y or z is needed"),
    ],
)
def test_frames_of_no_number_or_axis(tmp_path, how, message):
    with pytest.raises(InputError, match=f"^animation: {message}"):
        write_frames(tmp_path / "frames", "obj", V, F, **how)
    assert not (tmp_path / "frames").exists()


def test_a_rate_that_is_no_number(tmp_path):
    with pytest.raises(InputError, match="30 frames a second; a positive number"):
        write_glb(tmp_path / "a.glb", V, F, fps="30")


@pytest.mark.parametrize(
    ("skeleton", "mesh", "message"),
    [
        (dict(translation=np.zeros((1, 3))), {}, r"translation \(1, 3\); \(2, 3\) of finite"),
        (dict(rotations=np.full((2, 2, 3), np.nan)), {}, "rotations .* of finite numbers"),
        (dict(rotations=(), translation=np.zeros((0, 3))), {}, "rotations .* of finite numbers"),
        (dict(offsets="no"), {}, "offsets .* of finite numbers"),
        (dict(parents=(-1, -1)), {}, "of one root"),
        (dict(parents=(1, -1)), {}, "that stands before it"),
        (
            {},
            dict(joint_of=np.full((3, 4), 2)),
            "joint_of: 0 to 1, the numbers of joints, are needed",
        ),
        ({}, dict(joint_weights=np.full((3, 4), np.nan)), "joint_weights .* of finite"),
        ({}, dict(joint_weights=np.full((3, 4), 0.5)), "joint_weights: rows that sum to 1"),
        ({}, dict(weights=np.zeros((3, 1))), r"cloth: weights \(3, 1\); \(2, 1\) of finite"),
    ],
)
def test_skinned_meshes_that_do_not_fit(tmp_path, skeleton, mesh, message):
    path = tmp_path / "a.glb"
    write_skinned_glb(path, [MESH], SKELETON)
    path.unlink()
    with pytest.raises(InputError, match=f"^animation: .*{message}"):
        write_skinned_glb(path, [replace(MESH, **mesh)], replace(SKELETON, **skeleton))
    with pytest.raises(InputError, match="up = 'x'; y or z is needed"):
        write_skinned_glb(path, [MESH], SKELETON, up="x")
    assert not path.exists()
