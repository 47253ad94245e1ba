"""A sequence's folder from a video and a photo: each step against what is known of rendered videos,
and each bad input in one line.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import ROOT
from scripts import load

from polysft_mi import prepare
from polysft_mi.camera import Intrinsics
from polysft_mi.capture import calibration, folder, frames, lens, masks, pose, sheet
from polysft_mi.capture.folder import capture
from polysft_mi.capture.size import parse_size
from polysft_mi.errors import InputError
from polysft_mi.pictures.video import write_video
from polysft_mi.scene import images
from polysft_mi.scene.sequence import Sequence
from polysft_mi.surface import meshio

DEMO = ROOT / "scenes" / "demo"
CAMERA = Intrinsics(330.0, 330.0, 162.0, 117.0, 320, 240)
WIDTH, HEIGHT = 0.297, 0.21


def refused(function, *arguments, **options):
    with pytest.raises(InputError) as caught:
        function(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def photo(seed=1, size=(594, 420)):
    """A print with detail everywhere (H, W, 3) uint8, bright against the background of
    :func:`clip`.
    """
    rng = np.random.default_rng(seed)
    image = np.full((size[1], size[0], 3), 235, np.uint8)
    for _ in range(220):
        centre, radius = rng.integers(0, size), int(rng.integers(6, 26))
        colour = tuple(int(c) for c in rng.integers(90, 250, 3))
        corner = tuple(int(c) for c in centre + rng.integers(5, 40, 2))
        (
            cv2.circle(image, tuple(int(c) for c in centre), radius, colour, -1)
            if rng.random() < 0.5
            else cv2.rectangle(image, tuple(int(c) for c in centre), corner, colour, -1)
        )
    return image


def background(size=(320, 240)):
    noise = (
        np.random.default_rng(7).integers(0, 90, (size[1] // 8, size[0] // 8, 3)).astype(np.uint8)
    )
    return cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)


def placed(t=0.0):
    """(R, t) of the flat sheet at the time t in [0, 1]."""
    R = cv2.Rodrigues(np.array([0.35 - 0.1 * t, -0.3 + 0.2 * t, 0.1]))[0]
    return R, np.array([0.01 + 0.03 * t, 0.005, 0.55])


def rendered(print_, t=0.0, camera=CAMERA, over=None):
    """(image (H, W, 3) uint8, coverage (H, W) in [0, 1]) of the flat print."""
    R, shift = placed(t)
    h, w = print_.shape[:2]
    to_sheet = np.array([[WIDTH / w, 0, -WIDTH / 2], [0, HEIGHT / h, -HEIGHT / 2], [0, 0, 1]])
    H = camera.matrix() @ np.column_stack([R[:, :2], shift]) @ to_sheet
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    over = background((camera.width, camera.height)) if over is None else over
    fine = np.diag([4.0, 4.0, 1.0])  # supersampled
    H, size = np.linalg.inv(half) @ fine @ H @ half, (4 * camera.width, 4 * camera.height)
    small = lambda x: cv2.resize(x, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    colour = small(cv2.warpPerspective(print_, H, size, flags=cv2.INTER_LINEAR).astype(np.float32))
    cover = small(cv2.warpPerspective(np.ones((h, w), np.float32), H, size))
    return np.round(np.clip(colour + over * (1 - cover[..., None]), 0, 255)).astype(np.uint8), cover


def write_png(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(
        ".png", rgb[..., ::-1] if rgb.ndim == 3 and rgb.shape[2] == 3 else rgb
    )
    assert done
    path.write_bytes(data.tobytes())
    return str(path)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """(video, photo, camera file, coverages) in a folder whose name has spaces and letters that are
    not ASCII.
    """
    folder = tmp_path_factory.mktemp("a") / "vidéo 紙 &1"
    folder.mkdir()
    print_ = photo()
    made = [rendered(print_, k / 11) for k in range(12)]
    video = write_video(folder / "my clip.mp4", [image for image, _ in made])
    (folder / "camera.json").write_text(
        json.dumps({k: getattr(CAMERA, k) for k in ("fx", "fy", "cx", "cy", "width", "height")})
    )
    return (
        video,
        write_png(folder / "my photo.png", print_),
        str(folder / "camera.json"),
        [cover for _, cover in made],
    )


def given(clip, **options):
    return {"texture": clip[1], "size": ["297mm", "210mm"], "camera": clip[2], **options}


# ---- the whole way -------------------------------------------------------------------------------


def test_folder_of_a_video(clip, tmp_path):
    lines, out = [], str(tmp_path / "aus gabe é")
    scene_path, found = capture(clip[0], out, say=lines.append, **given(clip))
    assert sorted(os.listdir(out)) == [
        "camera.json",
        "frames",
        "masks",
        "prepare",
        "scene.xml",
        "template.obj",
        "texture.png",
    ]
    assert sorted(os.listdir(tmp_path)) == ["aus gabe é"]  # nothing beside it
    assert sorted(os.listdir(f"{out}/prepare")) == [
        "frames.png",
        "masks.png",
        "matches.png",
        "pose.png",
        "prepare.json",
    ]
    assert json.loads(Path(out, "prepare", "prepare.json").read_text()) == json.loads(
        json.dumps(found)
    )
    assert found["frames"] == 12 and found["in_view"] == 1 and found["pose"]["agree"] > 100

    vertices, _faces, uv = meshio.read_template(f"{out}/template.obj")
    R, t = placed()
    flat = np.column_stack([(uv[:, 0] - 0.5) * WIDTH, (0.5 - uv[:, 1]) * HEIGHT, np.zeros(len(uv))])
    assert (
        np.abs(vertices - (flat @ R.T + t)).max() < 1e-3
    )  # of 550 mm, by a compressed video of 320x240
    assert len(vertices) == 33 * 24
    for k, cover in enumerate(clip[3]):
        mask = images.read_rgb(f"{out}/masks/{k:05d}.png")[..., 0]
        assert masks.iou(mask, cover) > 0.97

    import mitsuba as mi

    from polysft_mi.scene import experiment as scene

    experiment = scene.load(scene_path)
    image = np.array(mi.render(experiment.scene, sensor=experiment.sensor, spp=1))
    frame = Sequence.open(experiment.frames, experiment.masks, size=experiment.size).frame(0)
    inside = image[..., 3] > 0.999
    right, upside_down, mirrored = (
        np.abs(image[..., :3] - x)[inside].mean() for x in (frame, frame[::-1], frame[:, ::-1])
    )
    assert inside.mean() > 0.2 and right < 0.05 and min(upside_down, mirrored) > 3 * right


def test_demo_is_found_by_its_texture(tmp_path):
    """The demo's first frame is curved: its own mesh as the template."""
    write_video(
        tmp_path / "demo.mp4",
        [images.read_rgb(p) for p in sorted((DEMO / "frames").glob("*.jpg"))[:3]],
    )
    capture(
        str(tmp_path / "demo.mp4"),
        texture=str(DEMO / "texture.jpg"),
        template=str(DEMO / "template.obj"),
        camera=str(DEMO / "camera.json"),
    )
    vertices, _, _ = meshio.read_template(tmp_path / "demo" / "template.obj")
    truth, _, _ = meshio.read_template(DEMO / "template.obj")
    assert np.linalg.norm(vertices - truth, axis=1).max() < 3e-3
    for k in range(3):
        found, drawn = (
            images.read_rgb(p)[..., 0]
            for p in (tmp_path / "demo" / "masks" / f"{k:05d}.png", DEMO / "masks" / f"{k:03d}.png")
        )
        assert masks.iou(found, drawn) > 0.97


