"""Bad input as a user meets it: images and templates.

One line names the file, property or value and says what is accepted; the exit status is 2; OUT is
untouched.
"""

import json
import shutil

import cv2
import numpy as np
import pytest
import synthetic
from refusals import QUICK, SIZE, edited, has, refused
from scipy.spatial.transform import Rotation

from polyfit import write_ply
from polysft_mi import run


@pytest.mark.parametrize("name", ["texture.png", "frames/001.png", "masks/001.png"])
@pytest.mark.parametrize("kind", ["truncated", "garbage", "empty"])
def test_image_that_cannot_be_read(sheet, name, kind):
    path = sheet / name
    data = path.read_bytes()
    path.write_bytes({"truncated": data[: len(data) // 2], "garbage": b"hello", "empty": b""}[kind])
    has(refused(sheet / "scene.xml"), f"{name}: not a readable image")


@pytest.mark.parametrize("name", ["texture.png", "frames", "masks"])
def test_files_are_missing(sheet, name):
    if name == "texture.png":
        (sheet / name).unlink()
    else:
        shutil.rmtree(sheet / name)
    has(
        refused(sheet / "scene.xml"),
        str(sheet / name) if name == "texture.png" else name,
        "no such file" if name == "texture.png" else "no such folder",
    )


def test_film_of_another_size(sheet):
    message = refused(
        edited(sheet, '<integer name="width" value="48"/>', '<integer name="width" value="64"/>')
    )
    has(message, "frames/000.png: 48x36 pixels; the camera's film has 64x36")


def moved(truth, by=(0, 0, 0), scale=1.0):
    return truth.vertices[0] * scale + by, truth.uv, truth.faces


BAD_TEMPLATES = {
    "behind": (
        lambda t: moved(t, (0, 0, -1)),
        ["99 of 99 vertices behind the camera; it must stand in its pose of the first frame"],
    ),
    "out of view": (
        lambda t: moved(t, (5, 0, 0)),
        ["out of view in the first frame: it projects to x 5", "an image of 48x36 pixels"],
    ),
    "off the mask": (
        lambda t: moved(t, (0.15, 0.1, 0.5), 0.05),
        ["does not meet the mask of the first frame, 0 of whose", ": it projects to x"],
    ),
}


@pytest.mark.parametrize("kind", BAD_TEMPLATES)
def test_bad_template(good, sheet, kind):
    make, words = BAD_TEMPLATES[kind]
    synthetic.write_obj(sheet / "template.obj", *make(good))
    has(refused(sheet / "scene.xml"), *words)


def test_masks_that_are_inverted(sheet):
    for path in (sheet / "masks").iterdir():
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    message = refused(sheet / "scene.xml")
    has(message, "does not meet the mask of the first frame", "is it inverted? White is the sheet")


def test_tracks_that_are_no_pixels(good, sheet):
    centre = np.array(SIZE) / 2
    tracks = np.tile(centre, (3, 5, 1)) + np.arange(5)[:, None]
    np.savez(sheet / "tracks.npz", tracks=tracks / SIZE)
    options = "-D", f"tracks={sheet / 'tracks.npz'}"
    has(refused(sheet / "scene.xml", *options), "tracks.npz: 0 of the 5", "pixels of 48x36")
    late = np.arange(3)[:, None] >= [1] * 5
    np.savez(sheet / "tracks.npz", tracks=10 * tracks, visible=late)
    message = refused(sheet / "scene.xml", *options)
    has(message, "tracks.npz: all of them lie outside the image", "pixels of 48x36")
    few = np.tile([(1.0, 1.0)], (3, 60, 1))  # a corner, where the sheet is not
    few[:, :2] = tracks[:, :2]
    np.savez(sheet / "tracks.npz", tracks=few)
    message = refused(sheet / "scene.xml", *options)
    has(message, "2 of the 60 that begin in the first frame begin on the template")
    np.savez(sheet / "tracks.npz", tracks=tracks)
    assert run.main([str(sheet / "scene.xml"), "-o", str(sheet / "out"), *QUICK[:3], *options]) == 0


def test_further_cameras_that_do_not_see_the_template(good, sheet):
    """As the scene's own camera must, by a pose that is right."""
    side = sheet / "cameras" / "side"
    for name in ("frames", "masks"):
        shutil.copytree(sheet / name, side / name)
    known = json.loads((sheet / "camera.json").read_text())

    def given(*place, turn=0.0):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0, turn, 0]).as_matrix()
        pose[:3, 3] = place
        (side / "camera.json").write_text(json.dumps(known | {"world_to_camera": pose.tolist()}))
        return "-D", f"cameras={sheet / 'cameras'}"

    for place, turn, said in (
        ((0, 0, 0), np.pi, "99 of 99 vertices behind the camera"),
        ((50, 0, 0), 0.0, "is out of view in the first frame"),
        ((0.3, 0.2, 0.3), 0.0, "does not meet the mask of the first frame"),
    ):
        message = refused(sheet / "scene.xml", *given(*place, turn=turn))
        has(message, "camera side: the template", said, "world_to_camera")
    options = given(0, 0, 0)
    assert run.main([str(sheet / "scene.xml"), "-o", str(sheet / "out"), *QUICK, *options]) == 0


def test_depth_of_another_unit_or_shape(good, sheet):
    (sheet / "depth").mkdir()

    def given(metres, shape):
        for k in range(3):
            image = np.full(shape, round(1000 * metres), np.uint16)
            cv2.imwrite(str(sheet / "depth" / f"{k:03d}.png"), image)
        return "-D", f"depth={sheet / 'depth'}"

    away = good.vertices[0][:, 2].mean()
    message = refused(sheet / "scene.xml", *given(away / 10, SIZE[::-1]))
    has(message, "000.png:", "m where the template lies", "depth_unit = 0.001 m must be wrong")
    has(message, "(0.01 would fit)", "depth_known_to = affine")
    for factor in (1.4, 0.7):
        message = refused(sheet / "scene.xml", *given(factor * away, SIZE[::-1]))
        has(message, "m where the template lies", "depth_known_to = affine")
    message = refused(sheet / "scene.xml", *given(away, (36, 36)))
    has(message, "000.png: 36x36 pixels are not of the shape of the frames, 48x36")
    options = given(1.1 * away, SIZE[::-1])
    dark = np.zeros(SIZE[::-1], np.uint16)
    words = [str(sheet / "scene.xml"), "-o", str(sheet / "out"), *QUICK[:3], *options]
    assert run.main(words) == 0
    cv2.imwrite(str(sheet / "depth" / "000.png"), dark)  # a sensor that starts dark
    assert run.main([*words, "--overwrite"]) == 0


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_faces_without_area_and_loose_vertices_are_left_out(good, sheet, kind, capsys):
    """The surfaces are those of the clean template."""
    V, uv, F = moved(good)
    noisy = (np.concatenate([V[:1] + 0.2, V]), np.concatenate([uv[:1], uv]))
    noisy = (*noisy, np.concatenate([[[1, 1, 2], [3, 4, 4]], F + 1]))
    for out, (vertices, coordinates, faces) in (("clean", (V, uv, F)), ("noisy", noisy)):
        if kind == "obj":
            synthetic.write_obj(sheet / "template.obj", vertices, coordinates, faces)
            scene = sheet / "scene.xml"
        else:
            write_ply(sheet / "template.ply", vertices, faces, coordinates)
            text = (sheet / "scene.xml").read_text().replace("template.obj", "template.ply")
            scene = sheet / "ply.xml"
            scene.write_text(text.replace('type="obj"', 'type="ply"'))
        run.main([str(scene), "-o", str(sheet / out)])
    said = "left out 2 faces without area and 1 vertices in no other face"
    assert said in capsys.readouterr().err
    with np.load(sheet / "clean/surface.npz") as clean, np.load(sheet / "noisy/surface.npz") as own:
        assert clean["vertices"].shape == own["vertices"].shape
        assert np.abs(clean["vertices"] - own["vertices"]).max() < 1e-6


def test_template_that_cannot_be_read(sheet):
    path = sheet / "template.obj"
    text = path.read_text()
    path.write_text(text + "v 1 two 3\n")
    has(refused(sheet / "scene.xml"), "template.obj: line 359: 'v 1 two 3' is not OBJ")
    path.unlink()
    has(
        refused(sheet / "scene.xml"),
        f"{path}: no such file (filename of <obj> in {sheet / 'scene.xml'})",
    )
    has(
        refused(edited(sheet, "template.obj", "texture.png")),
        "texture.png: template of type '.png'; .obj, .ply or .glb is needed",
    )
