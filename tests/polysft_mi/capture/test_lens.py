"""The camera of a video: distortion, field of view, calibration by a board."""

import cv2
import numpy as np
import pytest
from clips import CAMERA, photo, refused, rendered, write_png

from polysft_mi.camera import Intrinsics
from polysft_mi.capture import prepare_video
from polysft_mi.capture.camera import Lens, Undistortion, calibrate
from polysft_mi.scene.images import read_rgb

DISTORTION = (-0.18, 0.06, 0.001, -0.002, 0.0)


def distorted(image, camera=CAMERA):
    """A pinhole's image as a lens with DISTORTION shows it."""
    K = camera.matrix()
    K[:2, 2] -= 0.5
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float64)
    at = (
        cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), K, np.array(DISTORTION), P=K)
        .reshape(*x.shape, 2)
        .astype(np.float32)
    )
    return cv2.remap(
        image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def test_distortion_is_removed():
    image, _ = rendered(photo())
    blurred = cv2.GaussianBlur(image, (0, 0), 1.5)
    straight = Undistortion(Lens(CAMERA, DISTORTION))
    inner = np.s_[30:-30, 40:-40]
    bent = distorted(blurred)
    assert np.abs(bent[inner].astype(int) - blurred[inner]).mean() > 5
    assert np.abs(straight.image(bent)[inner].astype(int) - blurred[inner]).mean() < 1
    # a dot and its place go the same way
    dot = np.zeros((240, 320), np.uint8)
    dot[60, 80] = 255
    dot = cv2.GaussianBlur(dot, (0, 0), 2) * 8
    seen = straight.image(dot).astype(float)
    y, x = np.mgrid[:240, :320] + 0.5
    centre = np.array([(seen * x).sum(), (seen * y).sum()]) / seen.sum()
    np.testing.assert_allclose(straight.points([(80.5, 60.5)])[0], centre, atol=0.1)


def test_scaling_scales_the_camera():
    half = Undistortion(Lens(CAMERA), 0.5)
    assert (half.camera.fx, half.camera.cx, half.camera.width) == (165, 81, 160)
    np.testing.assert_allclose(half.points([(100, 50)]), [(50, 25)])


def test_field_of_view_and_film():
    assert Lens.from_fov(90, 640, 480).camera.fx == pytest.approx(320)
    assert Lens.from_focal_35mm(36, 1000, 1000 * 24 / 36, "a").camera.fx == pytest.approx(
        1000
    )  # a picture as wide as the film is
    assert "170" in refused(Lens.from_fov, 200, 640, 480)


def test_camera_that_a_photo_tells(clip, tmp_path):
    from PIL import Image

    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 30
    Image.fromarray(read_rgb(clip[1])).save(tmp_path / "exif.jpg", exif=exif, quality=95)
    _, found = prepare_video(
        clip[0], str(tmp_path / "out"), last=0, texture=str(tmp_path / "exif.jpg"), size=["A4"]
    )
    assert (
        found["camera"]["fx"] == pytest.approx(30 / np.hypot(36, 24) * 400)
        and "same camera" in found["camera"]["from"]
    )
    assert "--fov" in refused(
        prepare_video, clip[0], str(tmp_path / "b"), texture=clip[1], size=["A4"]
    )


def board_image(kind):
    if kind == "chessboard":
        squares = np.indices((7, 10)).sum(0) % 2 * 255
        return (
            np.kron(np.pad(squares, 1, constant_values=255), np.ones((40, 40))).astype(np.uint8),
            40,
        )
    board = cv2.aruco.CharucoBoard(
        (7, 5), 1.0, 0.75, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    return board.generateImage((840, 600), marginSize=0), 120


@pytest.mark.parametrize(
    "kind, board", [("chessboard", "9x6"), ("charuco", "charuco:7x5:4X4_50:0.75")]
)
def test_calibration(kind, board, tmp_path):
    image, _ = board_image(kind)
    h, w = image.shape
    camera = Intrinsics(640.0, 640.0, 330.0, 235.0, 640, 480)
    K = camera.matrix()
    K[:2, 2] -= 0.5
    turns = [
        (0, 0, 0),
        (0.6, 0, 0),
        (-0.6, 0, 0.2),
        (0, 0.6, 0),
        (0, -0.6, 0.3),
        (0.4, 0.4, 0),
        (-0.4, 0.4, 0),
        (0.4, -0.4, 0),
    ]
    for k, turn in enumerate(turns):
        R = cv2.Rodrigues(np.array(turn, float))[0]
        to_board = np.array([[0.3 / w, 0, -0.15], [0, 0.3 / w, -0.15 * h / w], [0, 0, 1]])
        H = K @ np.column_stack([R[:, :2], [0.02 * (k % 3 - 1), 0.02 * (k % 2), 0.42]]) @ to_board
        view = cv2.warpPerspective(image, H, (640, 480), flags=cv2.INTER_AREA, borderValue=120)
        write_png(
            tmp_path / "boards" / f"{k}.png", distorted(cv2.GaussianBlur(view, (0, 0), 0.8), camera)
        )
    found, picture = calibrate(str(tmp_path / "boards"), board)
    assert found.camera.fx == pytest.approx(640, rel=0.01) and found.camera.fy == pytest.approx(
        640, rel=0.01
    )
    assert (found.camera.cx, found.camera.cy) == pytest.approx((330, 235), abs=4)
    assert found.distortion[0] == pytest.approx(DISTORTION[0], abs=0.05) and picture.ndim == 3
    for k in range(2, len(turns)):
        (tmp_path / "boards" / f"{k}.png").unlink()
    assert "found in 0 frames" in refused(calibrate, str(tmp_path / "boards"), "14x11")
    assert "charuco:" in refused(calibrate, str(tmp_path / "boards"), "big")


def test_views_of_a_board_that_tell_nothing(tmp_path):
    image = cv2.copyMakeBorder(
        board_image("charuco")[0], 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255
    )
    for k in range(5):  # from the front, from one distance
        write_png(tmp_path / f"{k}.png", np.roll(image, 4 * k, axis=1))
        if k == 2:
            assert "at least 4" in refused(calibrate, str(tmp_path), "charuco:7x5:4X4_50:0.75")
    assert "do not determine the focal length" in refused(
        calibrate, str(tmp_path), "charuco:7x5:4X4_50:0.75"
    )
