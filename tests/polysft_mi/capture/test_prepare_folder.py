"""Scene files for the three forms of folders: recognised, complete, geometrically right, or refused
in one line.
"""

import dataclasses
import json
import os
import pickle
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from loading import difference, loaded
from scipy.spatial.transform import Rotation

from polysft_mi import prepare
from polysft_mi.capture import prepare_folder, recognise
from polysft_mi.errors import InputError
from polysft_mi.render import Pinhole
from polysft_mi.scene.sequence import Sequence
from polysft_mi.scene.settings import Settings

FORMS = {
    "cloth": synthetic.cloth,
    "phi-SfT": synthetic.phi_sft,
    "Kinect-Paper": synthetic.kinect_paper,
}


def refused(*arguments, **options):
    with pytest.raises(InputError) as caught:
        prepare_folder(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("form", FORMS)
def test_prepared_scene_shows_frame_0(form, tmp_path):
    truth = FORMS[form](tmp_path / "a sequence", frames=3)
    path, line = prepare_folder(str(truth.folder), pose_fit="none")
    assert form in line and "3 frames of 96x72" in line
    assert ("without masks" if form == "Kinect-Paper" else "with masks") in line
    experiment = loaded(path)
    right, *mirrored = difference(experiment)
    assert right < 0.015 and min(mirrored) > 5 * right
    if form == "Kinect-Paper":
        # 33 points a side of a grid of 5 rows and 6 columns: every 8th row is one of its own, and
        # so are the corners
        grid = experiment.template.vertices.reshape(33, 33, 3)
        np.testing.assert_allclose(
            grid[::8, [0, -1]], truth.vertices[0].reshape(5, 6, 3)[:, [0, -1]], atol=1e-6
        )
    else:
        np.testing.assert_allclose(experiment.template.vertices, truth.vertices[0], atol=1e-6)
        template = experiment.template
        uv = template.texcoords.of_vertices(template.faces)
        np.testing.assert_allclose(uv, truth.uv, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_scene_beside_or_away_from_the_data(form, tmp_path, monkeypatch):
    truth = FORMS[form](tmp_path / "data", frames=2)
    monkeypatch.chdir(tmp_path)
    beside, _ = prepare_folder("data", pose_fit="none")
    away, _ = prepare_folder("data", "somewhere/else", pose_fit="none")
    monkeypatch.chdir(tmp_path / "somewhere")
    folders = [
        ET.parse(tmp_path / p).find("default[@name='data']").get("value") for p in (beside, away)
    ]
    assert folders == [".", str(truth.folder)]
    a, b = (loaded(str(tmp_path / p)) for p in (beside, away))
    np.testing.assert_array_equal(a.template.vertices, b.template.vertices)
    truth.folder.rename(tmp_path / "moved")
    np.testing.assert_array_equal(
        loaded(str(tmp_path / "moved" / "scene.xml")).template.vertices, b.template.vertices
    )


def test_every_setting_can_be_overridden(tmp_path):
    path, _ = prepare_folder(str(synthetic.cloth(tmp_path / "data", frames=2).folder))
    assert {f.name for f in dataclasses.fields(Settings)} <= {
        e.get("name") for e in ET.parse(path).iter("default")
    }
    s = loaded(path, order=3, k_mi=0.25, rgb_norm="l1", masks="").settings
    assert (s.order, s.k_mi, s.rgb_norm) == (3, 0.25, "l1")


def test_tracks_and_depth_are_checked_and_named(tmp_path, capsys):
    folder = synthetic.cloth(tmp_path / "a", frames=3).folder
    np.savez(folder / "tracks.npz", tracks=np.full((3, 5, 2), 40.0))
    (tmp_path / "depth").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "depth" / f"{k}.png"), np.full((72, 96), 600, np.uint16))
    words = [str(folder), "--tracks", str(folder / "tracks.npz"), "--depth-known-to", "affine"]
    prepare.main([*words, "--depth", str(tmp_path / "depth"), "--overwrite"])
    assert "with tracks, with depth" in capsys.readouterr().out
    text = (folder / "scene.xml").read_text()
    assert '<default name="tracks" value="$data/tracks.npz"/>' in text
    assert '<default name="depth_known_to" value="affine"/>' in text
    sequence = loaded(str(folder / "scene.xml")).sequence()
    assert sequence.tracks.positions.shape == (3, 5, 2)
    assert np.allclose(sequence.depth.read(2), 0.6)
    before = (folder / "scene.xml").read_bytes()
    (tmp_path / "depth" / "2.png").unlink()
    said = refused(str(folder), overwrite=True, depth=str(tmp_path / "depth"))
    assert "2 depth images for 3 frames" in said
    assert (folder / "scene.xml").read_bytes() == before