def test_corners_and_the_first_frame_as_texture(clip, tmp_path):
    R, t = placed(2 / 11)
    corners = CAMERA.project(
        np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        * (WIDTH / 2, HEIGHT / 2, 0)
        @ R.T
        + t
    )
    _, found = capture(
        clip[0],
        str(tmp_path / "out"),
        texture="first-frame",
        size=["A4"],
        camera=clip[2],
        corners=corners.tolist(),
        first=2,
        last=8,
        stride=3,
        scale=0.5,
        masks=False,
    )
    assert found["indices"] == [2, 5, 8]
    vertices, _, uv = meshio.read_template(tmp_path / "out" / "template.obj")
    assert np.linalg.norm(vertices.mean(0) - t) < 2e-3
    camera = Intrinsics.from_json(tmp_path / "out" / "camera.json")
    assert (camera.width, camera.height, camera.fx, camera.cx) == (160, 120, 165, 81)
    np.testing.assert_allclose(
        uv * (160, -120) + (0, 120), camera.project(vertices), atol=1e-3
    )  # the texture is the frame
    assert not (tmp_path / "out" / "masks").exists() and images.read_rgb(
        tmp_path / "out" / "texture.png"
    ).shape == (120, 160, 3)


def test_corners_by_hand_are_moved_to_the_edges(clip, tmp_path):
    """Corners that miss by some pixels: the sheet is moved to its edges in the frame, and a line
    says so; or it is not, where that is wanted.
    """
    R, t = placed(2 / 11)
    sheet_corners = (
        np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        * (WIDTH / 2, HEIGHT / 2, 0)
        @ R.T
        + t
    )
    corners = CAMERA.project(sheet_corners) + [(2, -1.5), (-1, 2), (1.5, 2), (2, -1)]
    options = dict(
        texture="first-frame",
        size=["A4"],
        camera=clip[2],
        corners=corners.tolist(),
        first=2,
        last=2,
        masks=False,
    )
    missed, found, lines = {}, {}, []
    for fit in ("auto", "none"):
        _, found[fit] = capture(
            clip[0], str(tmp_path / fit), pose_fit=fit, say=lines.append, **options
        )
        vertices, _, uv = meshio.read_template(tmp_path / fit / "template.obj")
        camera = Intrinsics.from_json(tmp_path / fit / "camera.json")
        np.testing.assert_allclose(uv * (320, -240) + (0, 240), camera.project(vertices), atol=1e-3)
        ends = [
            vertices[np.argmin(np.linalg.norm(vertices - corner, axis=1))]
            for corner in sheet_corners
        ]
        missed[fit] = np.linalg.norm(
            camera.project(np.array(ends)) - CAMERA.project(sheet_corners), axis=1
        ).max()
    assert missed["auto"] < 0.4 and missed["none"] > 1.5
    assert 0.5 < found["auto"]["pose"]["moved_px"] < 4 and "moved_px" not in found["none"]["pose"]
    moved = [line for line in lines if "to the edges of the frame" in line]
    assert (
        len(moved) == 1 and f"moved by {found['auto']['pose']['moved_px']:.2f} pixels" in moved[0]
    )


