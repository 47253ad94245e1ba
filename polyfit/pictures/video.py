"""Videos that browsers play (H.264), written and read back by PyAV; and numbered PNGs where it was
built without the encoder.
"""

import contextlib
import functools
import os
import re
from fractions import Fraction

import numpy as np

from polyfit.errors import InputError
from polyfit.files import aside


@functools.cache
def can_encode():
    """Whether H.264 can be written here."""
    import av

    return "libx264" in av.codecs_available


def write_video(path, frames, fps=25):
    """Write ``frames``, an iterable of (H, W, 3) uint8 sRGB images of one size, to ``path`` (.mp4),
    ``fps`` frames a second.

    Sizes are padded to even numbers by repeating the last row or column, and shrunk to 3840 columns
    where there are more. Where no encoder is, the frames become ``000.png``, ``001.png``, ... in
    the folder that has ``path``'s name without its extension. Returns the path of what was written.
    Raises ValueError for no frames or frames of another form, OSError where they cannot be written.
    """
    frames = _checked(frames)
    if not can_encode():
        return _write_pngs(os.path.splitext(os.fspath(path))[0], frames)
    # a file opened by PyAV would stay open where the disk is full, and "a:" begin a protocol
    with aside(os.path.abspath(path)) as temporary, open(temporary, "wb", buffering=0) as file:
        _encode(file, frames, fps, os.fspath(path))
    return os.fspath(path)


def _checked(frames):
    size = None
    for k, frame in enumerate(frames):
        frame = np.asarray(frame)
        if (
            frame.dtype != np.uint8
            or frame.ndim != 3
            or frame.shape[2] != 3
            or size not in (None, frame.shape)
        ):
            raise ValueError(
                f"video frame {k} is {frame.dtype} {frame.shape}; uint8 (H, W, 3) of one size are"
                " needed"
            )
        size = frame.shape
        yield frame
    if size is None:
        raise ValueError("no video frames; at least one is needed")


def _encode(file, frames, fps, path):
    import av

    container = stream = None
    try:
        for frame in frames:
            padding = ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0))
            picture = av.VideoFrame.from_ndarray(np.pad(frame, padding, mode="edge"), "rgb24")
            if container is None:
                # the index first, so that browsers can start before they have all of it
                container = av.open(file, "w", format="mp4", options={"movflags": "faststart"})
                stream = _stream(container, picture.width, picture.height, fps)
            picture = picture.reformat(
                stream.width,
                stream.height,
                "yuv420p",
                dst_colorspace="ITU709",
                dst_color_range="MPEG",
                interpolation="AREA",
            )
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
        container.close()
    except (av.FFmpegError, OSError) as error:
        message = getattr(error, "strerror", None) or error
        raise OSError(None, f"the video cannot be written: {message}", path) from None
    finally:
        if container is not None:
            with contextlib.suppress(av.FFmpegError, OSError):  # said above
                container.close()


def _stream(container, width, height, fps):
    """The stream of a container that holds pictures of this size, shrunk to 3840 columns: beyond,
    browsers and graphics cards give up.
    """
    rate = Fraction(fps).limit_denominator(1000)
    stream = container.add_stream("libx264", rate, {"preset": "veryfast", "crf": "18"})
    stream.width = min(width, 3840)
    stream.height = 2 * round(height * stream.width / width / 2)
    stream.pix_fmt = "yuv420p"
    # marked: players take what is not marked for Rec.601 or Rec.709 by its size
    bt709, tv = 1, 1  # as FFmpeg numbers them
    marks = stream.codec_context
    marks.colorspace = marks.color_primaries = marks.color_trc = bt709
    marks.color_range = tv
    return stream


def _write_pngs(folder, frames):
    import cv2

    os.makedirs(folder, exist_ok=True)
    count = 0
    for count, frame in enumerate(frames, start=1):
        _, data = cv2.imencode(".png", frame[..., ::-1])
        with (
            aside(os.path.join(folder, f"{count - 1:03d}.png")) as temporary,
            open(temporary, "wb") as file,
        ):
            file.write(data.tobytes())
    for name in os.listdir(folder):  # what a longer video left before
        number = re.fullmatch(r"(\d{3,})\.png", name)
        if number and int(number[1]) >= count:
            os.remove(os.path.join(folder, name))
    return folder


def read_video(path):
    """The frames of a video that :func:`write_video` wrote, one after the other, (H, W, 3) uint8
    sRGB. Raises InputError where it cannot be read.
    """
    import av

    try:
        # "file:", for a colon in a name is not the end of a protocol's
        with av.open("file:" + os.fspath(path)) as container:
            for frame in container.decode(video=0):
                yield frame.to_ndarray(format="rgb24")
    except (av.FFmpegError, OSError, IndexError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: not a readable video ({reason})") from None
