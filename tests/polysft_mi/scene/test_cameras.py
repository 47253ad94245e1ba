"""Further cameras: what their files say, and the sensor that is made of it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import synthetic
from loading import loaded
from scipy.spatial.transform import Rotation

from polysft_mi.camera import Intrinsics
from polysft_mi.capture import prepare_folder
from polysft_mi.capture.camera.rigs import read_rig
from polysft_mi.errors import InputError
from polysft_mi.render.pinhole import Pinhole
from polysft_mi.scene import read_cameras, register, written
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


def test_a_byte_order_mark_does_not_matter(folder):
    where = folder / "side" / "camera.json"
    where.write_text(where.read_text(), encoding="utf-8-sig")
    (camera,) = open_cameras(str(folder), 3, 0, -1, 1)
    assert camera.intrinsics == Intrinsics.from_json(where)


def test_the_selected_frames_are_used(folder):
    (camera,) = open_cameras(str(folder), 3, 0, 2, 2)
    assert camera.sequence.indices == [0, 2]
    with pytest.raises(InputError, match="3 frames, and the scene's camera has 4"):
        open_cameras(str(folder), 4, 0, -1, 1)
    with pytest.raises(InputError, match="3 frames, and the scene's camera has 4"):
        open_cameras(str(folder), 4, 0, -1, 2)  # two frames of each, of other moments


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"world_to_camera": None}, "world_to_camera is missing"),
        ({"fx": "wide"}, "not a camera as JSON"),
        ({"fx": 1e300}, "= (1e+300, "),
        ({"fx": 10**400}, "not a camera as JSON"),
        ({"height": 1e300}, "image size 96x1e+300"),
        ({"world_to_camera": np.c_[np.eye(3), np.full(3, 1e300)].tolist()}, "none beyond 1e+09"),
        ({"world_to_camera": [[1, 0], [0, 1]]}, "is (2, 2); 3 x 4 or 4 x 4"),
        ({"world_to_camera": np.diag([2.0, 2, 2, 1]).tolist()}, "no rotation and translation"),
        ({"world_to_camera": np.diag([1.0, 1, -1, 1]).tolist()}, "no rotation and translation"),
        ({"world_to_camera": np.diag([1.0, 1, 1, 2]).tolist()}, "camera: its last row is [0.0, 0"),
        ({"fx": -100.0}, "side/camera.json: camera: (fx, fy, cx, cy) = (-100.0,"),
    ],
)
def test_a_bad_file_is_told(other, said, folder):
    write(folder, **other)
    with pytest.raises(InputError, match=re.escape(said)):
        open_cameras(str(folder), 3, 0, -1, 1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda known: [known], "not a JSON object; fx, fy"),
        (lambda known: known.pop("cx") and known, "no cx; fx, fy"),
        (lambda known: known | {"fx": None}, "fx = None; a number is needed"),
        (lambda known: known | {"fy": 1e300}, "1e+300, "),
        (lambda known: known | {"fx": 10**400}, "fx = 1000"),
        (lambda known: known | {"height": 1e999}, "height = inf; a whole number is needed"),
        (lambda known: known | {"width": 3.7}, "width = 3.7; a whole number is needed"),
        (lambda known: known | {"width": 0}, "both must be positive"),
    ],
)
def test_a_bad_camera_of_a_run_is_told(change, said, folder):
    where = folder / "side" / "camera.json"
    where.write_text(json.dumps(change(json.loads(where.read_text()))))
    with pytest.raises(InputError, match=re.escape(f"{where}: ") + ".*" + re.escape(said)):
        Intrinsics.from_json(where)


def test_distortion_is_told(folder):
    write(folder, distortion=[-0.1, 0, 0, 0])
    with pytest.raises(InputError, match="distortion"):
        open_cameras(str(folder), 3)


SENSOR = """<sensor type="{kind}"{id}>
    {lens}
    <transform name="to_world"><matrix value="{matrix}"/></transform>
    <film type="hdrfilm">
        <integer name="width" value="96"/> <integer name="height" value="72"/>
        <string name="pixel_format" value="rgba"/> <rfilter type="box"/>
    </film>
