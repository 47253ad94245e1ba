"""Frames of videos and single photos: upright, in their colours, of any depth."""

import os
from pathlib import Path

import numpy as np
import pytest
from clips import given, photo, refused, rendered, write_png

from polyfit.pictures import write_video
from polysft_mi.capture import prepare_video
from polysft_mi.capture.frames import read_frames
from polysft_mi.scene.images import read_rgb


def test_frames_are_in_their_colours(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :32], image[:24, 32:], image[24:, :32], image[24:, 32:] = (
        (200, 40, 30),
        (30, 180, 60),
        (40, 50, 220),
        (240, 240, 100),
    )
    write_video(tmp_path / "a.mp4", [image] * 3)
    got = [x for _, x in read_frames(tmp_path / "a.mp4")]
    assert len(got) == 3 and all(
        np.abs(x[8:40:31, 8:50:41].astype(int) - image[8:40:31, 8:50:41]).max() < 6 for x in got
    )


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_of_a_photo(orientation, tmp_path):
    from PIL import Image, ImageOps

    image = Image.fromarray(photo(size=(40, 30)))
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    wanted = np.array(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), wanted)


def test_depth_and_alpha_of_a_photo(tmp_path):
    rgb = photo(size=(40, 30))
    write_png(tmp_path / "deep.png", rgb.astype(np.uint16)[..., ::-1][..., ::-1] * 257)
    np.testing.assert_array_equal(read_rgb(tmp_path / "deep.png"), rgb)
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[:, :20] = 0
    write_png(tmp_path / "alpha.png", np.dstack([rgb[..., ::-1], alpha]))
    got = read_rgb(tmp_path / "alpha.png")
    assert (got[:, :20] == 255).all() and (got[:, 20:] == rgb[:, 20:]).all()
    write_png(tmp_path / "grey.png", rgb[..., 0].astype(np.uint16) * 257)
    assert (read_rgb(tmp_path / "grey.png") == rgb[..., :1]).all()


def test_deep_and_transparent_inputs_go_the_whole_way(clip, tmp_path):
    deep = read_rgb(clip[1])[..., ::-1].astype(np.uint16) * 257
    path = write_png(
        tmp_path / "deep.png", np.dstack([deep, np.full(deep.shape[:2], 65535, np.uint16)])
    )
    for k, (_, image) in enumerate(read_frames(clip[0], last=1)):
        write_png(
            tmp_path / "in" / f"{k}.png",
            np.dstack([image[..., ::-1], np.full(image.shape[:2], 255, np.uint8)]),
        )
    _, found = prepare_video(
        str(tmp_path / "in"), str(tmp_path / "out"), **given(clip, texture=path)
    )
    assert found["pose"]["agree"] > 100 and found["frames"] == 2


def test_videos_that_cannot_be_read(clip, tmp_path):
    whole = Path(clip[0]).read_bytes()
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 4])
    (tmp_path / "folder").mkdir()
    for name in ("empty.mp4", "noise.mp4", "half.mp4", "folder", "none.mp4"):
        message = refused(prepare_video, str(tmp_path / name), str(tmp_path / "out"), **given(clip))
        assert name in message
    assert "11 frames" not in refused(
        prepare_video, clip[0], str(tmp_path / "out"), first=12, **given(clip)
    )
    assert "12 frames" in refused(
        prepare_video, clip[0], str(tmp_path / "out"), last=12, **given(clip)
    )
    assert sorted(os.listdir(tmp_path)) == ["empty.mp4", "folder", "half.mp4", "noise.mp4"]


def test_frames_of_several_sizes(clip, tmp_path):
    import av

    pictures = [rendered(photo())[0], rendered(photo())[0][:200]]
    for k, image in enumerate(pictures):
        write_png(tmp_path / "in" / f"{k}.png", image)
    assert "320x200" in refused(
        prepare_video, str(tmp_path / "in"), str(tmp_path / "out"), **given(clip)
    )
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
        prepare_video, str(tmp_path / "both.mjpeg"), str(tmp_path / "out"), **given(clip)
    )
    assert not (tmp_path / "out").exists() and not [
        n for n in os.listdir(tmp_path) if "partial" in n
    ]