def test_sheet_that_fills_the_picture(clip, tmp_path):
    words = [
        "--texture",
        "first-frame",
        "--size",
        "40cm",
        "30cm",
        "--fov",
        "50",
        "--corners",
        "frame",
        "--no-masks",
        "--last",
        "1",
        "-q",
    ]
    prepare.main([clip[0], *words, "-o", str(tmp_path / "out")])
    vertices, _, uv = meshio.read_template(tmp_path / "out" / "template.obj")
    assert (uv.min(), uv.max()) == pytest.approx((0, 1), abs=1e-3)
    assert np.ptp(vertices, axis=0) == pytest.approx((0.4, 0.3, 0), abs=1e-3)
    assert vertices[:, 2].mean() == pytest.approx(0.2 / np.tan(np.radians(25)), rel=1e-3)


def test_photo_that_shows_more_than_the_sheet(clip, tmp_path):
    straight = images.read_rgb(clip[1])
    corners = np.float32([(70, 60), (690, 95), (660, 520), (50, 480)])
    H = cv2.getPerspectiveTransform(np.float32([(0, 0), (594, 0), (594, 420), (0, 420)]), corners)
    wider = cv2.warpPerspective(straight, H, (760, 600), borderValue=(60, 60, 60))
    capture(
        clip[0],
        str(tmp_path / "out"),
        last=1,
        **given(clip, texture=write_png(tmp_path / "wider.png", wider), size=["A4"]),
        texture_corners=corners,
    )
    texture = images.read_rgb(tmp_path / "out" / "texture.png")
    assert abs(texture.shape[1] / texture.shape[0] - WIDTH / HEIGHT) < 0.01
    assert np.abs(cv2.resize(texture, (594, 420)).astype(int) - straight).mean() < 12
    vertices, _, _ = meshio.read_template(tmp_path / "out" / "template.obj")
    assert np.linalg.norm(vertices.mean(0) - placed()[1]) < 2e-3