</sensor>
</scene>"""


@pytest.fixture
def scene(tmp_path):
    """A function that gives a scene file with a second sensor; its pose; and the sensor's K."""
    data = synthetic.cloth(tmp_path / "data", frames=2).folder
    path, _ = prepare_folder(str(data))
    text = (data / "scene.xml").read_text()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, 0.8, -0.2]).as_matrix()
    pose[:3, 3] = 0.1, -0.2, 0.5
    lens = "".join(
        f'<float name="{k}" value="{v}"/>'
        for k, v in dict(fx=100.0, fy=95.0, cx=47.0, cy=37.0).items()
    )
    to_world = np.linalg.inv(pose) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    matrix = " ".join(map(repr, to_world.ravel().tolist()))

    def make(id=' id="left"', kind="pinhole"):
        sensor = SENSOR.format(id=id, kind=kind, lens=lens, matrix=matrix)
        (data / "scene.xml").write_text(text.replace("</scene>", sensor))
        return path

    return make, pose


def test_a_second_sensor_is_a_further_camera(scene):
    make, pose = scene
    path = make()
    experiment = loaded(path)
    assert list(experiment.sequence().cameras) == []
    assert "sensors left are not used" in experiment.notes[0]
    folder = Path(path).parent
    synthetic.cloth(folder / "cameras" / "left", frames=2)
    with pytest.raises(InputError, match=r"has a camera\.json, too"):
        loaded(path, cameras="cameras").sequence()
    (folder / "cameras" / "left" / "camera.json").unlink()
    experiment = loaded(path, cameras="cameras")
    (camera,) = experiment.sequence().cameras
    assert experiment.notes == [] and camera.name == "left"
    np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-5)
    c = camera.intrinsics
    np.testing.assert_allclose((c.fx, c.fy, c.cx, c.cy), (100, 95, 47, 37), rtol=1e-5)
    assert (c.width, c.height) == (96, 72) and camera.sequence.mask(0) is not None
    # the own camera is still the first one
    own = Pinhole(experiment.sensor).intrinsics()
    assert own.fx == pytest.approx(1.15 * 96, rel=1e-5)
    # what is written of it is read back
    path = folder / "cameras.json"
    path.write_text(json.dumps({"left": written(camera.intrinsics, camera.world_to_camera)}))
    intrinsics, again = read_cameras(str(path))["left"]
    assert intrinsics == c and np.array_equal(again, camera.world_to_camera)


def test_bad_further_sensors_are_told(scene):
    make, _ = scene
    with pytest.raises(InputError, match="a further sensor has no id"):
        loaded(make(id=""))
    with pytest.raises(InputError, match="'thinlens' is not a pinhole"):
        loaded(make(kind="thinlens"))
    cameras = Path(make()).parent / "cameras"
    (cameras / "right").mkdir(parents=True)
    with pytest.raises(InputError, match=r"sensor 'left': .*cameras.left: no such folder"):
        loaded(make(), cameras="cameras").sequence()
    synthetic.cloth(cameras / "left", frames=2)
    (cameras / "left" / "camera.json").unlink()
    with pytest.raises(InputError, match=r"cameras.right: no camera\.json in it"):
        loaded(make(), cameras="cameras").sequence()


def test_a_camera_s_folder_without_its_file_is_told(folder):
    """A hidden folder, and a file, is none."""
    (folder / ".cache").mkdir()
    (folder / "notes.txt").write_text("")
    assert len(open_cameras(str(folder), 3)) == len(read_rig(str(folder)).views) == 1
    (folder / "back").mkdir()
    for read in (lambda: open_cameras(str(folder), 3), lambda: read_rig(str(folder))):
        with pytest.raises(InputError, match=r"back: no camera\.json in it"):
            read()


def test_a_folder_without_cameras_is_told(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        open_cameras(str(tmp_path / "none"), 1, 0, -1, 1)
    with pytest.raises(InputError, match="no cameras in it"):
        open_cameras(str(tmp_path), 1, 0, -1, 1)
