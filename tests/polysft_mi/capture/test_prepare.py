"""Scene files for the three forms of folders: recognised, complete, geometrically right, and
refused in one line where they cannot be.
"""

import dataclasses
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from places import ROOT
from scripts import load

from polysft_mi.errors import InputError
from polysft_mi.prepare import Layout, prepare, recognise, scene_xml
from polysft_mi.scene import kinect_paper
from polysft_mi.scene.kinect_paper import template as kinect_paper_template
from polysft_mi.scene.sequence import Sequence
from polysft_mi.scene.settings import Settings
from polysft_mi.surface import meshio

FORMS = {
    "cloth": synthetic.cloth,
    "phi-SfT": synthetic.phi_sft,
    "Kinect-Paper": synthetic.kinect_paper,
}
write_scenes = load("scenes/write_scenes.py")


def refused(*arguments, **options):
    with pytest.raises(InputError) as caught:
        prepare(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def loaded(path, **overrides):
    from polysft_mi.scene import experiment as scene

    return scene.load(path, overrides)


def difference(experiment):
    """Mean absolute difference, inside the silhouette, of the rendered template and frame 0; and
    the same for the two mirror images.
    """
    import mitsuba as mi

    frame = Sequence.open(experiment.frames, experiment.masks, size=experiment.size).frame(0)
    image = np.array(mi.render(experiment.scene, sensor=experiment.sensor, spp=1))
    inside = image[..., 3] > 0.999
    rgb = image[..., :3]
    assert 0.02 < inside.mean() < 0.9
    return [np.abs(x - frame)[inside].mean() for x in (rgb, rgb[::-1], rgb[:, ::-1])]


@pytest.mark.parametrize("form", FORMS)
def test_prepared_scene_shows_frame_0(form, tmp_path):
    truth = FORMS[form](tmp_path / "a sequence", frames=3)
    path, line = prepare(str(truth.folder), pose_fit="none")
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
        np.testing.assert_allclose(experiment.template.uv, truth.uv, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_scene_beside_or_away_from_the_data(form, tmp_path, monkeypatch):
    truth = FORMS[form](tmp_path / "data", frames=2)
    monkeypatch.chdir(tmp_path)
    beside, _ = prepare("data")
    away, _ = prepare("data", "somewhere/else")
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
    path, _ = prepare(str(synthetic.cloth(tmp_path / "data", frames=2).folder))
    assert {f.name for f in dataclasses.fields(Settings)} <= {
        e.get("name") for e in ET.parse(path).iter("default")
    }
    s = loaded(path, order=3, k_mi=0.25, rgb_norm="l1", masks="").settings
    assert (s.order, s.k_mi, s.rgb_norm) == (3, 0.25, "l1")


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
    assert "without masks" in prepare(str(truth.folder))[1]
    synthetic.write_image(truth.folder / "preview.png", np.zeros((4, 4, 3), np.uint8))
    assert "preview.png, print.png" in refused(str(truth.folder))
    (truth.folder / "print.png").rename(truth.folder / "texture.png")
    assert recognise(str(truth.folder)).texture == "texture.png"


def test_paths_that_xml_must_quote(tmp_path):
    truth = synthetic.cloth(tmp_path / 'a & b\'s "c" <d> [1]', frames=2)
    path, _ = prepare(str(truth.folder), str(tmp_path / "out"))
    assert len(Sequence.open(loaded(path).frames)) == 2
    truth.folder.rename(tmp_path / "cash $x")
    assert "'$'" in refused(str(tmp_path / "cash $x"), str(tmp_path / "out2"))
    assert not (tmp_path / "out2").exists()


# ---- Kinect-Paper's template ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "rows, columns, resolution", [(5, 6, 33), (9, 9, 17), (3, 2, 5), (2, 2, 6)]
)
def test_kinect_paper_template(tmp_path, rows, columns, resolution):
    truth = synthetic.kinect_paper(tmp_path / "data", frames=1, rows=rows, columns=columns)
    vertices, faces, uv = kinect_paper_template(str(truth.folder), resolution, "none")
    meshio.check_template(vertices, faces, uv)
    assert vertices.shape == (resolution**2, 3) and len(faces) == 2 * (resolution - 1) ** 2
    np.testing.assert_allclose(
        vertices, synthetic.sheet(0, resolution, resolution), atol=1e-9
    )  # the sheet is flat and evenly spaced
    normals = [
        np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
        for v, f in ((vertices, faces), (truth.vertices[0], truth.faces))
    ]
    assert (normals[0] @ normals[1].mean(0) > 0).all()
    # uv is a place in frame 1: the texture's colours are found there
    image = cv2.imread(str(truth.folder / "frame_001.png"))[..., ::-1]
    extent = np.ptp(vertices[:, :2], axis=0)
    keep = (np.abs(vertices[:, :2]) < 0.42 * extent).all(axis=1)
    at = uv[keep] * (96, -72) + (0, 72) - 0.5
    seen = cv2.remap(
        image.astype(np.float32), *at.astype(np.float32).T[..., None], cv2.INTER_LINEAR
    )[:, 0]
    place = vertices[keep, :2] / extent + 0.5
    texture = synthetic.texture_image().astype(np.float32)
    printed = cv2.remap(
        texture, *(place * 64 - 0.5).astype(np.float32).T[..., None], cv2.INTER_LINEAR
    )[:, 0]
    assert np.abs(seen - printed).max() < 12


@pytest.mark.parametrize("resolution", [33, 9])
def test_kinect_paper_pose_fit(tmp_path, resolution):
    """A pose that misses by three pixels is moved to where the sheet is, whatever the resolution,
    and a line says so.
    """
    truth = synthetic.kinect_paper(tmp_path / "data", frames=1, size=(384, 288))
    folder, camera = str(truth.folder), kinect_paper.camera(str(truth.folder))
    exact = camera.project(synthetic.sheet(0, resolution, resolution))
    missed = lambda vertices: np.sqrt(((camera.project(vertices) - exact) ** 2).sum(1).mean())
    pose = np.loadtxt(truth.folder / "cam.ext")
    pose[:, :3] = cv2.Rodrigues(np.array([0.02, -0.025, 0.006]))[0] @ pose[:, :3]
    pose[:, 3] += (3, -2, 6)
    np.savetxt(truth.folder / "cam.ext", pose)
    said = []
    assert missed(kinect_paper_template(folder, resolution, "none", said.append)[0]) > 3
    vertices, _, uv = kinect_paper_template(folder, resolution, say=said.append)
    assert missed(vertices) < 0.2
    np.testing.assert_allclose(uv * (384, -288) + (0, 288), camera.project(vertices))
    assert said[0] == "pose: cam.ext's" and re.fullmatch(
        r"pose: cam.ext's, moved by [34]\.\d pixels to the edges of frame_001.png", said[1]
    )
    experiment = loaded(prepare(folder, resolution=resolution)[0])
    np.testing.assert_allclose(experiment.template.vertices, vertices, atol=1e-6)
    noise = np.random.default_rng(0).integers(0, 255, (288, 384, 3)).astype(np.uint8)
    cv2.imwrite(str(truth.folder / "frame_001.png"), noise)  # no edge tells
    np.testing.assert_array_equal(
        kinect_paper_template(folder, resolution)[0],
        kinect_paper_template(folder, resolution, "none")[0],
    )
    with pytest.raises(InputError, match="pose_fit = 'yes'; auto or none is needed"):
        kinect_paper_template(folder, resolution, "yes")


def test_real_kinect_paper(shared_data, tmp_path):
    folder = str(shared_data / "kinect_paper")
    vertices, _faces, uv = kinect_paper_template(folder, pose_fit="none")
    own = np.loadtxt(os.path.join(folder, "mesh.pts"))
    pose = np.loadtxt(os.path.join(folder, "cam.ext"))
    np.testing.assert_allclose(
        vertices.reshape(33, 33, 3)[::4, ::4].reshape(-1, 3),
        1e-3 * (own @ pose[:, :3].T + pose[:, 3]),
        atol=1e-9,
    )
    assert (
        np.loadtxt(os.path.join(folder, "mesh.tri")) == kinect_paper_template(folder, 9)[1]
    ).all()
    # the printed area has a dark frame: the template's left edge runs along it, within a few
    # pixels, the paper around it is white
    image = cv2.cvtColor(cv2.imread(os.path.join(folder, "frame_001.png")), cv2.COLOR_BGR2GRAY)
    edge = (uv.reshape(33, 33, 2)[4:29, 0] * (640, -480) + (0, 480)).astype(int)
    darkest = np.array([image[y, x - 6 : x + 7].min() for x, y in edge])
    outside = np.array([image[y, x - 25 : x - 12].min() for x, y in edge])
    assert (darkest < 130).mean() > 0.9 and (outside > 150).mean() > 0.9
    # fitted, it lies on the frame's middle: along straight lines between its corners pixels are
    # dark, two pixels off they are paper or print
    fitted, _, _ = kinect_paper_template(folder)
    corner = kinect_paper.camera(folder).project(fitted)[[0, 32, 1088, 1056]]
    grey = lambda d: np.concatenate(
        [_along(image, a, b, d) for a, b in zip(corner, np.roll(corner, -1, axis=0))]
    )
    assert grey(0).mean() < 130 < 165 < min(grey(-3).mean(), grey(3).mean())
    assert (
        np.ptp(np.linalg.norm(fitted - vertices, axis=1)) < 0.02
        and np.linalg.norm(fitted - vertices, axis=1).max() < 0.02
    )


def _along(image, a, b, aside):
    """Pixels (100,) of an image (H, W) on the line from a to b, moved by so many pixels to its
    side.
    """
    step = (b - a) / np.linalg.norm(b - a)
    at = a + np.linspace(0.05, 0.95, 100)[:, None] * (b - a) + aside * step[::-1] * (-1, 1) - 0.5
    return cv2.remap(
        image.astype(np.float32), *at.astype(np.float32).T[..., None], cv2.INTER_LINEAR
    )[:, 0]


# ---- what is refused -----------------------------------------------------------------------------


def test_unknown_folders(tmp_path):
    (tmp_path / "empty").mkdir()
    message = refused(str(tmp_path / "empty"))
    assert all(name in message for name in ("frames/", "rgbs/", "mesh.pts", "camera.json"))
    assert "nowhere: no such folder" in refused(str(tmp_path / "nowhere"))
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
    _path, _ = prepare(str(folder), resolution=5)
    before = {name: (folder / name).read_bytes() for name in ("scene.xml", "template.obj")}
    assert "--overwrite" in refused(str(folder))
    (folder / "scene.xml").unlink()
    assert "template.obj" in refused(str(folder)) and not (folder / "scene.xml").exists()
    prepare(str(folder), resolution=9, overwrite=True)
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


def test_command_line(tmp_path):
    folder = synthetic.cloth(tmp_path / "data", frames=2).folder
    command = lambda *a: subprocess.run(
        [sys.executable, "-m", "polysft_mi.prepare", *map(str, a)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    done = command(folder, "-o", tmp_path / "out")
    assert done.returncode == 0 and "template of 99 vertices" in done.stdout
    assert f"python -m polysft_mi.run {tmp_path / 'out' / 'scene.xml'}" in done.stdout
    again = command(folder, "-o", tmp_path / "out")
    assert (
        again.returncode == 2
        and again.stderr.startswith("error: ")
        and again.stderr.count("\n") == 1
    )


# ---- the repository's own scenes -----------------------------------------------------------------


@pytest.mark.parametrize("name", write_scenes.SCENES)
def test_scenes_are_as_the_writer_writes_them(name):
    assert (ROOT / "scenes" / f"{name}.xml").read_text(encoding="utf-8") == write_scenes.text(name)


def _place(name, shared_data):
    return (
        shared_data / name
        if name in ("kinect_paper", "phi_sft_R1")
        else shared_data / "cloth" / name
    )


@pytest.mark.parametrize("name", [n for n in write_scenes.SCENES if n != "demo"])
def test_scenes_match_the_sequences(name, shared_data):
    layout = recognise(str(_place(name, shared_data)))
    assert dataclasses.replace(write_scenes.SCENES[name], settings={}) == layout


@pytest.mark.parametrize("name", [n for n in write_scenes.SCENES if n != "demo"])
def test_scenes_show_frame_0(name, shared_data):
    right, *mirrored = difference(
        loaded(str(ROOT / "scenes" / f"{name}.xml"), data=_place(name, shared_data))
    )
    # phi-SfT's template is some pixels away from its own texture coordinates' place in frame 0
    assert right < (0.13 if name == "phi_sft_R1" else 0.03) and min(mirrored) > 2 * right


def test_demo():
    folder = ROOT / "scenes" / "demo"
    assert sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) < 1_900_000
    assert recognise(str(folder)) == dataclasses.replace(
        write_scenes.SCENES["demo"], settings={}
    )  # shorter than what prepare would write
    experiment = loaded(str(ROOT / "scenes" / "demo.xml"))
    right, *mirrored = difference(experiment)
    assert right < 0.03 and min(mirrored) > 2 * right
    truth = np.load(folder / "gt.npz")
    assert len(truth["vertices"]) == len(
        Sequence.open(experiment.frames, experiment.masks, size=experiment.size)
    )
    np.testing.assert_allclose(truth["vertices"][0], experiment.template.vertices, atol=1e-4)
    np.testing.assert_array_equal(truth["faces"], experiment.template.faces)


def test_comment_cannot_break_the_scene():
    layout = Layout(
        "cloth", write_scenes.SCENES["flag"].camera, "frames", "", "texture.png", "template.obj"
    )
    ET.fromstring(scene_xml(layout, ".", comment="a -- b > & --> c"))
