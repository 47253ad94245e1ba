"""A sequence's folder from a video and a photo, against what is known of the video."""

import dataclasses
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from clips import (
    CAMERA,
    DEMO,
    HEIGHT,
    WIDTH,
    background,
    given,
    photo,
    placed,
    refused,
    rendered,
    write_png,
)
from loading import difference, loaded
from scripts import load

from polyfit.pictures import write_video
from polysft_mi import prepare
from polysft_mi.camera import Intrinsics
from polysft_mi.capture import GivenEvidence, iou, prepare_video
from polysft_mi.capture.camera import Undistortion, read_lens
from polysft_mi.scene.images import read_rgb
from polysft_mi.surface import meshio


def test_folder_of_a_video(clip, tmp_path):
    lines, out = [], str(tmp_path / "aus gabe é")
    scene_path, found = prepare_video(clip[0], out, say=lines.append, **given(clip))
    wanted = "camera.json frames masks prepare scene.xml template.obj texture.png"
    assert sorted(os.listdir(out)) == wanted.split()
    assert sorted(os.listdir(tmp_path)) == ["aus gabe é"]  # nothing beside it
    wanted = "frames.png masks.png matches.png pose.png prepare.json"
    assert sorted(os.listdir(f"{out}/prepare")) == wanted.split()
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
        mask = read_rgb(f"{out}/masks/{k:05d}.png")[..., 0]
        assert iou(mask, cover) > 0.97

    import mitsuba as mi

    from polysft_mi.scene import experiment as scene

    experiment = scene.load(scene_path)
    image = np.array(mi.render(experiment.scene, sensor=experiment.sensor, spp=1))
    frame = experiment.sequence().frame(0)
    inside = image[..., 3] > 0.999
    right, upside_down, mirrored = (
        np.abs(image[..., :3] - x)[inside].mean() for x in (frame, frame[::-1], frame[:, ::-1])
    )
    assert inside.mean() > 0.2 and right < 0.05 and min(upside_down, mirrored) > 3 * right


def test_demo_is_found_by_its_texture(tmp_path):
    """With the demo's own mesh as the template."""
    write_video(
        tmp_path / "demo.mp4",
        [read_rgb(p) for p in sorted((DEMO / "frames").glob("*.jpg"))[:3]],
    )
    prepare_video(
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
            read_rgb(p)[..., 0]
            for p in (tmp_path / "demo" / "masks" / f"{k:05d}.png", DEMO / "masks" / f"{k:03d}.png")
        )
        assert iou(found, drawn) > 0.97


def test_a_tube_is_found_by_its_photo(tmp_path):
    """A template that hides a part of itself, and whose texture has a seam."""
    camera = Intrinsics(660.0, 660.0, 324.0, 234.0, 640, 480)
    faces, texcoords = synthetic.tube_faces(13, 32)
    print_ = photo(size=(660, 525))
    for k in range(2):
        V = synthetic.tube(0.3 * k, 13, 32, radius=0.1, height=0.5, depth=0.9)
        image, cover = synthetic.render(V, faces, texcoords, camera.matrix(), (640, 480), print_)
        behind = background((640, 480))
        image = image * cover[..., None] + behind * (1 - cover[..., None])
        write_png(tmp_path / "frames" / f"{k}.png", np.round(image).astype(np.uint8))
    truth = synthetic.tube(0, 13, 32, radius=0.1, height=0.5, depth=0.9)
    turn = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))[0]
    synthetic.write_obj(tmp_path / "tube.obj", (truth - (0, 0, 1)) @ turn, texcoords, faces)
    out, figures = prepare_video(
        str(tmp_path / "frames"),
        str(tmp_path / "out"),
        texture=write_png(tmp_path / "photo.png", print_),
        template=str(tmp_path / "tube.obj"),
        camera=str(_camera_file(tmp_path, camera)),
    )
    vertices, found, uv = meshio.read_textured_template(tmp_path / "out" / "template.obj")
    np.testing.assert_array_equal(found, faces)
    np.testing.assert_allclose(uv.corners, texcoords.corners, atol=1e-6)
    assert np.linalg.norm(vertices - truth, axis=1).max() < 5e-3
    assert "patches" in figures["template"]
    right, *mirrored = difference(loaded(out))
    assert right < 0.05 and min(mirrored) > 2 * right