def test_given_masks(clip, tmp_path):
    for k, cover in enumerate(clip[3]):
        write_png(tmp_path / "given" / f"{k}.png", np.round(255 * cover).astype(np.uint8))
    capture(
        clip[0],
        str(tmp_path / "out"),
        masks=str(tmp_path / "given"),
        first=4,
        last=6,
        **given(clip),
    )
    assert (
        np.abs(
            images.read_rgb(tmp_path / "out" / "masks" / "00002.png")[..., 0] / 255 - clip[3][6]
        ).max()
        < 0.01
    )
    (tmp_path / "given" / "11.png").unlink()
    assert "11 masks" in refused(
        capture, clip[0], str(tmp_path / "b"), masks=str(tmp_path / "given"), **given(clip)
    )
    assert "no such folder" in refused(
        capture, clip[0], str(tmp_path / "b"), masks=str(tmp_path / "none" / "x"), **given(clip)
    )
    assert not (tmp_path / "b").exists()


def test_masks_that_cannot_be_believed_are_not_used(clip, tmp_path):
    for k, image in enumerate([rendered(photo())[0], background()]):  # the sheet is gone
        write_png(tmp_path / "in" / f"{k}.png", image)
    lines = []
    _, found = capture(str(tmp_path / "in"), str(tmp_path / "out"), say=lines.append, **given(clip))
    assert not found["masks"]["used"] and any(
        "not used, for what is inside in frame 1" in line for line in lines
    )
    assert (
        not (tmp_path / "out" / "masks").exists()
        and (tmp_path / "out" / "prepare" / "masks.png").exists()
    )
    assert 'name="masks" value=""' in (tmp_path / "out" / "scene.xml").read_text()


def test_command_line(clip, tmp_path):
    def command(*words):
        return subprocess.run(
            [sys.executable, "-m", "polysft_mi.prepare", *map(str, words)],
            cwd=ROOT,
            capture_output=True,
            text=True,
        )

    words = [
        clip[0],
        "--texture",
        clip[1],
        "--size",
        "A4",
        "--camera",
        clip[2],
        "-o",
        tmp_path / "o ut",
        "--last",
        1,
    ]
    done = command(*words)
    assert done.returncode == 0 and done.stderr == ""
    assert f"python -m polysft_mi.run '{tmp_path / 'o ut' / 'scene.xml'}'" in done.stdout
    again = command(*words)
    assert (
        again.returncode == 2
        and again.stderr.startswith("error: ")
        and again.stderr.count("\n") == 1
        and "--overwrite" in again.stderr
    )
    assert (
        "python -m polysft_mi.prepare clip.mp4 --texture photo.jpg"
        in prepare.parser().format_help()
    )


