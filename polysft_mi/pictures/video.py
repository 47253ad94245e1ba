"""Videos that browsers play (H.264), written and read back, and numbered PNGs where no encoder
is.
"""

import functools
import os
import re
import subprocess

import numpy as np

from polysft_mi.errors import InputError
from polysft_mi.files import aside

# Rec.709, converted and marked: what is not marked, players take for Rec.601 or 709 by its size
_MARKS = "range=tv:colorspace=bt709:color_primaries=bt709:color_trc=bt709"
_WIDEST = 3840  # beyond it, browsers and graphics cards give up
_SIZE = rf"w=min(iw\,{_WIDEST}):h=-2:flags=area"
_FILTER = [
    "-vf",
    f"scale={_SIZE}:out_color_matrix=bt709:out_range=tv,format=yuv420p,setparams={_MARKS}",
]
_CODEC = [
    "-c:v",
    "libx264",
    "-preset",
    "veryfast",
    "-crf",
    "18",
    "-pix_fmt",
    "yuv420p",
    "-movflags",
    "+faststart",
]


@functools.cache
def encoder():
    """Path of an ffmpeg that can encode H.264, or None. Found out once, by encoding two small
    frames.
    """
    try:
        import imageio_ffmpeg

        path = imageio_ffmpeg.get_ffmpeg_exe()
        command = [
            path,
            "-v",
            "error",
            "-f",
            "lavfi",
            "-i",
            "color=s=64x64:r=2:d=1",
            *_FILTER,
            *_CODEC,
            "-f",
            "mp4",
            "-y",
            os.devnull,
        ]
        command[command.index("+faststart")] = (
            "+frag_keyframe"  # the null device cannot be read back
        )
        subprocess.run(
            command, check=True, stdin=subprocess.DEVNULL, capture_output=True, timeout=60
        )
        return path
    except (ImportError, RuntimeError, OSError, subprocess.SubprocessError):
        return None


def write_video(path, frames, fps=25):
    """Write ``frames``, an iterable of (H, W, 3) uint8 sRGB images of one size, to ``path`` (.mp4),
    ``fps`` frames a second.

    Sizes are padded to even numbers by repeating the last row or column, and shrunk to 3840 columns
    where there are more. Where no encoder is, the frames become ``000.png``, ``001.png``, ... in
    the folder that has ``path``'s name without its extension. Returns the path of what was written.
    Raises ValueError for no frames or frames of another form, OSError where they cannot be written.
    """
    frames = _checked(frames)
    if encoder() is None:
        return _write_pngs(os.path.splitext(os.fspath(path))[0], frames)
    with aside(path) as temporary:
        _encode(temporary, frames, fps, os.fspath(path))
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


def _encode(temporary, frames, fps, path):
    process = None
    try:
        for frame in frames:
            frame = np.pad(
                frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge"
            )
            if process is None:
                source = [
                    "-f",
                    "rawvideo",
                    "-pix_fmt",
                    "rgb24",
                    "-s",
                    f"{frame.shape[1]}x{frame.shape[0]}",
                    "-r",
                    f"{fps:g}",
                    "-i",
                    "-",
                ]
                command = [
                    encoder(),
                    "-v",
                    "error",
                    *source,
                    *_FILTER,
                    *_CODEC,
                    "-f",
                    "mp4",
                    "-y",
                    temporary,
                ]
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                )
            process.stdin.write(frame.tobytes())
        _, message = process.communicate()
    except BrokenPipeError:  # ffmpeg ended first; it says why
        _, message = process.communicate()
    except BaseException:
        if process is not None:
            process.kill()
            process.communicate()
        raise
    if process.returncode:
        lines = message.decode(errors="replace").split("\n")
        raise OSError(None, f"ffmpeg cannot write the video: {lines[0].strip()}", path)


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
    if encoder() is None:
        raise InputError(
            f"{path}: cannot be read without ffmpeg (the Python package imageio-ffmpeg)"
        )
    command = [
        encoder(),
        "-v",
        "error",
        "-i",
        os.fspath(path),
        "-f",
        "image2pipe",
        "-c:v",
        "ppm",
        "-",
    ]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        try:
            while process.stdout.readline() == b"P6\n":
                width, height = map(int, process.stdout.readline().split())
                process.stdout.readline()  # the largest value, 255
                data = process.stdout.read(3 * width * height)
                if len(data) == 3 * width * height:
                    yield np.frombuffer(data, np.uint8).reshape(height, width, 3)
        finally:
            process.kill()  # where the caller stops before the end
        message = process.stderr.read().decode(errors="replace").strip().split("\n")[0]
    if message:
        raise InputError(f"{path}: not a readable video ({message[:200]})")
