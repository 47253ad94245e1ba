"""Images in, linear RGB and silhouettes out; every bad video told in one line at the start."""

import shutil

import cv2
import numpy as np
import pytest
import synthetic
from PIL import Image

from polysft_mi.errors import InputError
from polysft_mi.pictures.exr import write_exr
from polysft_mi.scene.images import image_size, list_images, read_mask
from polysft_mi.scene.sequence import Sequence, drop_stray_components


@pytest.fixture
def video(tmp_path):
    return synthetic.cloth(tmp_path / "video", frames=5, size=(48, 36))


def write(path, image):
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return str(path)


def test_numbers_in_names_sort_by_value(tmp_path):
    for name in ("frame_10.png", "frame_2.png", "Frame_1.png", "frame_02b.png", ".hidden_0.png"):
        write(tmp_path / name, np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "notes.txt").write_text("not an image")
    names = [p.rsplit("/", 1)[1] for p in list_images(tmp_path)]
    assert names == ["Frame_1.png", "frame_2.png", "frame_02b.png", "frame_10.png"]


def test_two_images_of_one_name_are_told(video):
    frames = video.folder / "frames"
    write(frames / "003.jpg", cv2.imread(str(frames / "003.png")))
    with pytest.raises(InputError, match=r"frames: .*frames/003\.jpg and 003\.png differ"):
        Sequence.open(frames)
    assert len(Sequence.open(frames / "*.png")) == 5


def test_selection(video):
    s = Sequence.open(video.folder / "frames", first=1, last=4, stride=2)
    assert len(s) == 2 and s.indices == [1, 3] and s.size == (48, 36)
    assert [f[-7:] for f in s.files] == ["001.png", "003.png"] and s.mask(0) is None
    assert len(Sequence.open(video.folder / "frames", first=4)) == 1


def test_pattern_selects_and_folder_may_have_brackets(video):
    folder = video.folder.parent / "take [1]"
    video.folder.rename(folder)
    assert len(Sequence.open(folder / "frames")) == 5
    assert len(Sequence.open(folder / "frames" / "00[0-2].png")) == 3


def test_srgb_is_decoded_at_8_and_16_bits(tmp_path):
    codes = np.zeros((2, 3, 3), np.uint8)
    codes[0, 0], codes[0, 1], codes[0, 2], codes[1, 0] = (
        255,
        (0, 0, 255),
        (10, 188, 1),
        128,
    )  # OpenCV writes BGR
    eight = Sequence.open(write(tmp_path / "8.png", codes)).frame(0)
    assert eight.shape == (2, 3, 3) and eight.dtype == np.float32
    np.testing.assert_allclose(eight[0, 0], 1)
    np.testing.assert_allclose(eight[0, 1], (1, 0, 0))
    # IEC 61966-2-1 at the codes 1, 188, 10 and 128
    np.testing.assert_allclose(eight[0, 2], (0.000303527, 0.502886, 0.003035270), rtol=1e-5)
    np.testing.assert_allclose(eight[1, 0], 0.2158605, rtol=1e-5)
    sixteen = Sequence.open(write(tmp_path / "16.png", codes.astype(np.uint16) * 257)).frame(0)
    np.testing.assert_allclose(sixteen, eight, atol=1e-6)


def test_grey_alpha_and_exr(tmp_path):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    colour = np.repeat(grey[..., None], 3, axis=2)
    expected = Sequence.open(write(tmp_path / "c.png", colour)).frame(0)
    with_alpha = np.concatenate([colour, np.full((3, 4, 1), 7, np.uint8)], axis=2)
    for name, image in (
        ("g.png", grey),
        ("a.png", with_alpha),
        ("t.tif", colour),
        ("g.jpg", np.full((3, 4), 140, np.uint8)),
    ):
        frame = Sequence.open(write(tmp_path / name, image)).frame(0)
        assert frame.shape == (3, 4, 3)
        np.testing.assert_allclose(
            frame,
            expected if name != "g.jpg" else np.broadcast_to(expected[1, 3], (3, 4, 3)),
            atol=1e-6,
        )
    write_exr(tmp_path / "x.exr", {"render": np.broadcast_to([0.25, 0.5, 3.0], (3, 4, 3))})
    s = Sequence.open(tmp_path / "x.exr")
    assert s.size == (4, 3)
    np.testing.assert_allclose(s.frame(0), np.broadcast_to([0.25, 0.5, 1], (3, 4, 3)))