def test_replacing_a_folder(clip, tmp_path, capsys):
    words = [
        clip[0],
        "--texture",
        clip[1],
        "--size",
        "A4",
        "--camera",
        clip[2],
        "-o",
        str(tmp_path / "out"),
        "--no-masks",
    ]
    prepare.main([*words, "--last", "0", "-q"])
    assert capsys.readouterr().out == ""
    prepare.main([*words, "--last", "1", "--overwrite", "--json"])
    assert (
        json.loads(capsys.readouterr().out)["frames"] == 2
        and len(os.listdir(tmp_path / "out" / "frames")) == 2
    )
    assert os.listdir(tmp_path) == ["out"]
    (tmp_path / "out" / "prepare" / "prepare.json").unlink()
    assert (
        "not replaced" in refused(prepare.main, [*words, "--overwrite"])
        and (tmp_path / "out" / "scene.xml").exists()
    )


# ---- frames and images ---------------------------------------------------------------------------


def test_frames_are_upright_and_in_their_colours(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :32], image[:24, 32:], image[24:, :32], image[24:, 32:] = (
        (200, 40, 30),
        (30, 180, 60),
        (40, 50, 220),
        (240, 240, 100),
    )
    write_video(tmp_path / "a.mp4", [image] * 3)
    got = [x for _, x in frames.read_frames(tmp_path / "a.mp4")]
    assert len(got) == 3 and all(
        np.abs(x[8:40:31, 8:50:41].astype(int) - image[8:40:31, 8:50:41]).max() < 6 for x in got
    )
    import imageio_ffmpeg

    turned = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-nostdin",
        "-display_rotation",
        "90",
        "-i",
        tmp_path / "a.mp4",
        "-c",
        "copy",
        tmp_path / "b.mp4",
    ]
    subprocess.run([str(x) for x in turned], check=True, timeout=60)
    _, got = next(frames.read_frames(tmp_path / "b.mp4"))
    assert got.shape == (64, 48, 3) and np.abs(got.astype(int) - np.rot90(image)).mean() < 6


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_of_a_photo(orientation, tmp_path):
    from PIL import Image, ImageOps

    image = Image.fromarray(photo(size=(40, 30)))
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    wanted = np.array(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    np.testing.assert_array_equal(images.read_rgb(tmp_path / "a.png"), wanted)


def test_depth_and_alpha_of_a_photo(tmp_path):
    rgb = photo(size=(40, 30))
    write_png(tmp_path / "deep.png", rgb.astype(np.uint16)[..., ::-1][..., ::-1] * 257)
    np.testing.assert_array_equal(images.read_rgb(tmp_path / "deep.png"), rgb)
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[:, :20] = 0
    write_png(tmp_path / "alpha.png", np.dstack([rgb[..., ::-1], alpha]))
    got = images.read_rgb(tmp_path / "alpha.png")
    assert (got[:, :20] == 255).all() and (got[:, 20:] == rgb[:, 20:]).all()
    write_png(tmp_path / "grey.png", rgb[..., 0].astype(np.uint16) * 257)
    assert (images.read_rgb(tmp_path / "grey.png") == rgb[..., :1]).all()


def test_deep_and_transparent_inputs_go_the_whole_way(clip, tmp_path):
    deep = images.read_rgb(clip[1])[..., ::-1].astype(np.uint16) * 257
    path = write_png(
        tmp_path / "deep.png", np.dstack([deep, np.full(deep.shape[:2], 65535, np.uint16)])
    )
    for k, (_, image) in enumerate(frames.read_frames(clip[0], last=1)):
        write_png(
            tmp_path / "in" / f"{k}.png",
            np.dstack([image[..., ::-1], np.full(image.shape[:2], 255, np.uint8)]),
        )
    _, found = capture(str(tmp_path / "in"), str(tmp_path / "out"), **given(clip, texture=path))
    assert found["pose"]["agree"] > 100 and found["frames"] == 2


# ---- the camera ----------------------------------------------------------------------------------

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
    straight = lens.Undistortion(lens.Lens(CAMERA, DISTORTION))
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
    half = lens.Undistortion(lens.Lens(CAMERA), 0.5)
    assert (half.camera.fx, half.camera.cx, half.camera.width) == (165, 81, 160)
    np.testing.assert_allclose(half.points([(100, 50)]), [(50, 25)])


def test_field_of_view_and_film():
    assert lens.Lens.from_fov(90, 640, 480).camera.fx == pytest.approx(320)
    assert lens.Lens.from_focal_35mm(36, 1000, 1000 * 24 / 36, "a").camera.fx == pytest.approx(
        1000
    )  # a picture as wide as the film is
    assert "170" in refused(lens.Lens.from_fov, 200, 640, 480)


def test_camera_that_a_photo_tells(clip, tmp_path):
    from PIL import Image

    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 30
    Image.fromarray(images.read_rgb(clip[1])).save(tmp_path / "exif.jpg", exif=exif, quality=95)
    _, found = capture(
        clip[0], str(tmp_path / "out"), last=0, texture=str(tmp_path / "exif.jpg"), size=["A4"]
    )
    assert (
        found["camera"]["fx"] == pytest.approx(30 / np.hypot(36, 24) * 400)
        and "same camera" in found["camera"]["from"]
    )
    assert "--fov" in refused(capture, clip[0], str(tmp_path / "b"), texture=clip[1], size=["A4"])


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
    found, picture = calibration.calibrate(str(tmp_path / "boards"), board)
    assert found.camera.fx == pytest.approx(640, rel=0.01) and found.camera.fy == pytest.approx(
        640, rel=0.01
    )
    assert (found.camera.cx, found.camera.cy) == pytest.approx((330, 235), abs=4)
    assert found.distortion[0] == pytest.approx(DISTORTION[0], abs=0.05) and picture.ndim == 3
    for k in range(2, len(turns)):
        (tmp_path / "boards" / f"{k}.png").unlink()
    assert "found in 0 frames" in refused(calibration.calibrate, str(tmp_path / "boards"), "14x11")
    assert "charuco:" in refused(calibration.calibrate, str(tmp_path / "boards"), "big")


def test_views_of_a_board_that_tell_nothing(tmp_path):
    image = cv2.copyMakeBorder(
        board_image("charuco")[0], 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255
    )
    for k in range(5):  # from the front, from one distance
        write_png(tmp_path / f"{k}.png", np.roll(image, 4 * k, axis=1))
        if k == 2:
            assert "at least 4" in refused(
                calibration.calibrate, str(tmp_path), "charuco:7x5:4X4_50:0.75"
            )
    assert "focal length open" in refused(
        calibration.calibrate, str(tmp_path), "charuco:7x5:4X4_50:0.75"
    )


# ---- sizes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words, size",
    [
        (["0.297", "0.210"], (0.297, 0.21)), (["297mm", "210mm"], (0.297, 0.21)),
        (["297", "210mm"], (0.297, 0.21)), (["29.7cm", "21cm"], (0.297, 0.21)),
        (["297x210mm"], (0.297, 0.21)), (["A4"], (0.297, 0.21)), (["a3"], (0.42, 0.297)),
        (["11in", "8.5in"], (0.2794, 0.2159)), (["30cm"], (0.3, 0.3)), (["2", "1.5"], (2, 1.5)),
    ],
)  # fmt: skip
def test_sizes(words, size):
    assert parse_size(words, 1.4) == pytest.approx(size)