def test_a_picture_shows_how_all_of_it_lies_in_the_first_frame(tmp_path):
    truth = synthetic.cloth(tmp_path / "a", frames=2)
    np.savez(tmp_path / "tracks.npz", tracks=np.tile(((10.0, 60.0), (48.0, 36.0)), (2, 1, 1)))
    (tmp_path / "depth").mkdir()
    near = np.full((72, 96), 500, np.uint16)  # [mm]: the sheet is flat, and faces the camera
    near[:, 48:] += 30
    for k in range(2):
        cv2.imwrite(str(tmp_path / "depth" / f"{k}.png"), near)
    given = dict(tracks=str(tmp_path / "tracks.npz"), depth=str(tmp_path / "depth"))
    _, said = prepare_folder(str(truth.folder), str(tmp_path / "out"), **given)
    path = tmp_path / "out" / "prepare" / "pose.png"
    assert f"{path} shows" in said
    picture = cv2.imread(str(path))[..., ::-1]
    assert picture.shape == (480, 3 * 640 + 2 * 4, 3)
    known, depth = (picture[:, k : k + 640].astype(int) for k in (0, 2 * 644))
    scale = 480 / 72
    assert np.ptp(depth[240, round(44 * scale)]) < 20 and np.ptp(depth[240, round(52 * scale)]) > 99
    assert known[round(60 * scale), round(10 * scale)].argmax() == 2  # the track
    red = np.abs(known - (235, 70, 60)).max(-1) < 25
    mask = cv2.imread(str(min((truth.folder / "masks").iterdir())), 0)
    border = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3)))
    border = cv2.resize(border, (640, 480), interpolation=cv2.INTER_NEAREST) > 0
    assert red.sum() > 200 and (red & border).sum() > 0.9 * red.sum()


def test_other_names_and_no_masks(tmp_path):
    truth = synthetic.phi_sft(tmp_path / "data", frames=2, masks=False, obj="cloth 7.obj")
    (truth.folder / "texture.png").rename(truth.folder / "print.png")
    layout = recognise(str(truth.folder))
    assert (layout.obj, layout.texture, layout.masks, layout.flip) == (
        "cloth 7.obj",
        "print.png",
        "",
        True,
    )
    assert "without masks" in prepare_folder(str(truth.folder))[1]
    synthetic.write_image(truth.folder / "preview.png", np.zeros((4, 4, 3), np.uint8))
    assert "preview.png, print.png" in refused(str(truth.folder))
    (truth.folder / "print.png").rename(truth.folder / "texture.png")
    assert recognise(str(truth.folder)).texture == "texture.png"


def test_paths_that_xml_must_quote(tmp_path):
    truth = synthetic.cloth(tmp_path / 'a & b\'s "c" <d> [1]', frames=2)
    path, _ = prepare_folder(str(truth.folder), str(tmp_path / "out"))
    assert len(Sequence.open(loaded(path).frames)) == 2
    truth.folder.rename(tmp_path / "cash $x")
    assert "'$'" in refused(str(tmp_path / "cash $x"), str(tmp_path / "out2"))
    assert not (tmp_path / "out2").exists()


def test_unknown_folders(tmp_path):
    (tmp_path / "empty").mkdir()
    message = refused(str(tmp_path / "empty"))
    assert all(name in message for name in ("frames/", "rgbs/", "mesh.pts", "camera.json"))
    assert "nowhere: no such file or folder" in refused(str(tmp_path / "nowhere"))
    assert "folder" in refused(__file__)


