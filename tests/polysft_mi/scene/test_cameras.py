"""Further cameras: what their files say, and the sensor that is made of it."""

import json
import re

import numpy as np
import pytest
import synthetic
from scipy.spatial.transform import Rotation

from polysft_mi.errors import InputError
from polysft_mi.render.pinhole import Pinhole
from polysft_mi.scene import register
from polysft_mi.scene.cameras import open_cameras


@pytest.fixture
def folder(tmp_path):
    """One camera, in a folder of cameras."""
    synthetic.cloth(tmp_path / "side", frames=3)
    write(tmp_path)
    return tmp_path


def write(folder, **other):
    where = folder / "side" / "camera.json"
    known = json.loads(where.read_text())
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, 0.8, -0.2]).as_matrix()
    pose[:3, 3] = 0.1, -0.2, 0.5
    known |= {"world_to_camera": pose.tolist(), **other}
    where.write_text(json.dumps({k: v for k, v in known.items() if v is not None}))
    return pose


def test_its_sensor_sees_as_the_file_says(folder):
    register()
    pose = write(folder, fy=150.0)
    (camera,) = open_cameras(str(folder), 3, 0, -1, 1)
    assert camera.name == "side" and len(camera.sequence) == 3
    assert camera.sequence.mask(0) is not None
    points = np.random.default_rng(0).normal(size=(20, 3)) + (0, 0, 3)
    inside = points @ pose[:3, :3].T + pose[:3, 3]
    assert (inside[:, 2] > 0.1).all()
    pixels, before = Pinhole(camera.sensor()).project(points)
    assert before.all()
    assert np.abs(pixels - camera.intrinsics.project(inside)).max() < 1e-2


def test_the_selected_frames_are_used(folder):
    (camera,) = open_cameras(str(folder), 2, 0, 2, 2)
    assert camera.sequence.indices == [0, 2]
    with pytest.raises(InputError, match="3 frames, and the scene's camera has 4"):
        open_cameras(str(folder), 4, 0, -1, 1)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"world_to_camera": None}, "world_to_camera is missing"),
        ({"fx": "wide"}, "not a camera as JSON"),
        ({"world_to_camera": [[1, 0], [0, 1]]}, "is (2, 2); 3 x 4 or 4 x 4"),
        ({"world_to_camera": np.diag([2.0, 2, 2, 1]).tolist()}, "no rotation and translation"),
        ({"world_to_camera": np.diag([1.0, 1, -1, 1]).tolist()}, "no rotation and translation"),
    ],
)
def test_a_bad_file_is_told(other, said, folder):
    write(folder, **other)
    with pytest.raises(InputError, match=re.escape(said)):
        open_cameras(str(folder), 3, 0, -1, 1)


def test_a_folder_without_cameras_is_told(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        open_cameras(str(tmp_path / "none"), 1, 0, -1, 1)
    with pytest.raises(InputError, match="no cameras in it"):
        open_cameras(str(tmp_path), 1, 0, -1, 1)
