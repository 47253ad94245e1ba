"""Videos decoded again, and the PNGs that stand in for them."""

import os
import subprocess

import cv2
import imageio
import numpy as np
import pytest

from polysft_mi.errors import InputError
from polysft_mi.pictures import video

needs_encoder = pytest.mark.skipif(
    video.encoder() is None, reason="no ffmpeg with an H.264 encoder here"
)


def frames(count=7, height=47, width=63):
    """Odd-sized frames: a left half of a colour of the frame's own, a grey right half."""
    for k in range(count):
        frame = np.full((height, width, 3), 128, np.uint8)
        frame[:, : width // 2] = (30 * k, 200 - 20 * k, 60)
        yield frame


@needs_encoder
def test_decodes_to_the_same_frames(tmp_path):
    path = tmp_path / "comparison.mp4"
    assert video.write_video(path, frames(), fps=10) == str(path)
    assert os.listdir(tmp_path) == ["comparison.mp4"]
    with imageio.get_reader(path) as reader:
        meta, decoded = reader.get_meta_data(), [np.asarray(f) for f in reader]
    assert meta["fps"] == 10 and meta["codec"] == "h264" and meta["pix_fmt"].startswith("yuv420p")
    assert len(decoded) == 7 and decoded[0].shape == (48, 64, 3)
    for want, got in zip(frames(), decoded):
        assert np.abs(got[4:40, 4:25].reshape(-1, 3).mean(0) - want[10, 10]).max() < 6
        assert np.abs(got[4:40, 40:60].reshape(-1, 3).mean(0) - 128).max() < 6
    ours = list(video.read_video(path))
    assert len(ours) == 7 and all(
        np.abs(a.astype(int) - b).max() <= 2 for a, b in zip(ours, decoded)
    )
    next(video.read_video(path))  # the rest is left unread
    (tmp_path / "broken.mp4").write_bytes(path.read_bytes()[:400])
    with pytest.raises(InputError, match="broken.mp4: not a readable video"):
        list(video.read_video(tmp_path / "broken.mp4"))


@needs_encoder
def test_colours_are_rec709_and_marked_so(tmp_path):
    rgb = np.array([220, 40, 60])
    video.write_video(tmp_path / "a.mp4", [np.full((64, 64, 3), rgb, np.uint8)] * 2)
    command = [
        video.encoder(),
        "-i",
        tmp_path / "a.mp4",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "yuv420p",
        "-",
    ]
    done = subprocess.run(command, capture_output=True, check=True)
    luma = np.frombuffer(done.stdout, np.uint8)[: 64 * 64]
    assert (
        np.abs(luma - (16 + 219 / 255 * rgb @ (0.2126, 0.7152, 0.0722))).max() < 2
    )  # Rec.601 has 98, Rec.709 84
    assert (
        b"yuv420p(tv, bt709" in done.stderr
        and b"unknown" not in done.stderr.split(b"Video:")[1].split(b"\n")[0]
    )


@needs_encoder
def test_very_wide_frames_shrink(tmp_path):
    video.write_video(tmp_path / "a.mp4", [np.full((301, 5000, 3), 77, np.uint8)])
    frame = imageio.mimread(tmp_path / "a.mp4")[0]
    assert frame.shape == (232, 3840, 3) and np.abs(frame.astype(int) - 77).max() < 3


@needs_encoder
def test_the_index_stands_first_so_that_browsers_can_start(tmp_path):
    video.write_video(tmp_path / "a.mp4", frames())
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_falls_back_to_pngs(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "encoder", lambda: None)
    folder = tmp_path / "comparison"
    folder.mkdir()
    for name in ("000.exr", "notes.png", "009.png"):
        (folder / name).write_bytes(b"x")
    assert video.write_video(tmp_path / "comparison.mp4", frames(), fps=10) == str(folder)
    names = sorted(os.listdir(folder))
    assert names == sorted(
        [f"{k:03d}.png" for k in range(7)] + ["000.exr", "notes.png"]
    )  # the stale 009.png is gone
    for k, want in enumerate(frames()):
        np.testing.assert_array_equal(cv2.imread(str(folder / f"{k:03d}.png"))[..., ::-1], want)
    assert os.listdir(tmp_path) == ["comparison"]


def test_an_ffmpeg_that_cannot_encode_counts_as_none(tmp_path, monkeypatch):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho Unknown encoder libx264 >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(broken))
    video.encoder.cache_clear()
    try:
        assert video.encoder() is None
        assert os.path.isdir(video.write_video(tmp_path / "v.mp4", frames()))
    finally:
        video.encoder.cache_clear()


@pytest.mark.parametrize("with_encoder", [pytest.param(True, marks=needs_encoder), False])
@pytest.mark.parametrize(
    "wrong",
    [
        [],
        [np.zeros((8, 8, 3), np.float32)],
        [np.zeros((8, 8), np.uint8)],
        [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)],
    ],
)
def test_refuses_frames_of_another_form(tmp_path, monkeypatch, with_encoder, wrong):
    if not with_encoder:
        monkeypatch.setattr(video, "encoder", lambda: None)
    with pytest.raises(ValueError, match="video frame"):
        video.write_video(tmp_path / "v.mp4", wrong)
    assert not (tmp_path / "v.mp4").exists() and not [
        n for n in os.listdir(tmp_path) if "partial" in n
    ]


@needs_encoder
def test_an_interruption_leaves_the_older_video(tmp_path):
    def interrupted():
        yield from frames(3)
        raise KeyboardInterrupt

    (tmp_path / "v.mp4").write_bytes(b"older")
    with pytest.raises(KeyboardInterrupt):
        video.write_video(tmp_path / "v.mp4", interrupted())
    assert (tmp_path / "v.mp4").read_bytes() == b"older" and os.listdir(tmp_path) == ["v.mp4"]


@needs_encoder
def test_an_unwritable_place_is_an_oserror_that_names_the_file(tmp_path):
    with pytest.raises(OSError) as error:
        video.write_video(tmp_path / "nowhere" / "v.mp4", frames())
    assert "v.mp4" in str(error.value)
