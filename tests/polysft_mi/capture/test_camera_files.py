"""Camera files of OpenCV, COLMAP, nerfstudio and ours: one camera from each; and bad ones."""

import json
import math

import cv2
import numpy as np
import pytest
from clips import refused

from polysft_mi.capture.camera import read_lens

FX, FY, CX, CY, SIZE = 600.0, 610.0, 322.5, 241.0, (640, 480)
DISTORTION = (-0.18, 0.06, 0.001, -0.002)


OURS = '{"fx": 600, "fy": 600, "cx": 320, "cy": 240, "width": 640, "height": 480, %s}'


def opencv(path, kind="yaml", **change):
    """As OpenCV's calibration program writes it; its pixels are whole at their centres."""
    K = np.array([[FX, 0, CX - 0.5], [0, FY, CY - 0.5], [0, 0, 1]])
    values = {
        "image_width": SIZE[0],
        "image_height": SIZE[1],
        "camera_matrix": K,
        "distortion_coefficients": np.array([[*DISTORTION, 0.0]]),
    }
    storage = cv2.FileStorage(f"{path}.{kind}", cv2.FILE_STORAGE_WRITE)
    for name, value in {**values, **change}.items():
        if value is not None:
            storage.write(name, value)
    storage.release()
    return f"{path}.{kind}"


def colmap(path, *lines):
    path.write_text(
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n"
        + "".join(line + "\n" for line in lines)
    )
    return str(path)


def nerfstudio(path, **values):
    path.write_text(json.dumps({"frames": [], **values}))
    return str(path)


def assert_camera(lens, focal=(FX, FY), centre=(CX, CY), size=SIZE):
    camera = lens.camera
    assert (camera.fx, camera.fy) == pytest.approx(focal)
    assert (camera.cx, camera.cy) == pytest.approx(centre)
    assert (camera.width, camera.height) == size


@pytest.mark.parametrize("kind", ["yaml", "yml", "xml", "json"])
def test_opencv(kind, tmp_path):
    path = opencv(tmp_path / "camera", kind)
    lens = read_lens(path, *SIZE)
    assert_camera(lens)
    assert lens.distortion == pytest.approx((*DISTORTION, 0))
    # half the size: K is scaled, the distortion stays
    assert_camera(read_lens(path, 320, 240), (FX / 2, FY / 2), (CX / 2, CY / 2), (320, 240))
    # a file without a size is for the frames as they are
    bare = opencv(
        tmp_path / "bare", kind, image_width=None, image_height=None, distortion_coefficients=None
    )
    assert_camera(read_lens(bare, *SIZE))
    assert read_lens(bare, *SIZE).distortion == ()


@pytest.mark.parametrize(
    "line, focal, distortion",
    [
        (f"1 SIMPLE_PINHOLE 640 480 {FX} {CX} {CY}", (FX, FX), ()),
        (f"1 PINHOLE 640 480 {FX} {FY} {CX} {CY}", (FX, FY), ()),
        (f"7 SIMPLE_RADIAL 640 480 {FX} {CX} {CY} -0.1", (FX, FX), (-0.1, 0, 0, 0)),
        (f"1 RADIAL 640 480 {FX} {CX} {CY} -0.1 0.02", (FX, FX), (-0.1, 0.02, 0, 0)),
        (
            f"1 OPENCV 640 480 {FX} {FY} {CX} {CY} -0.18 0.06 0.001 -0.002",
            (FX, FY),
            DISTORTION,
        ),
    ],
)
def test_colmap(line, focal, distortion, tmp_path):
    lens = read_lens(colmap(tmp_path / "cameras.txt", line), *SIZE)
    assert_camera(lens, focal)
    assert lens.distortion == pytest.approx(distortion)
    twice = colmap(tmp_path / "twice.txt", line, "2" + line[1:])  # one camera, named twice
    assert read_lens(twice, *SIZE).camera == lens.camera


def test_nerfstudio(tmp_path):
    full = dict(fl_x=FX, fl_y=FY, cx=CX, cy=CY, w=640, h=480, k1=-0.18, k2=0.06, p1=0.001)
    path = nerfstudio(tmp_path / "transforms.json", camera_model="OPENCV", p2=-0.002, **full)
    lens = read_lens(path, *SIZE)
    assert_camera(lens)
    assert lens.distortion == pytest.approx(DISTORTION)
    lens = read_lens(nerfstudio(tmp_path / "k3.json", k3=0.01, **full), *SIZE)
    assert lens.distortion == pytest.approx((-0.18, 0.06, 0.001, 0, 0.01))
    angle = 2 * math.atan(320 / FX)  # as Blender writes it, without a size
    lens = read_lens(nerfstudio(tmp_path / "angle.json", camera_angle_x=angle), *SIZE)
    assert_camera(lens, (FX, FX), (320, 240))
    assert lens.distortion == ()