def test_frames_without_colours_are_known(tmp_path):
    """One channel, or three that differ no more than coding makes them."""
    random = np.random.default_rng(0)
    grey = random.integers(0, 250, (12, 16, 1), np.uint8)
    near = grey + random.integers(0, 3, (12, 16, 3), np.uint8)
    colour = grey + random.integers(0, 6, (12, 16, 3), np.uint8)
    for name, image, expected in (("a", grey, True), ("b", near, True), ("c", colour, False)):
        (tmp_path / name).mkdir()
        assert cv2.imwrite(str(tmp_path / name / "0.png"), image)
        sequence = Sequence.open(str(tmp_path / name))
        assert sequence.grey is expected, name
        if expected:
            assert np.ptp(sequence.frame(0), axis=2).max() == 0


@pytest.mark.parametrize(
    "dtype, high",
    [(np.uint8, 255), (np.uint8, 1), (np.uint8, 38), (np.uint16, 65535), (np.uint16, 1)],
)
@pytest.mark.parametrize("channels", [1, 3])
def test_mask_scale(tmp_path, video, dtype, high, channels):
    mask = np.zeros((36, 48), dtype)
    mask[10:20, 12:30] = high
    masks = write(
        tmp_path / "masks" / "0.png", np.repeat(mask[..., None], channels, axis=2).squeeze()
    )
    s = Sequence.open(video.folder / "frames" / "000.png", masks)
    assert s.mask(0).dtype == np.float32
    np.testing.assert_array_equal(s.mask(0), mask > 0)


@pytest.mark.parametrize("colours", [1, 3])
def test_masks_in_alpha(tmp_path, colours):
    """As cut-outs have them, white or in the picture's colours; alpha that is all full is none."""
    rng, mask = np.random.default_rng(0), np.zeros((36, 48), np.uint8)
    mask[10:20, 12:30] = 255
    picture = rng.integers(1, 256, (36, 48, colours), dtype=np.uint8)
    image = Image.fromarray(np.dstack([picture, mask]).squeeze(), "LA" if colours == 1 else "RGBA")
    image.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_mask(str(tmp_path / "a.png")), mask > 0)
    Image.fromarray(np.dstack([mask] * 3 + [np.full_like(mask, 255)])).save(tmp_path / "b.png")
    np.testing.assert_array_equal(read_mask(str(tmp_path / "b.png")), mask > 0)


def test_mask_keeps_antialiasing(video):
    s = Sequence.open(video.folder / "frames", video.folder / "masks")
    _, coverage = synthetic.render(
        video.vertices[3], video.faces, video.uv, video.K, s.size, synthetic.texture_image()
    )
    assert ((coverage > 0.2) & (coverage < 0.8)).any()
    np.testing.assert_allclose(s.mask(3), coverage, atol=0.5 / 255 + 1e-6)


def test_stray_components(tmp_path, video):
    mask = np.zeros((36, 48), np.uint8)
    mask[2:12, 2:12] = 255  # 100 pixels: the sheet
    mask[20:24, 20:23] = 255  # 12: the rest of it, behind a hand
    mask[30:33, 40:43] = 255  # 9: something else
    path = write(tmp_path / "masks" / "0.png", mask)
    clean = Sequence.open(video.folder / "frames" / "000.png", path).mask(0)
    assert clean[:25].sum() == 112 and clean[25:].sum() == 0
    assert (
        Sequence.open(video.folder / "frames" / "000.png", path, drop_stray=False).mask(0).sum()
        == 121
    )
    assert not drop_stray_components(np.zeros((4, 4), np.float32)).any()


def fails(*arguments, **options):
    with pytest.raises(InputError) as caught:
        Sequence.open(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    "options", [{"first": 5}, {"first": -1}, {"last": 5}, {"first": 3, "last": 2}, {"stride": 0}]
)
def test_selection_out_of_range(video, options):
    message = fails(video.folder / "frames", **options)
    assert any(f"{k} = {v}" in message for k, v in options.items())


