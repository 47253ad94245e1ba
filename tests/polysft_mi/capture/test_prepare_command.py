"""The command line of the preparation, and what it refuses in one line."""

import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from clips import (
    DEMO,
    given,
    photo,
    refused,
    write_png,
)
from processes import python

from polysft_mi import prepare
from polysft_mi.capture import prepare_video
from polysft_mi.scene.images import read_rgb
from polysft_mi.surface import meshio


def arguments(clip, out, *options):
    """Those of a command that prepares ``clip``, a video, a photo of an A4 sheet and a camera."""
    words = [clip[0], "--texture", clip[1], "--size", "A4", "--camera", clip[2], "-o", str(out)]
    return [*words, *options]


def test_command_line(clip, tmp_path):
    """In a process of its own, which ends without a word of the libraries that read videos."""
    words = arguments(clip, tmp_path / "o ut", "--last", 1)
    done = python("-m", "polysft_mi.prepare", *words)
    assert done.returncode == 0 and done.stderr == ""
    assert f"python -m polysft_mi.run '{tmp_path / 'o ut' / 'scene.xml'}'" in done.stdout
    assert "--overwrite" in refused(prepare.main, list(map(str, words)))
    assert (
        "python -m polysft_mi.prepare clip.mp4 --texture photo.jpg"
        in prepare.parser().format_help()
    )


def test_replacing_a_folder(clip, tmp_path, capsys):
    words = arguments(clip, tmp_path / "out", "--no-masks")
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


def test_masks_are_drawn_in(clip, tmp_path):
    area = {}
    for inset in (0, 3):
        out = tmp_path / str(inset)
        prepare.main([*arguments(clip, out, "--last", "0", "--inset", str(inset)), "-q"])
        area[inset] = (cv2.imread(str(out / "masks" / "00000.png"), 0) > 127).sum()
        found = json.loads((out / "prepare" / "prepare.json").read_text())["masks"]
        assert found["beyond_px"] == pytest.approx(-inset, abs=0.6)
    assert area[3] < area[0]
    for words in (["--no-masks"], ["--inset", "nan"]):
        assert "--inset" in refused(
            prepare.main, arguments(clip, tmp_path / "no", "--inset", "1", *words)
        )


def test_given_masks_are_told_and_not_inverted_nor_drawn_in_to_nothing(clip, tmp_path, capsys):
    out = tmp_path / "found"
    prepare.main([*arguments(clip, out, "--last", "0"), "-q"])
    mask = cv2.imread(str(out / "masks" / "00000.png"), 0)
    made = {"inverted": 255 - mask, "part": mask.copy()}
    made["part"][:, : mask.shape[1] // 2] = 0  # as a hand hides the rest
    for name, image in made.items():
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), image)
    given = lambda folder, out: arguments(clip, out, "--last", "0", "--masks", str(folder))
    for folder, least, most in (out / "masks", 85, 100), (tmp_path / "part", 20, 80):
        prepare.main(given(folder, tmp_path / str(most)))
        said = re.search(
            rf"masks: those of {folder}; .* overlap by (\d+) %", capsys.readouterr().out
        )
        assert least <= int(said[1]) <= most
    words = given(tmp_path / "inverted", tmp_path / "no")
    assert "is it inverted? White is the sheet" in refused(prepare.main, words)
    no = arguments(clip, tmp_path / "no", "--last", "0", "--inset", "500")
    for words in (no, [*no, "--masks", str(out / "masks")]):
        assert "--inset 500: nothing is left" in refused(prepare.main, words)
    assert not (tmp_path / "no").exists()


def test_photo_that_is_not_in_the_video(clip, tmp_path):
    other = write_png(tmp_path / "other.png", photo(seed=99))
    plain = write_png(tmp_path / "plain.png", np.full((210, 297, 3), 200, np.uint8))
    for k, path in enumerate((other, plain)):
        message = refused(
            prepare_video, clip[0], str(tmp_path / f"out{k}"), **given(clip, texture=path)
        )
        assert (
            "--corners" in message
            and f"out{k}.matches.png" in message
            and os.path.isfile(tmp_path / f"out{k}.matches.png")
        )
        assert not (tmp_path / f"out{k}").exists()
    flipped = write_png(tmp_path / "flipped.png", read_rgb(clip[1])[:, ::-1])
    assert "mirror" in refused(
        prepare_video, clip[0], str(tmp_path / "out2"), **given(clip, texture=flipped)
    )
    assert "not a readable image" in refused(
        prepare_video, clip[0], str(tmp_path / "out3"), **given(clip, texture=clip[0])
    )
    assert (
        "no such file"
        in refused(
            prepare_video,
            clip[0],
            str(tmp_path / "out3"),
            **given(clip, texture=str(tmp_path / "none.jpg")),
        ).lower()
    )


