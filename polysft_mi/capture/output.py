"""The folder that a video becomes: its files, checked before the work and put in place after it."""

import contextlib
import json
import os
import shutil

import cv2

from polysft_mi.errors import InputError

from .frames import is_video

REPORT = "prepare"  # in the folder: the pictures of each step, and prepare.json
FRAME, MASK = "frames/{:05d}.png", "masks/{:05d}.png"


def target_folder(video, out, inputs, overwrite):
    """The folder to write (default: the video's name without its extension).

    ``inputs``: the files that the work will read; none may lie in the folder. Raises InputError
    where the folder may not be written or replaced.
    """
    if out is None:
        if not is_video(video):
            raise InputError(
                f"{video}: -o DIR, the folder to write, is needed for a folder of images"
            )
        out = os.path.splitext(video)[0]
    out = os.path.normpath(out)
    for path in inputs:
        a, b = os.path.realpath(path), os.path.realpath(out)
        if a == b or a.startswith(b + os.sep):
            raise InputError(
                f"{out}: holds {path}, which would be replaced; give another folder by -o"
            )
    if os.path.isdir(out) and os.listdir(out):
        if not overwrite:
            raise InputError(
                f"{out}: is there already; give --overwrite to replace it, or another folder by -o"
            )
        if not os.path.isfile(os.path.join(out, REPORT, "prepare.json")):
            raise InputError(
                f"{out}: holds files that this command did not write, and is not replaced; give"
                " another folder by -o"
            )
    elif os.path.exists(out) and not os.path.isdir(out):
        raise InputError(f"{out}: is a file; -o needs a folder")
    return out


@contextlib.contextmanager
def staged(out):
    """A new folder beside ``out`` that takes its place at the end; nothing is left of it where the
    work fails.
    """
    partial = os.path.join(os.path.dirname(out), f".{os.getpid()}.partial.{os.path.basename(out)}")
    try:
        os.makedirs(partial)
        yield partial
        _replace_folder(partial, out)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError) and error.errno is not None:
            raise InputError(f"{out}: {error.strerror or error}") from None
        raise


def _replace_folder(partial, out):
    """Rename a finished folder to ``out``; the folder that stood there is removed afterwards."""
    old = f"{partial}.old"
    if os.path.isdir(out):
        os.rename(out, old)
    try:
        os.rename(partial, out)
    except OSError:
        if os.path.isdir(old):
            os.rename(old, out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def write_png(path, image):
    """Write an image (H, W, 3) uint8 RGB, or (H, W) uint8 or uint16."""
    image = image[..., ::-1] if image.ndim == 3 else image
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    with open(path, "wb") as file:
        file.write(data.tobytes())


def write_json(path, value):
    """Write a value as indented JSON."""
    with open(path, "w", encoding="utf-8") as file:
        json.dump(value, file, indent=1, ensure_ascii=False)
        file.write("\n")