def test_size_of_a_standing_sheet():
    assert parse_size(["A4"], 0.7) == pytest.approx((0.21, 0.297))


@pytest.mark.parametrize(
    "words, said",
    [
        (["297", "210"], "297mm 210mm"), (["29.7", "21"], "29.7cm 21cm"),
        (["11", "8.5"], "11in 8.5in"), (["297m", "210m"], "20 m"), (["0.1mm", "1m"], "5 mm"),
        (["0", "1"], "positive"), (["-1", "1"], "not a length"), (["A9"], "not a length"),
        (["1", "2", "3"], "3 lengths"), (["297px", "210px"], "'297px'"),
        (["nan", "1"], "not a length"), (["inf"], "not a length"),
    ],
)  # fmt: skip
def test_sizes_that_no_sheet_has(words, said):
    assert said in refused(parse_size, words)


# ---- what is refused -----------------------------------------------------------------------------


def test_videos_that_cannot_be_read(clip, tmp_path):
    whole = Path(clip[0]).read_bytes()
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 4])
    (tmp_path / "folder").mkdir()
    for name in ("empty.mp4", "noise.mp4", "half.mp4", "folder", "none.mp4"):
        message = refused(capture, str(tmp_path / name), str(tmp_path / "out"), **given(clip))
        assert name in message
    assert "11 frames" not in refused(
        capture, clip[0], str(tmp_path / "out"), first=12, **given(clip)
    )
    assert "12 frames" in refused(capture, clip[0], str(tmp_path / "out"), last=12, **given(clip))
    assert sorted(os.listdir(tmp_path)) == ["empty.mp4", "folder", "half.mp4", "noise.mp4"]