@pytest.mark.parametrize(
    "corners, said",
    [
        ([(900, 10), (1100, 10), (1100, 150), (900, 150)], "0 % of the sheet is in view"),
        ([(50, 40), (60, 160), (250, 170), (240, 30)], "anticlockwise"),
        ([(50, 40), (240, 170), (240, 30), (60, 160)], "quadrangle"),
        ([(50, 40), (60, 40), (70, 40), (80, 40)], "quadrangle"),
    ],
)
def test_corners_that_cannot_be(corners, said, clip, tmp_path):
    assert said in refused(
        prepare_video,
        clip[0],
        str(tmp_path / "out"),
        corners=corners,
        pose_fit="none",
        **given(clip),
    )
    assert os.listdir(tmp_path) == []


def test_what_does_not_go_together(clip, tmp_path):
    call = lambda **o: refused(
        prepare_video, clip[0], str(tmp_path / "out"), **{**given(clip), **o}
    )
    assert "one of them" in call(fov=60)
    assert "--size" in call(template=str(DEMO / "template.obj"))
    assert "--size" in call(size=None)
    assert "--corners" in call(texture="first-frame")
    assert "--size 0.297 0.21?" in call(size=["210mm", "297mm"])
    assert "16" in call(scale=0.01)
    assert "400" in call(resolution=1)
    own = dict(size=None, template=str(DEMO / "template.obj"), resolution=9)
    assert "--resolution 9: of a flat sheet; " in call(**own)
    camera = tmp_path / "camera.json"
    camera.write_text(
        json.dumps({"fx": 99, "fy": 99, "cx": 1, "cy": 1, "width": 100, "height": 100})
    )
    assert "320x240" in call(camera=str(camera))
    text = '{"fx": 330, "fy": 330, "cx": 160, "cy": 120, "width": 320, "height": 240,'
    camera.write_text(text + ' "distortion": [1, 2]}')
    assert "distortion" in call(camera=str(camera))
    obj = tmp_path / "large.obj"
    vertices, faces, uv = meshio.read_template(DEMO / "template.obj")
    meshio.write_obj(obj, 1000 * vertices, faces, uv)
    assert "millimetres" in call(size=None, template=str(obj))
    assert sorted(os.listdir(tmp_path)) == ["camera.json", "large.obj"]


def test_inputs_are_not_replaced(clip, tmp_path):
    folder = str(Path(clip[0]).parent)
    assert "would be replaced" in refused(
        prepare_video, clip[0], folder, overwrite=True, **given(clip)
    )
    (tmp_path / "file").write_text("")
    assert "is a file" in refused(prepare_video, clip[0], str(tmp_path / "file"), **given(clip))


def test_nothing_is_left_of_an_interrupted_run(clip, tmp_path):
    def stop(count):
        if count == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare_video(clip[0], str(tmp_path / "out"), progress=stop, **given(clip))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "words, said",
    [
        ("", "needs --texture"),
        ("--texture first-frame --size A4 --fov 60 --corners 1,2 3,4", "four points"),
        ("--texture first-frame --size A4 --fov 60 --corners a,b 1,2 3,4 5,6", "four points"),
    ],
)
def test_words_of_the_command_line(words, said, clip):
    assert said in refused(prepare.main, [clip[0], *words.split()])


@pytest.mark.parametrize(
    "words, said",
    [
        ("--track-centre 0.5", "--track-centre: is of tracks; --tracks names"),
        ("--depth-unit 0.001", "--depth-unit: is of depth images; --depth names"),
        ("--depth-known-to affine", "--depth-known-to: is of depth images; --depth names"),
        ("--body-up y", "--body-up: is of a body; --body names"),
        ("--rig-scale 1", "--rig-scale: is of a rig; --cameras names"),
        ("--camera-name left", "--camera-name: is of a rig; --cameras names"),
        ("--tracks t.npz --track-centre nan", "--track-centre nan: 0.5 or 0, at most 1, is needed"),
        ("--tracks t.npz --track-centre -3", "--track-centre -3: 0.5 or 0, at most 1, is needed"),
        ("--depth deep --depth-unit 0", "--depth-unit 0: metres a number; above 0 is needed"),
        ("--depth deep --depth-unit -1", "--depth-unit -1: metres a number; above 0 is needed"),
    ],
)
def test_options_that_speak_of_nothing_are_refused(words, said, tmp_path):
    assert said in refused(prepare.main, [str(DEMO), "-o", str(tmp_path / "out"), *words.split()])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words",
    ["--fov 60", "--first 3", "--no-masks", "--texture-corners 0,0 9,0 9,9 0,9", "--resolution 9"],
)
def test_options_for_videos_are_refused_for_folders(words, tmp_path):
    call = [str(DEMO), "-o", str(tmp_path / "out"), *words.split()]
    assert words.split()[0] in refused(prepare.main, call)
    assert not (tmp_path / "out").exists()