@pytest.mark.parametrize(
    "form, name",
    [
        ("cloth", "camera.json"),
        ("cloth", "template.obj"),
        ("cloth", "texture.png"),
        ("phi-SfT", "0_S3_quad.obj"),
        ("phi-SfT", "camera.json"),
    ]
    + [("Kinect-Paper", name) for name in ("cam.intr", "cam.ext", "mesh.pts", "mesh.tri")],
)
def test_missing_pieces_are_named(form, name, tmp_path):
    folder = FORMS[form](tmp_path / "data", frames=2).folder
    (folder / name).unlink()
    message = refused(str(folder), str(tmp_path / "out"))
    assert (
        form in message
        and {".obj": "an OBJ file", ".png": "texture"}.get(Path(name).suffix, name) in message
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("cam.intr", "100 2 48\n0 100 36\n0 0 1\n", "skew"),
        ("cam.intr", "100 0 48\n0 100 36\n", "3x3"),
        ("cam.intr", "100 0 x\n0 100 36\n0 0 1\n", "numbers"),
        ("cam.ext", "2 0 0 0\n0 1 0 0\n0 0 1 500\n", "rotation"),
        ("cam.ext", "1 0 0 0\n0 1 0 0\n0 0 1 -500\n", "behind the camera"),
        ("cam.ext", "1 0 0 5000\n0 1 0 0\n0 0 1 500\n", "out of view"),
        ("cam.ext", "1 0 0 nan\n0 1 0 0\n0 0 1 500\n", "finite"),
        ("mesh.pts", "0 0 0\n1 0 0\n0 1 0\n", "grid"),
        ("mesh.tri", "0 1 2\n", "grid"),
        ("mesh.tri", "0 1 -6\n", "indices"),
        ("mesh.pts", "", "Nx3"),
    ],
)
def test_bad_kinect_paper_files(name, text, said, tmp_path):
    folder = synthetic.kinect_paper(tmp_path / "data", frames=1).folder
    (folder / name).write_text(text)
    message = refused(str(folder))
    assert said in message and ("mesh" in message or name in message)
    assert not (folder / "scene.xml").exists() and not (folder / "template.obj").exists()


def test_template_and_frames_are_checked(tmp_path):
    truth = synthetic.cloth(tmp_path / "data", frames=2)
    obj, camera = truth.folder / "template.obj", truth.folder / "camera.json"
    good = obj.read_text()
    synthetic.write_obj(obj, truth.vertices[0] * (1, 1, -1), truth.uv, truth.faces)
    assert "behind the camera" in refused(str(truth.folder))
    synthetic.write_obj(obj, truth.vertices[0] + (5, 0, 0), truth.uv, truth.faces)
    assert "out of view" in refused(str(truth.folder))
    obj.write_text(good)
    masks = sorted((truth.folder / "masks").iterdir())
    kept = cv2.imread(str(masks[0]), 0)
    cv2.imwrite(str(masks[0]), 255 - kept)
    assert "is it inverted? White is the sheet" in refused(str(truth.folder))
    cv2.imwrite(str(masks[0]), kept)
    obj.write_text(
        "\n".join(
            line.replace("/", " ") if line[0] == "f" else line
            for line in good.splitlines()
            if not line.startswith("vt")
        )
    )
    assert "template.obj" in refused(str(truth.folder))
    obj.write_text(good)
    values = json.loads(camera.read_text())
    camera.write_text(json.dumps({**values, "width": 100}))
    assert "100x72" in refused(str(truth.folder))
    camera.write_text(json.dumps({**values, "fx": 0}))
    assert "camera.json" in refused(str(truth.folder))


def test_files_that_are_there_stay(tmp_path):
    folder = synthetic.kinect_paper(tmp_path / "data", frames=1).folder
    prepare_folder(str(folder), resolution=5, pose_fit="none")
    before = {name: (folder / name).read_bytes() for name in ("scene.xml", "template.obj")}
    assert "--overwrite" in refused(str(folder), pose_fit="none")
    (folder / "scene.xml").unlink()
    assert "template.obj" in refused(str(folder), pose_fit="none")
    assert not (folder / "scene.xml").exists()
    prepare_folder(str(folder), resolution=9, overwrite=True, pose_fit="none")
    assert (folder / "scene.xml").read_bytes() == before["scene.xml"] and (
        folder / "template.obj"
    ).read_bytes() != before["template.obj"]


def test_folder_that_cannot_be_written(tmp_path):
    folder = synthetic.cloth(tmp_path / "data", frames=1).folder
    (tmp_path / "file").write_text("")
    assert "file" in refused(str(folder), str(tmp_path / "file" / "out"))
    if os.geteuid() != 0:  # root writes everywhere
        folder.chmod(0o555)
        assert "-o DIR" in refused(str(folder))
        folder.chmod(0o755)