def test_frames_of_several_sizes(clip, tmp_path):
    import av

    pictures = [rendered(photo())[0], rendered(photo())[0][:200]]
    for k, image in enumerate(pictures):
        write_png(tmp_path / "in" / f"{k}.png", image)
    assert "320x200" in refused(capture, str(tmp_path / "in"), str(tmp_path / "out"), **given(clip))
    for k, image in enumerate(pictures):  # streams of Motion JPEG can be joined end to end
        with av.open(str(tmp_path / f"{k}.mjpeg"), "w") as container:
            stream = container.add_stream("mjpeg", rate=10)
            stream.width, stream.height, stream.pix_fmt = image.shape[1], image.shape[0], "yuvj420p"
            for packet in [
                *stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")),
                *stream.encode(),
            ]:
                container.mux(packet)
    (tmp_path / "both.mjpeg").write_bytes(
        b"".join((tmp_path / f"{k}.mjpeg").read_bytes() for k in range(2))
    )
    assert "320x200" in refused(
        capture, str(tmp_path / "both.mjpeg"), str(tmp_path / "out"), **given(clip)
    )
    assert not (tmp_path / "out").exists() and not [
        n for n in os.listdir(tmp_path) if "partial" in n
    ]


def test_photo_that_is_not_in_the_video(clip, tmp_path):
    other = write_png(tmp_path / "other.png", photo(seed=99))
    plain = write_png(tmp_path / "plain.png", np.full((210, 297, 3), 200, np.uint8))
    for k, path in enumerate((other, plain)):
        message = refused(capture, clip[0], str(tmp_path / f"out{k}"), **given(clip, texture=path))
        assert (
            "--corners" in message
            and f"out{k}.matches.png" in message
            and os.path.isfile(tmp_path / f"out{k}.matches.png")
        )
        assert not (tmp_path / f"out{k}").exists()
    flipped = write_png(tmp_path / "flipped.png", images.read_rgb(clip[1])[:, ::-1])
    assert "mirror" in refused(
        capture, clip[0], str(tmp_path / "out2"), **given(clip, texture=flipped)
    )
    assert "not a readable image" in refused(
        capture, clip[0], str(tmp_path / "out3"), **given(clip, texture=clip[0])
    )
    assert (
        "no such file"
        in refused(
            capture,
            clip[0],
            str(tmp_path / "out3"),
            **given(clip, texture=str(tmp_path / "none.jpg")),
        ).lower()
    )


def test_fewer_than_four_matches():
    made = pose.Matches(
        np.random.default_rng(0).random((3, 2)), np.zeros((3, 2)), np.zeros(3, bool)
    )
    found, after = pose.from_matches(made, sheet.grid(WIDTH, HEIGHT, 5), CAMERA)
    assert found is None and not after.agree.any()


@pytest.mark.parametrize(
    "corners, said",
    [
        ([(900, 10), (1100, 10), (1100, 150), (900, 150)], "0 % of the sheet is in view"),
        ([(50, 40), (60, 160), (250, 170), (240, 30)], "against the clock"),
        ([(50, 40), (240, 170), (240, 30), (60, 160)], "quadrangle"),
        ([(50, 40), (60, 40), (70, 40), (80, 40)], "quadrangle"),
    ],
)
def test_corners_that_cannot_be(corners, said, clip, tmp_path):
    assert said in refused(capture, clip[0], str(tmp_path / "out"), corners=corners, **given(clip))
    assert os.listdir(tmp_path) == []


