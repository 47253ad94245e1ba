"""What a run says of its further cameras: how well each is met, in figures and in pictures."""

import base64
import io
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from PIL import Image
from scipy.spatial.transform import Rotation

from polysft_mi import prepare, run
from polysft_mi.camera import Intrinsics
from polysft_mi.objective import Problem
from polysft_mi.pictures import read_exr
from polysft_mi.pictures.album import Album
from polysft_mi.results import Run
from polysft_mi.results import folder as folders
from polysft_mi.scene import experiment as scene
from polysft_mi.scene import open_cameras, written

SIZE = 80, 64
SIDE = Intrinsics(90.0, 90.0, 40.0, 32.0, *SIZE)


def pose():
    """World to camera of a camera to the right of the sheet, which looks at it."""
    turn, middle = Rotation.from_rotvec([0, 0.6, 0]).as_matrix(), np.array([0, 0, 0.5])
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn, np.array([0, 0, 0.5]) - turn @ middle
    return found


def film(truth, folder):
    """Frames and masks of the side camera, by NumPy alone."""
    R, t = pose()[:3, :3], pose()[:3, 3]
    texture = synthetic.texture_image()
    for k, vertices in enumerate(truth.vertices):
        seen = vertices @ R.T + t, truth.faces, truth.uv, SIDE.matrix(), SIZE, texture
        image, cover = synthetic.render(*seen)
        synthetic.write_image(folder / "frames" / f"{k}.png", image)
        mask = np.round(255 * cover).astype(np.uint8)
        synthetic.write_image(folder / "masks" / f"{k}.png", mask)
    (folder / "camera.json").write_text(json.dumps(written(SIDE, pose())))


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    """A sequence of three frames, with a folder of one further camera."""
    folder = tmp_path_factory.mktemp("further") / "sheet"
    truth = synthetic.cloth(folder, frames=3, bend=2.0, turn=0.1)
    film(truth, folder / "cameras" / "side")
    prepare.main([str(folder), "--cameras", str(folder / "cameras")])
    return truth


def test_one_grey_camera_makes_all_grey(sheet, tmp_path):
    """All are compared with one texture."""
    folder = shutil.copytree(sheet.folder, tmp_path / "sheet")
    for path in (folder / "cameras" / "side" / "frames").iterdir():
        assert cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    experiment = scene.load(str(folder / "scene.xml"))
    sequence = experiment.sequence()
    for video in (sequence, sequence.cameras[0].sequence):
        assert np.ptp(video.frame(1), axis=2).max() == 0
    assert Problem(experiment, sequence).bleached


def test_each_camera_is_measured_by_itself(sheet, tmp_path):
    experiment = scene.load(str(sheet.folder / "scene.xml"))
    problem = Problem(experiment, experiment.sequence())
    (right,) = problem.sequence.cameras
    film(sheet, tmp_path / "cameras" / "wrong")
    moved = pose()
    moved[0, 3] += 0.03
    where = tmp_path / "cameras" / "wrong" / "camera.json"
    where.write_text(json.dumps(written(SIDE, moved)))
    problem.sequence.cameras = [right, *open_cameras(str(tmp_path / "cameras"), 3)]
    (tmp_path / "log.jsonl").write_text('{"frame": 0, "iteration": 0, "loss": 1.0}\n')
    (tmp_path / "parts").mkdir()
    album = Album(problem, str(tmp_path), {}, str(tmp_path / "parts"))
    for k, v in enumerate(sheet.vertices):
        album.draw(k, problem.camera.origin + v @ problem.camera.axes)
    own, _, others = album.finish(sheet.vertices)
    album.plot()
    album.close()
    assert list(others) == ["side", "wrong"]
    for k in range(3):
        a, b = others["side"][k], others["wrong"][k]
        assert a["frame"] == b["frame"] == k
        assert a["psnr_mask"] > 28 and a["iou"] > 0.97 and own[k]["iou"] > 0.97
        assert b["psnr_mask"] < a["psnr_mask"] - 5 and b["iou"] < 0.9
    pictures = [cv2.imread(str(tmp_path / f"comparison_{name}.png")) for name in others]
    shapes = [picture.shape for picture in pictures]
    whole = cv2.imread(str(tmp_path / "comparison.png"))
    assert all(s[1] < 0.9 * whole.shape[1] for s in shapes)  # without the surface from the side
    # the residual, the last column, has one scale: where the camera stands wrongly it is brighter
    good, wrong = (p[:, 3 * p.shape[1] // 4 :].astype(float).mean() for p in pictures)
    assert wrong > good + 3


def test_a_run_tells_of_them(sheet, tmp_path):
    out = tmp_path / "out"
    words = [str(sheet.folder / "scene.xml"), "-o", str(out), "-q", "-D", "order=3", "--exr", "2"]
    assert run.main(words) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    side = metrics["cameras"]["side"]
    assert [row["frame"] for row in side["per_frame"]] == [0, 1, 2]
    assert side["iou"] == pytest.approx(np.mean([row["iou"] for row in side["per_frame"]]))
    assert side["psnr_mask"] > 24 and side["iou"] > 0.93
    found, world_to_camera = Run.open(out).cameras["side"]
    assert found == SIDE and np.allclose(world_to_camera, pose())
    text = (out / "report.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    (camera,) = data["cameras"]
    assert camera["name"] == "side" and f"PSNR {side['psnr_mask']:.2f} dB" in camera["text"]
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(camera["picture"]))))
    drawn = cv2.imread(str(out / "comparison_side.png"))[..., ::-1]
    assert shown.shape[1] == min(1280, drawn.shape[1])
    if shown.shape == drawn.shape:
        assert np.abs(shown.astype(int) - drawn).mean() < 6
    assert data["columns"]["iou, side"] == [row["iou"] for row in side["per_frame"]]
    assert data["labels"]["iou, side"] == "side: silhouettes, IoU"
    exrs = sorted(str(p.relative_to(out / "comparison")) for p in out.glob("comparison/**/*.exr"))
    assert exrs == ["000.exr", "002.exr", "side/000.exr", "side/002.exr"]
    layers, header = read_exr(str(out / "comparison" / "side" / "002.exr"))
    frame = open_cameras(str(sheet.folder / "cameras"), 3)[0].sequence.frame(2)
    assert np.allclose(layers["target"], frame, atol=1e-3)
    assert {"render", "error", "mask_target"} < set(layers) and header["camera"] == "side"
    folders.clear(str(out))
    assert [p.name for p in Path(out).iterdir()] == []
