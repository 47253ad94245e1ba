"""Videos as players show them: each property of a container, on a small video that has it."""

import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from clips import given, refused

from polysft_mi import export, run
from polysft_mi.capture import prepare_video
from polysft_mi.capture.camera.calibration import calibrate
from polysft_mi.capture.footage import Film
from polysft_mi.capture.frames import read_frames
from polysft_mi.results import Run

COLOURS = np.array([[[200, 40, 30], [30, 180, 60]], [[40, 50, 220], [240, 240, 100]]], np.uint8)


def corners(height=48, width=64):
    """A picture of four colours, (H, W, 3) uint8."""
    return COLOURS.repeat(height // 2, axis=0).repeat(width // 2, axis=1)


def write(path, frames, codec="ffv1", pix_fmt="yuv444p", *, rate=25, times=None, about=(), **more):
    """A video of ``frames``: images (H, W, 3) uint8, or :class:`av.VideoFrame`; ``times``: of each,
    in milliseconds; ``about``: what is set on the encoder, ``more``: its options.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=more)
        first = frames[0]
        stream.height, stream.width = (
            first.shape[:2] if isinstance(first, np.ndarray) else (first.height, first.width)
        )
        stream.pix_fmt = pix_fmt
        for name, value in dict(about).items():
            setattr(stream.codec_context, name, value)
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for k, image in enumerate(frames):
            frame = image
            if isinstance(image, np.ndarray):
                form = "rgba" if image.shape[2] == 4 else "rgb24"
                frame = av.VideoFrame.from_ndarray(image, format=form)
            frame.pts = k if times is None else times[k]
            frame.time_base = Fraction(1, 1000) if times is not None else Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return str(path)


def read(path, **options):
    film = Film()
    return [image for _, image in read_frames(path, film=film, **options)], film


def near(image, wanted, most=6):
    """Whether the colours are those wanted, away from edges between them."""
    assert image.shape == wanted.shape
    h, w = image.shape[0] // 8, image.shape[1] // 8
    at = np.ix_([h, 7 * h], [w, 7 * w])
    return np.abs(image[at].astype(int) - wanted[at]).max() <= most


# --- how it lies ----------------------------------------------------------------------------------

MATRICES = {  # a, b, c, d of the container, and what players do to the image
    "as stored": ((1, 0, 0, 1), lambda x: x),
    "mirrored": ((-1, 0, 0, 1), lambda x: x[:, ::-1]),
    "on its head": ((1, 0, 0, -1), lambda x: x[::-1]),
    "half a turn": ((-1, 0, 0, -1), lambda x: x[::-1, ::-1]),
    "a quarter turn to the right": ((0, 1, -1, 0), lambda x: np.rot90(x, -1)),
    "a quarter turn to the left": ((0, -1, 1, 0), lambda x: np.rot90(x)),
    "turned and mirrored": ((0, 1, 1, 0), lambda x: x.transpose(1, 0, 2)),
    "turned and mirrored otherwise": ((0, -1, -1, 0), lambda x: np.rot90(x, 2).transpose(1, 0, 2)),
}


def with_matrix(path, out, matrix):
    """A copy of an .mp4 or .mov with another matrix in its track's header."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    a, b, c, d = (round(x * (1 << 16)) for x in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    out.write_bytes(data)
    return str(out)


@pytest.mark.parametrize("name", MATRICES)
def test_display_matrix(name, tmp_path):
    matrix, shown = MATRICES[name]
    write(tmp_path / "a.mov", [corners()] * 2, "mjpeg", "yuvj444p")
    images, _ = read(with_matrix(tmp_path / "a.mov", tmp_path / "b.mov", matrix))
    assert len(images) == 2 and near(images[0], shown(corners()), 12)


def test_a_matrix_that_turns_askew_is_refused(tmp_path):
    write(tmp_path / "a.mov", [corners()], "mjpeg", "yuvj444p")
    said = refused(read, with_matrix(tmp_path / "a.mov", tmp_path / "b.mov", (0.8, 0.6, -0.6, 0.8)))
    assert "b.mov: its display matrix turns it by no whole quarter turn" in said


SQUARE = {  # aspect of a pixel: how 64 x 48 of them are shown
    (4, 3): (85, 48),
    (1, 2): (64, 96),
    (1001, 1000): (64, 48),  # a container's rounding
}


@pytest.mark.parametrize("aspect", SQUARE)
def test_pixels_become_square(aspect, tmp_path):
    about = {"sample_aspect_ratio": Fraction(*aspect)}
    path = write(tmp_path / "a.mov", [corners()], "mjpeg", "yuvj444p", about=about)
    width, height = SQUARE[aspect]
    assert near(read(path)[0][0], cv2.resize(corners(), (width, height)), 12)
    turned = with_matrix(tmp_path / "a.mov", tmp_path / "b.mov", (0, 1, -1, 0))
    assert near(read(turned)[0][0], np.rot90(cv2.resize(corners(), (width, height)), -1), 12)


def test_a_board_is_calibrated_in_square_pixels(tmp_path):
    """A chessboard filmed with pixels of 2:1: the focal length of the picture as it is shown."""
    focal, size, rng = 600.0, (640, 480), np.random.default_rng(0)
    square = np.kron(np.indices((7, 10)).sum(0) % 2, np.ones((40, 40))).astype(np.uint8) * 200 + 30
    board = np.pad(square, 40, constant_values=230)
    K = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
    to_board = np.array([[1 / 400, 0, -0.6], [0, 1 / 400, -0.45], [0, 0, 1]])
    frames = []
    for k in range(12):
        tilt = np.array([0.5 * np.cos(k), 0.5 * np.sin(k), 0.1 * rng.normal()])
        R, t = cv2.Rodrigues(tilt)[0], [0.05 * np.cos(2 * k), 0.05 * np.sin(3 * k), 1.7]
        H = K @ np.column_stack([R[:, :2], t]) @ to_board
        fine = np.diag([4.0, 4, 1]) @ H
        big = cv2.warpPerspective(board, fine, (2560, 1920), borderValue=120)
        narrow = cv2.resize(big, (size[0] // 2, size[1]), interpolation=cv2.INTER_AREA)
        frames.append(np.repeat(narrow[..., None], 3, axis=2))
    path = write(
        tmp_path / "board.mp4", frames, "libx264", "yuv420p", crf="5",
        about={"sample_aspect_ratio": Fraction(2, 1)},
    )  # fmt: skip
    lens, _ = calibrate(path, "9x6")
    assert (lens.camera.width, lens.camera.height) == size
    np.testing.assert_allclose([lens.camera.fx, lens.camera.fy], focal, rtol=0.01)


# --- interlaced, transparent ----------------------------------------------------------------------


def texture(shift, size=(96, 128)):
    """A print that moved to the right by ``shift`` pixels."""
    rng = np.random.default_rng(3)
    grain = cv2.resize(rng.integers(0, 255, (12, 24, 3)).astype(np.uint8), (256, 96))
    at = np.float32([[1, 0, shift - 64], [0, 1, 0]])
    return cv2.warpAffine(grain, at, size[::-1], flags=cv2.INTER_CUBIC)


@pytest.mark.parametrize("kind", ["libx264", "prores_ks"])
def test_interlaced_frames_are_brought_to_one_moment(kind, tmp_path):
    """One field of each frame is half a frame later than the other."""
    frames = []
    for k in range(6):
        frame = texture(6 * k)
        frame[1::2] = texture(6 * k + 3)[1::2]
        frames.append(frame)
    if kind == "libx264":
        about, form = {"x264-params": "interlaced=1:tff=1", "crf": "1"}, "yuv444p"
    else:
        about, form = {"flags": "+ilme+ildct"}, "yuv422p10le"
    path = write(tmp_path / "a.mov", frames, kind, form, **about)
    images, film = read(path)
    assert len(images) == 6 and film.notes == [
        "interlaced; each frame is brought to one moment (deinterlaced)"
    ]
    inner = lambda image, wanted: np.abs(image.astype(int) - wanted)[8:-8, 8:-8].mean()
    combed = inner(frames[0], texture(0))
    moments = [max(inner(x, texture(6 * k + t)) for k, x in enumerate(images)) for t in (0, 3)]
    # the first field's, as the container says; where it says nothing, as the encoder does
    assert (moments[0] if kind == "libx264" else min(moments)) < 0.45 * combed
    some, _ = read(path, first=2, last=4, stride=2)
    np.testing.assert_array_equal(some, [images[2], images[4]])
    plain, film = read(write(tmp_path / "b.mov", [texture(0)] * 3, "libx264", "yuv444p"))
    assert len(plain) == 3 and not film.notes


@pytest.mark.parametrize(
    "name, codec, pix_fmt",
    [
        ("a.mov", "prores_ks", "yuva444p10le"),
        ("a.mov", "qtrle", "argb"),
        ("a.webm", "libvpx-vp9", "yuva420p"),
    ],
)
def test_what_is_transparent_is_white(name, codec, pix_fmt, tmp_path):
    image = np.dstack([corners(), np.full((48, 64), 255, np.uint8)])
    image[:24, :32, 3], image[24:, 32:, 3] = 0, 128
    wanted = corners().astype(float)
    wanted[:24, :32] = 255
    wanted[24:, 32:] = (wanted[24:, 32:] + 255) / 2
    images, _ = read(write(tmp_path / name, [image] * 3, codec, pix_fmt))
    assert len(images) == 3 and near(images[0], wanted.round().astype(np.uint8), 8)


# --- colours --------------------------------------------------------------------------------------

BT601, BT709, BT2020 = (0.299, 0.114), (0.2126, 0.0722), (0.2627, 0.0593)  # of red and blue


def coded(rgb, weights, full, bits=8):
    """Planes (3, H, W) of Y, Cb, Cr of signals rgb (H, W, 3) from 0 to 1."""
    red, blue = weights
    y = rgb @ np.array([red, 1 - red - blue, blue])
    cb, cr = (rgb[..., 2] - y) / (2 - 2 * blue), (rgb[..., 0] - y) / (2 - 2 * red)
    step = 1 << (bits - 8)
    if full:
        most = 256 * step - 1
        planes = [most * y, most * cb + 128 * step, most * cr + 128 * step]
    else:
        planes = [219 * y + 16, 224 * cb + 128, 224 * cr + 128]
        planes = [step * p for p in planes]
    return np.round(planes).clip(0, 256 * step - 1)


def frame_of(planes, bits=8):
    kind, form = (np.uint8, "yuv444p") if bits == 8 else (np.uint16, "yuv444p10le")
    frame = av.VideoFrame(planes.shape[2], planes.shape[1], form)
    for plane, values in zip(frame.planes, planes.astype(kind)):
        rows = np.zeros((plane.height, plane.line_size // values.itemsize), kind)
        rows[:, : values.shape[1]] = values
        plane.update(rows)
    return frame


def tagged(frame, about):
    for name, value in about.items():
        setattr(frame, name, value)
    return frame


@pytest.mark.parametrize(
    "weights, matrix, size",
    [
        (BT601, 6, (48, 64)),
        (BT709, 1, (48, 64)),
        (BT2020, 9, (48, 64)),
        (BT601, 2, (48, 64)),  # does not say, and is small
        (BT709, 2, (720, 1280)),  # does not say, and is of high definition
    ],
)
@pytest.mark.parametrize("full", [False, True])
def test_range_and_matrix(weights, matrix, size, full, tmp_path):
    image = corners(*size)
    about = {"colorspace": matrix, "color_range": 2 if full else 1}
    frame = tagged(frame_of(coded(image / 255, weights, full)), about)
    images, film = read(write(tmp_path / "a.mkv", [frame], about=about))
    assert near(images[0], image, 2) and not film.notes


def pq(light):
    """SMPTE ST 2084 of light [cd/m2]."""
    y = (np.asarray(light) / 10_000) ** (2610 / 16384)
    c2, c3 = 2413 / 128, 2392 / 128
    return ((3424 / 4096 + c2 * y) / (1 + c3 * y)) ** (2523 / 32)


def hlg(light):
    """ARIB STD-B67 of greys [cd/m2] on a screen of 1,000 cd/m2, whose gamma is 1.2."""
    scene = (np.asarray(light) / 1000) ** (1 / 1.2)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    bright = a * np.log(np.maximum(12 * scene - b, 1e-9)) + c
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), bright)


@pytest.mark.parametrize("curve, number, name", [(pq, 16, "PQ"), (hlg, 18, "HLG")])
def test_hdr_becomes_plain_with_a_line(curve, number, name, tmp_path):
    """A grey card of 18 % keeps its value, and a sheet's white is white; what glares is no more."""
    light = 203 * np.array([[0.02, 0.18], [1.0, 4.0]])
    signal = curve(light).repeat(24, 0).repeat(32, 1)[..., None].repeat(3, 2)
    about = {"colorspace": 9, "color_range": 1, "color_primaries": 9, "color_trc": number}
    frame = tagged(frame_of(coded(signal, BT2020, False, 10), 10), about)
    path = write(tmp_path / "a.mkv", [frame], pix_fmt="yuv444p10le", about=about)
    images, film = read(path)
    assert film.notes == [f"HDR ({name}); its colours are brought to those of a plain video (SDR)"]
    dark, card, white, glare = (int(images[0][y, x, 1]) for y in (8, 40) for x in (8, 56))
    assert abs(dark - 39) <= 2 and abs(card - 118) <= 2  # sRGB of 0.02 and 0.18
    assert 235 <= white < glare <= 255
    assert np.ptp(images[0].astype(int), axis=2).max() <= 3


def test_hdr_keeps_hues(tmp_path):
    """BT.709's green, which is no primary of BT.2020."""
    to_bt2020 = np.array(
        [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    )
    colours = np.array([[[0.5, 0.1, 0.1], [0.1, 0.5, 0.1]], [[0.1, 0.1, 0.5], [0.4, 0.4, 0.1]]])
    signal = pq(203 * colours @ to_bt2020.T).repeat(24, 0).repeat(32, 1)
    about = {"colorspace": 9, "color_range": 1, "color_primaries": 9, "color_trc": 16}
    frame = tagged(frame_of(coded(signal, BT2020, False, 10), 10), about)
    images, _ = read(write(tmp_path / "a.mkv", [frame], pix_fmt="yuv444p10le", about=about))
    wanted = 255 * (1.055 * colours ** (1 / 2.4) - 0.055)
    assert near(images[0], wanted.round().astype(np.uint8).repeat(24, 0).repeat(32, 1), 4)


# --- the rate -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [10, 25, 60, Fraction(30000, 1001), 240])
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_the_rate_is_that_of_the_file(rate, name, tmp_path):
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(12):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(corners(), format="rgb24")))
        container.mux(stream.encode())
    for stride in (1, 3):
        _, film = read(tmp_path / name, stride=stride)
        assert film.rate(stride) == (pytest.approx(float(rate) / stride, rel=1e-6), None)
    _, film = read(tmp_path / name, last=0)
    assert film.rate()[0] == pytest.approx(float(rate), rel=1e-6)


def test_a_variable_rate_is_its_mean_and_a_line(tmp_path):
    times = [0, 33, 67, 100, 167, 233, 300, 400, 433, 467]
    path = write(tmp_path / "a.mkv", [corners()] * 10, times=times)
    _, film = read(path)
    fps, line = film.rate()
    assert fps == pytest.approx(9 / 0.467, rel=1e-3)
    assert line.startswith("its rate varies from 10 to 30.3 frames a second; 19.27, their mean")
    _, film = read(path, last=3)
    assert film.rate() == (pytest.approx(30, rel=0.01), None)


def test_the_rate_goes_through_prepare_run_and_export(clip, tmp_path, capsys):
    frames = [image for _, image in read_frames(clip[0], last=3)]
    path = write(tmp_path / "a.mp4", frames, "libx264", "yuv420p", rate=60, crf="10")
    out = str(tmp_path / "sheet")
    _, found = prepare_video(path, out, stride=2, masks=False, **given(clip))
    assert found["fps"] == 30
    small = ["-D", "order=2", "--no-report", "-q"]
    run.main([f"{out}/scene.xml", "-o", f"{out}.run", *small])
    assert Run.open(f"{out}.run").fps == 30
    export.main([f"{out}.run", "--format", "npz", "-q"])
    with np.load(f"{out}.run/export/surface.npz") as arrays:
        assert arrays["fps"] == 30
    run.main([f"{out}/scene.xml", "-o", f"{out}.half", "-D", "stride=2", *small])
    assert Run.open(f"{out}.half").fps == 15
    run.main([f"{out}/scene.xml", "-o", f"{out}.given", "--fps", "12", *small])
    assert Run.open(f"{out}.given").fps == 12