def test_what_does_not_go_together(clip, tmp_path):
    call = lambda **o: refused(capture, clip[0], str(tmp_path / "out"), **{**given(clip), **o})
    assert "one of them" in call(fov=60)
    assert "--size" in call(template=str(DEMO / "template.obj"))
    assert "--size" in call(size=None)
    assert "--corners" in call(texture="first-frame")
    assert "--size 0.297 0.21?" in call(size=["210mm", "297mm"])
    assert "16" in call(scale=0.01)
    assert "400" in call(resolution=1)
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 100, "height": 100}))
    assert "320x240" in call(camera=str(camera))
    camera.write_text(
        json.dumps(
            {
                "fx": 330,
                "fy": 330,
                "cx": 160,
                "cy": 120,
                "width": 320,
                "height": 240,
                "distortion": [1, 2],
            }
        )
    )
    assert "distortion" in call(camera=str(camera))
    obj = tmp_path / "large.obj"
    vertices, faces, uv = meshio.read_template(DEMO / "template.obj")
    prepare.write_obj(obj, 1000 * vertices, faces, uv)
    assert "millimetres" in call(size=None, template=str(obj))
    assert sorted(os.listdir(tmp_path)) == ["camera.json", "large.obj"]


def test_inputs_are_not_replaced(clip, tmp_path):
    folder = str(Path(clip[0]).parent)
    assert "lies in it" in refused(capture, clip[0], folder, overwrite=True, **given(clip))
    (tmp_path / "file").write_text("")
    assert "is a file" in refused(capture, clip[0], str(tmp_path / "file"), **given(clip))


def test_nothing_is_left_of_an_interrupted_run(clip, tmp_path):
    def stop(count):
        if count == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        capture(clip[0], str(tmp_path / "out"), progress=stop, **given(clip))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "words, said",
    [
        ([], "needs --texture"),
        (
            ["--texture", "first-frame", "--size", "A4", "--fov", "60", "--corners", "1,2", "3,4"],
            "four points",
        ),
        (
            [
                "--texture",
                "first-frame",
                "--size",
                "A4",
                "--fov",
                "60",
                "--corners",
                "a,b",
                "1,2",
                "3,4",
                "5,6",
            ],
            "four points",
        ),
    ],
)
def test_words_of_the_command_line(words, said, clip):
    assert said in refused(prepare.main, [clip[0], *words])


def test_options_for_videos_are_refused_for_folders(tmp_path):
    assert "--fov" in refused(prepare.main, [str(DEMO), "--fov", "60"])


def test_print_that_the_benchmark_rectifies(tmp_path):
    import synthetic

    truth = synthetic.kinect_paper(tmp_path / "data", frames=1, size=(320, 240))
    got = load("benchmarks/prepare.py").rectified_print(str(truth.folder))
    wanted = cv2.flip(
        synthetic.texture_image(), 0
    )  # there the template's first row is the print's highest, in Kinect-Paper its lowest
    assert (
        np.abs(cv2.resize(got, (64, 64), interpolation=cv2.INTER_AREA).astype(int) - wanted)[
            2:-2, 2:-2
        ].mean()
        < 6
    )


def test_bent_first_frame_is_said(tmp_path):
    """Matches of a sheet that is a cylinder, against the flat one."""
    flat = sheet.grid(WIDTH, HEIGHT, 33)
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
        found, after = pose.from_matches(
            pose.Matches(flat.uv.clip(1e-6, 1 - 1e-6), pixels, np.zeros(len(x), bool)), flat, CAMERA
        )
        missed = np.sqrt((found.residual**2).mean()) / np.hypot(320, 240)
        lines.append(missed > folder._BENT)
        assert after.agree.sum() >= pose.LEAST
    assert lines == [False, True]