def test_our_own_form(tmp_path):
    path = tmp_path / "camera.json"
    values = dict(fx=FX, fy=FY, cx=CX, cy=CY, width=640, height=480)
    path.write_text(json.dumps(values))
    assert_camera(read_lens(str(path), *SIZE))
    path.write_text(json.dumps({**values, "distortion": DISTORTION}))
    assert read_lens(str(path), *SIZE).distortion == DISTORTION


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "known forms"),
        ("a picture of a camera", "known forms"),
        ("[1, 2]", "known forms"),
        ("{", "not JSON"),
        ("{}", "fx is missing"),
        ('{"fx": "a", "fy": 1, "cx": 1, "cy": 1, "width": 2, "height": 2}', "fx = 'a'"),
        ('{"fx": 0, "fy": 1, "cx": 1, "cy": 1, "width": 640, "height": 480}', "not a pinhole"),
        ('{"fx": 1e300, "fy": 1, "cx": 1, "cy": 1, "width": 2, "height": 2}', "at most 1e+09"),
        (
            '{"fx": 9, "fy": 9, "cx": 1, "cy": 1, "width": 9, "height": 9,'
            ' "distortion": [1e300, 0, 0, 0]}',
            "4 distortion coefficients",
        ),
        ("%YAML:1.0\n---\ncamera_matrix: [", "OpenCV"),
        ("%YAML:1.0\n---\nK: 1\n", "no matrix camera_matrix"),
        ("<?xml version='1.0'?>\n<opencv_storage>\n<camera_matrix>", "OpenCV"),
        ("<?xml version='1.0'?>\n<scene/>", "OpenCV"),
        ("1 OPENCV_FISHEYE 640 480 1 1 1 1 0 0 0 0\n", "camera model OPENCV_FISHEYE"),
        ("1 FULL_OPENCV 640 480 1 1 1 1 0 0 0 0 0 0 0 0\n", "camera model FULL_OPENCV"),
        ("1 PINHOLE 640 480 1 1 1\n", "3 parameters of the model PINHOLE"),
        ("1 PINHOLE 640 480 1 1 1 x\n", "not a number"),
        ("1 PINHOLE 640 480 nan 1 1 1\n", "finite"),
        ("1 PINHOLE 640 480 1 1 1 1\n2 PINHOLE 640 480 2 2 1 1\n", "2 cameras that differ"),
        ("1 PINHOLE 100 480 500 500 1 1\n", "another shape"),
        ('{"camera_model": "OPENCV_FISHEYE", "fl_x": 1}', "OPENCV_FISHEYE"),
        ('{"fl_x": 1, "is_fisheye": true}', "FISHEYE"),
        ('{"frames": [{"fl_x": 1}]}', "no fl_x"),
        ('{"camera_angle_x": 4}', "camera_angle_x = 4"),
        ('{"fl_x": 600, "k4": 1}', "k4"),
        ('{"fl_x": "wide"}', "fl_x = 'wide'"),
        (OURS % '"k1": -0.2', "k1 = -0.2; a lens is known by distortion alone"),
        (OURS % '"dist_coeffs": [0, 0.1]', "dist_coeffs = [0, 0.1]; a lens is known by"),
        (OURS % '"model": "fisheye"', "model = 'fisheye'; a lens is known by"),
        (OURS.replace("600", "1.25") % '"name": "a"', "1.25 pixels sees 179.6 degrees"),
    ],
)
def test_bad_files_are_told_in_one_line(text, said, tmp_path, capfd):
    path = tmp_path / "camera.any"
    path.write_text(text)
    message = refused(read_lens, str(path), *SIZE)
    assert said in message and message.startswith(f"{path}: ")
    assert capfd.readouterr() == ("", "")


def test_files_that_are_no_text(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(b"\x01\x00\xff\xfe\x80" * 20)
    assert "not a text file" in refused(read_lens, str(tmp_path / "cameras.bin"), *SIZE)
    assert "no such file" in refused(read_lens, str(tmp_path / "none.json"), *SIZE)
    assert "directory" in refused(read_lens, str(tmp_path), *SIZE).lower()


def test_skew_of_opencv(tmp_path):
    K = np.array([[600.0, 3, 320], [0, 600, 240], [0, 0, 1]])
    path = opencv(tmp_path / "a", camera_matrix=K)
    assert "skew" in refused(read_lens, path, *SIZE)


def test_opencv_by_other_names(tmp_path):
    path = opencv(tmp_path / "camera", "yml")
    text = (tmp_path / "camera.yml").read_text()
    text = text.replace("camera_matrix", "cameraMatrix")
    (tmp_path / "camera.yml").write_text(text.replace("distortion_coefficients", "distCoeffs"))
    lens = read_lens(path, *SIZE)
    assert_camera(lens)
    assert lens.distortion == pytest.approx((*DISTORTION, 0))


def test_what_says_that_a_lens_is_a_pinhole_does_not_matter(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(
        OURS
        % '"camera_model": "PINHOLE", "model": "iPhone 12", "k1": 0, "distortion": [0, 0, 0, 0]'
    )
    assert not any(read_lens(str(path), *SIZE).distortion)