def _camera_file(folder, camera):
    path = folder / "camera.json"
    path.write_text(json.dumps(dataclasses.asdict(camera)))
    return path


def test_corners_and_the_first_frame_as_texture(clip, tmp_path):
    R, t = placed(2 / 11)
    corners = CAMERA.project(
        np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        * (WIDTH / 2, HEIGHT / 2, 0)
        @ R.T
        + t
    )
    _, found = prepare_video(
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
        pose_fit="none",
    )
    assert found["indices"] == [2, 5, 8]
    vertices, _, uv = meshio.read_template(tmp_path / "out" / "template.obj")
    assert np.linalg.norm(vertices.mean(0) - t) < 1e-8
    camera = Intrinsics.from_json(tmp_path / "out" / "camera.json")
    assert (camera.width, camera.height, camera.fx, camera.cx) == (160, 120, 165, 81)
    np.testing.assert_allclose(
        uv * (160, -120) + (0, 120), camera.project(vertices), atol=1e-3
    )  # the texture is the frame
    assert not (tmp_path / "out" / "masks").exists() and read_rgb(
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
        _, found[fit] = prepare_video(
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
    words = "--texture first-frame --size 40cm 30cm --fov 50 --corners frame --no-masks".split()
    words += "--scale 0.5 --last 1 -q".split()
    prepare.main([clip[0], *words, "-o", str(tmp_path / "out")])
    vertices, _, uv = meshio.read_template(tmp_path / "out" / "template.obj")
    assert (uv.min(), uv.max()) == pytest.approx((0, 1), abs=1e-3)
    assert np.ptp(vertices, axis=0) == pytest.approx((0.4, 0.3, 0), abs=1e-3)
    assert vertices[:, 2].mean() == pytest.approx(0.2 / np.tan(np.radians(25)), rel=1e-3)


def test_photo_that_shows_more_than_the_sheet(clip, tmp_path):
    straight = read_rgb(clip[1])
    corners = np.float32([(70, 60), (690, 95), (660, 520), (50, 480)])
    H = cv2.getPerspectiveTransform(np.float32([(0, 0), (594, 0), (594, 420), (0, 420)]), corners)
    wider = cv2.warpPerspective(straight, H, (760, 600), borderValue=(60, 60, 60))
    prepare_video(
        clip[0],
        str(tmp_path / "out"),
        last=1,
        **given(clip, texture=write_png(tmp_path / "wider.png", wider), size=["A4"]),
        texture_corners=corners,
    )
    texture = read_rgb(tmp_path / "out" / "texture.png")
    assert abs(texture.shape[1] / texture.shape[0] - WIDTH / HEIGHT) < 0.01
    assert np.abs(cv2.resize(texture, (594, 420)).astype(int) - straight).mean() < 12
    vertices, _, _ = meshio.read_template(tmp_path / "out" / "template.obj")
    assert np.linalg.norm(vertices.mean(0) - placed()[1]) < 2e-3


def test_given_masks(clip, tmp_path):
    for k, cover in enumerate(clip[3]):
        write_png(tmp_path / "given" / f"{k}.png", np.round(255 * cover).astype(np.uint8))
    prepare_video(
        clip[0],
        str(tmp_path / "out"),
        masks=str(tmp_path / "given"),
        first=4,
        last=6,
        **given(clip),
    )
    assert (
        np.abs(read_rgb(tmp_path / "out" / "masks" / "00002.png")[..., 0] / 255 - clip[3][6]).max()
        < 0.01
    )
    (tmp_path / "given" / "11.png").unlink()
    assert "11 masks" in refused(
        prepare_video, clip[0], str(tmp_path / "b"), masks=str(tmp_path / "given"), **given(clip)
    )
    assert "no such folder" in refused(
        prepare_video,
        clip[0],
        str(tmp_path / "b"),
        masks=str(tmp_path / "none" / "x"),
        **given(clip),
    )
    assert not (tmp_path / "b").exists()


def test_given_tracks_and_depth(clip, tmp_path):
    """They follow the frames: those that are used, undistorted, scaled; the scene names them."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(20, 80, (12, 20, 2))
    visible = rng.uniform(size=(12, 20)) < 0.8
    np.savez(tmp_path / "tracks.npz", tracks=positions - 0.5, visible=visible)
    for k in range(12):
        depth = np.full((CAMERA.height // 2, CAMERA.width // 2), 500 + k, np.uint16)
        depth[:, : CAMERA.width // 10] = 0  # a fifth
        write_png(tmp_path / "depth" / f"{k}.png", depth)
    bent = dict(given(clip))
    camera = json.loads(Path(bent["camera"]).read_text()) | {"distortion": [-0.2, 0.05, 0, 0]}
    bent["camera"] = str(tmp_path / "camera.json")
    Path(bent["camera"]).write_text(json.dumps(camera))
    evidence = GivenEvidence(str(tmp_path / "tracks.npz"), 0.0, str(tmp_path / "depth"))
    lines = []
    scene, found = prepare_video(
        clip[0],
        str(tmp_path / "out"),
        evidence=evidence,
        first=2,
        last=8,
        stride=3,
        scale=0.5,
        say=lines.append,
        **bent,
    )
    assert any(line.startswith("tracks: 20 of") for line in lines)
    assert any(line.startswith("depth: ") for line in lines)
    experiment = loaded(scene)
    sequence, used = experiment.sequence(), [2, 5, 8]
    assert found["indices"] == used
    straight = Undistortion(read_lens(bent["camera"], CAMERA.width, CAMERA.height), 0.5)
    for k, frame in enumerate(used):
        seen = sequence.tracks.visible[k]
        assert np.array_equal(seen, visible[frame])
        expected = straight.points(positions[frame])
        assert np.abs(sequence.tracks.positions[k] - expected)[seen].max() < 1e-3
        depth = sequence.depth.read(k)
        assert depth.shape == (experiment.size[1], experiment.size[0])
        middle = depth[:, depth.shape[1] // 3 : -depth.shape[1] // 3]
        assert np.allclose(middle, (500 + frame) * 1e-3)
        assert (depth[:, : depth.shape[1] // 12] == 0).all()
    short = GivenEvidence(depth=str(tmp_path / "few"))
    write_png(tmp_path / "few" / "0.png", np.full((CAMERA.height, CAMERA.width), 500, np.uint16))
    said = refused(prepare_video, clip[0], str(tmp_path / "b"), evidence=short, **given(clip))
    assert "1 depth images for 12 frames" in said
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("last", [-1, 8])
def test_tracks_of_a_video_may_have_points_first(last, clip, tmp_path):
    """As many frames as the video has say which axis is theirs, also where not all are used; what
    is of another length is refused before the work.
    """
    positions = np.random.default_rng(0).uniform(20, 80, (12, 20, 2))
    lines, path = [], tmp_path / "tracks.npz"
    call = dict(last=last, say=lines.append, masks=False, **given(clip))
    np.savez(path, tracks=positions.swapaxes(0, 1))
    scene, found = prepare_video(
        clip[0], str(tmp_path / "out"), evidence=GivenEvidence(str(path)), **call
    )
    tracks = loaded(scene).sequence().tracks
    assert np.allclose(tracks.positions, positions[found["indices"]], atol=1e-3)
    assert any(line.startswith("tracks: 20 of") for line in lines)
    for wrong in (positions[:11], np.concatenate([positions, positions])):
        np.savez(path, tracks=wrong)
        lines.clear()
        said = refused(
            prepare_video, clip[0], str(tmp_path / "b"), evidence=GivenEvidence(str(path)), **call
        )
        used = "" if last == -1 else " or 9"
        assert f"tracks is {wrong.shape}; 12{used} frames, the video's" in said
        assert lines == [] and not (tmp_path / "b").exists()


def test_masks_that_cannot_be_believed_are_not_used(clip, tmp_path):
    for k, image in enumerate([rendered(photo())[0], background()]):  # the sheet is gone
        write_png(tmp_path / "in" / f"{k}.png", image)
    lines = []
    _, found = prepare_video(
        str(tmp_path / "in"), str(tmp_path / "out"), say=lines.append, **given(clip)
    )
    assert not found["masks"]["used"] and any(
        "not used: in frame 1 the colours inside are not" in line for line in lines
    )
    assert (
        not (tmp_path / "out" / "masks").exists()
        and (tmp_path / "out" / "prepare" / "masks.png").exists()
    )
    assert 'name="masks" value=""' in (tmp_path / "out" / "scene.xml").read_text()


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
