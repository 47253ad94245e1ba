"""Videos decoded again, and the PNGs that stand in for them."""

import os

import av
import cv2
import numpy as np
import pytest

from polyfit.errors import InputError
from polyfit.pictures import video

needs_encoder = pytest.mark.skipif(
    not video.can_encode(), reason="PyAV was built without libx264 here"
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
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 10 and stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
    decoded = list(video.read_video(path))
    assert len(decoded) == 7 and decoded[0].shape == (48, 64, 3)
    for want, got in zip(frames(), decoded):
        assert np.abs(got[4:40, 4:25].reshape(-1, 3).mean(0) - want[10, 10]).max() < 6
        assert np.abs(got[4:40, 40:60].reshape(-1, 3).mean(0) - 128).max() < 6
    next(video.read_video(path))  # the rest is left unread
    (tmp_path / "broken.mp4").write_bytes(path.read_bytes()[:400])
    with pytest.raises(InputError, match="broken.mp4: not a readable video"):
        list(video.read_video(tmp_path / "broken.mp4"))


@needs_encoder
def test_colours_are_rec709_and_marked_so(tmp_path):
    rgb = np.array([220, 40, 60])
    video.write_video(tmp_path / "a.mp4", [np.full((64, 64, 3), rgb, np.uint8)] * 2)
    with av.open(str(tmp_path / "a.mp4")) as container:
        frame = next(container.decode(video=0))
        marks = container.streams.video[0].codec_context
        assert frame.format.name == "yuv420p"
        luma = frame.to_ndarray()[:64]
    # Rec.601 has 98, Rec.709 84
    assert np.abs(luma - (16 + 219 / 255 * rgb @ (0.2126, 0.7152, 0.0722))).max() < 2
    bt709, tv = 1, 1  # as FFmpeg numbers them
    assert (marks.colorspace, marks.color_primaries, marks.color_trc) == (bt709, bt709, bt709)
    assert marks.color_range == tv


@needs_encoder
def test_very_wide_frames_shrink(tmp_path):
    video.write_video(tmp_path / "a.mp4", [np.full((301, 5000, 3), 77, np.uint8)])
    frame = next(video.read_video(tmp_path / "a.mp4"))
    assert frame.shape == (232, 3840, 3) and np.abs(frame.astype(int) - 77).max() < 3


@needs_encoder
def test_the_index_stands_first_so_that_browsers_can_start(tmp_path):
    video.write_video(tmp_path / "a.mp4", frames())
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_falls_back_to_pngs(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "can_encode", lambda: False)
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


def test_a_pyav_without_the_encoder_is_known(tmp_path, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    video.can_encode.cache_clear()
    try:
        assert not video.can_encode()
        assert os.path.isdir(video.write_video(tmp_path / "v.mp4", frames()))
    finally:
        video.can_encode.cache_clear()


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
        monkeypatch.setattr(video, "can_encode", lambda: False)
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