def test_no_images(tmp_path):
    (tmp_path / "empty").mkdir()
    assert "empty" in fails(tmp_path / "empty")
    assert "no such folder" in fails(tmp_path / "nowhere" / "frames")
    assert "x_*.png" in fails(tmp_path / "empty" / "x_*.png")


@pytest.mark.parametrize("kind", ["png", "jpg", "exr", "not an image", "empty"])
def test_unreadable_frame_is_named_at_the_start(video, kind):
    frames = video.folder / "frames"
    image = cv2.imread(str(frames / "003.png"))
    (frames / "003.png").unlink()
    path = frames / f"003.{kind if len(kind) == 3 else 'png'}"
    if kind == "exr":
        write_exr(path, {"render": image / 255})
    elif len(kind) == 3:
        write(path, image)
    content = (
        path.read_bytes()[: path.stat().st_size * 2 // 3]
        if len(kind) == 3
        else b""
        if kind == "empty"
        else b"hello"
    )
    path.write_bytes(content)
    message = fails(frames)
    assert path.name in message and "not a readable image" in message


def test_size_from_the_header(video):
    assert image_size(video.folder / "frames" / "000.png") == (48, 36)
    with pytest.raises(InputError, match="nothing.png"):
        image_size(video.folder / "nothing.png")


def test_frames_that_are_not_selected_are_not_read(video):
    (video.folder / "frames" / "004.png").write_bytes(b"hello")
    assert len(Sequence.open(video.folder / "frames", last=3)) == 4


def test_sizes(video, tmp_path):
    frames = video.folder / "frames"
    message = fails(frames, size=(64, 36))
    assert "000.png" in message and "48x36" in message and "64x36" in message
    write(frames / "002.png", np.zeros((36, 40, 3), np.uint8))
    message = fails(frames)
    assert "002.png" in message and "40x36" in message and "48x36" in message


def test_masks_that_do_not_fit(video):
    frames, masks = video.folder / "frames", video.folder / "masks"
    write(masks / "000.png", np.zeros((36, 48), np.uint8))
    assert "000.png" in (message := fails(frames, masks)) and "empty" in message
    write(masks / "000.png", np.full((36, 47), 255, np.uint8))
    assert "47x36" in (message := fails(frames, masks)) and "masks" in message
    (masks / "000.png").unlink()
    assert "4 masks for the 5 images" in fails(frames, masks)
    shutil.rmtree(masks)
    assert "masks" in fails(frames, masks)


def test_pixels_that_are_not_finite(tmp_path):
    image = np.full((3, 4, 3), 0.5, np.float32)
    image[1, 1] = np.nan
    write_exr(tmp_path / "x.exr", {"render": image})
    with pytest.raises(InputError, match="x.exr: .*not finite"):
        Sequence.open(tmp_path / "x.exr").frame(0)


def test_real_masks_lose_their_blobs(shared_data):
    folder = shared_data / "phi_sft_R1"
    options = {"last": 0, "size": (1920, 1080)}
    raw = Sequence.open(folder / "rgbs", folder / "masks", drop_stray=False, **options).mask(0)
    clean = Sequence.open(folder / "rgbs", folder / "masks", **options).mask(0)
    assert raw[950:].sum() > 4000 and clean[950:].sum() == 0
    np.testing.assert_array_equal(raw[:950], clean[:950])


def test_masks_of_other_numbers_than_their_frames_are_told(video):
    masks = video.folder / "masks"
    (masks / "003.png").rename(masks / "0035.png")
    with pytest.raises(InputError, match=r"masks.004\.png: pairs with .*frames.003\.png"):
        Sequence.open(video.folder / "frames", masks)
    for k in range(5):  # all by another number: as they come
        left = sorted(masks.glob("[0-9]*.png"))
        left[0].rename(masks / f"mask_{k + 100}.png")
    assert len(Sequence.open(video.folder / "frames", masks)) == 5


def test_frames_that_are_to_be_turned_are_told(video):
    path = video.folder / "frames" / "002.png"
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.open(path).save(path, exif=exif)
    with pytest.raises(InputError, match=r"002\.png: its Exif orientation \(3\) turns it"):
        Sequence.open(video.folder / "frames")