def test_command_line(tmp_path, capsys):
    words = [str(synthetic.cloth(tmp_path / "data", frames=2).folder), "-o", str(tmp_path / "out")]
    prepare.main(words)
    said = capsys.readouterr().out
    assert "template of 99 vertices" in said
    assert f"python -m polysft_mi.run {tmp_path / 'out' / 'scene.xml'}" in said
    with pytest.raises(InputError, match="--overwrite"):
        prepare.main(words)


def test_a_body_says_where_the_camera_stands(tmp_path):
    """The scene's world is the body's, and the template is not looked for in the image."""
    folder, frames = synthetic.cloth(tmp_path / "a", frames=3).folder, 3
    body = {"poses": np.zeros((frames, 24, 3)), "translation": np.zeros((frames, 3))}
    np.savez(tmp_path / "body.npz", **body)
    words = [str(folder), "--body", str(tmp_path / "body.npz"), "-o", str(tmp_path / "out")]
    with pytest.raises(InputError, match=r"camera.json: world_to_camera is missing"):
        prepare.main(words)
    assert not (tmp_path / "out").exists()
    camera = json.loads((folder / "camera.json").read_text())
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    pose = np.vstack([np.column_stack([turn, (0.1, 0.2, 3.0)]), (0, 0, 0, 1)])
    (folder / "camera.json").write_text(json.dumps(camera | {"world_to_camera": pose.tolist()}))
    prepare.main(words)
    experiment = loaded(str(tmp_path / "out" / "scene.xml"))
    assert experiment.settings.body == str(tmp_path / "body.npz")
    seen = Pinhole(experiment.sensor)
    np.testing.assert_allclose(seen.axes, turn, atol=1e-5)
    np.testing.assert_allclose(seen.origin, -turn.T @ pose[:3, 3], atol=1e-5)
    for place, why in (((50, 0, 0), "out of the camera's view"), ((0, 0, 90), "too far away")):
        away = body["translation"] + turn.T @ place
        np.savez(tmp_path / "body.npz", poses=body["poses"], translation=away)
        with pytest.raises(InputError, match=f"body.npz: in the first frame the body is {why}"):
            prepare.main([*words, "--overwrite"])
    np.savez(tmp_path / "body.npz", poses=body["poses"][1:], translation=body["translation"][1:])
    with pytest.raises(InputError, match="frames, the video's, are needed"):
        prepare.main([*words, "--overwrite"])


def test_a_body_of_smpl_s_family(tmp_path):
    """Its model and the axis that is up go into the scene; without the model its motion is none."""
    folder, frames = synthetic.cloth(tmp_path / "a", frames=3).folder, 3
    camera = json.loads((folder / "camera.json").read_text())
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = 3
    (folder / "camera.json").write_text(json.dumps(camera | {"world_to_camera": pose.tolist()}))
    motion = {"poses": np.zeros((frames, 72)), "trans": np.zeros((frames, 3))}
    np.savez(tmp_path / "smpl.npz", **motion, betas=np.zeros(10))
    words = [str(folder), "--body", str(tmp_path / "smpl.npz"), "-o", str(tmp_path / "out")]
    with pytest.raises(InputError, match="has betas, so its poses are SMPL's.*--body-model"):
        prepare.main(words)
    words += ["--body-model", str(tmp_path / "SMPL.pkl"), "--body-up", "y"]
    with pytest.raises(InputError, match="SMPL.pkl: no such file of a body"):
        prepare.main(words)
    (tmp_path / "SMPL.pkl").write_bytes(b"")
    pytest.importorskip("torch")
    with pytest.raises(InputError, match="SMPL.pkl: cannot be read as a body"):
        prepare.main(words)
    onefit, standing = pytest.importorskip("onefit"), pytest.importorskip("standing")
    contents = standing.smpl_contents(onefit.AnnyBody().body())
    (tmp_path / "SMPL.pkl").write_bytes(pickle.dumps(contents))
    prepare.main(words)
    settings = loaded(str(tmp_path / "out" / "scene.xml")).settings
    assert settings.body_model == str(tmp_path / "SMPL.pkl") and settings.body_up == "y"
    with pytest.raises(InputError, match="--body-model: is of a body; --body names"):
        prepare.main([str(folder), "--body-model", "x.pkl", "-o", str(tmp_path / "other")])


def test_a_body_is_for_a_folder(tmp_path):
    video = tmp_path / "clip.mp4"
    video.write_bytes(b"")
    with pytest.raises(InputError, match="--body is for a folder in a known form"):
        prepare.main([str(video), "--body", "body.npz", "-o", str(tmp_path / "out")])
