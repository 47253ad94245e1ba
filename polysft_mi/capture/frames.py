"""The frames of a video file, or of a folder of images: decoded one after the other, checked,
turned upright.
"""

import os

import numpy as np

from polysft_mi.errors import InputError
from polysft_mi.scene import focal_35mm, list_images, read_rgb


def read_frames(path, first=0, last=-1, stride=1):
    """Yield (index, image (H, W, 3) uint8 sRGB) of the frames ``first`` to ``last`` (inclusive, -1
    for the end) in steps of ``stride``.

    ``path``: a video file, a folder of images or a glob pattern. Raises InputError: for a file that
    is not a video or breaks off, for no frames, for frames of several sizes, and where ``first`` or
    ``last`` lies beyond the end.
    """
    if first < 0 or last < -1 or (last != -1 and last < first) or stride < 1:
        raise InputError(
            f"first = {first}, last = {last}, stride = {stride}; 0 <= first <= last (or last = -1"
            " for the end) and stride >= 1 are needed"
        )
    seen, size = 0, None
    for index, (where, load) in enumerate(_sources(path)):
        seen = index + 1
        if last != -1 and index > last:
            return
        if index < first or (index - first) % stride:
            continue
        image = load()
        here = image.shape[1::-1]
        size = size or here
        if here != size:
            raise InputError(
                f"{where}: {here[0]}x{here[1]} pixels, but the frames before have"
                f" {size[0]}x{size[1]}; all frames must be of one size"
            )
        if min(here) < 16 or max(here) > 16384:
            raise InputError(f"{where}: {here[0]}x{here[1]} pixels; 16 to 16384 a side are needed")
        yield index, image
    if not seen:
        raise InputError(f"{path}: holds no frames; a video, or a folder of images, is needed")
    if seen <= first:
        raise InputError(f"first = {first}; {path} holds {seen} frames, counted from 0")
    if last >= seen:
        raise InputError(
            f"last = {last}; {path} holds {seen} frames, counted from 0 (-1 is for the end)"
        )


def is_video(path):
    """Whether ``path`` is a file, other than a folder or pattern of images."""
    return os.path.isfile(path)


def focal_length(path):
    """(the focal length for film of 36x24 mm [mm], where it is written), or (None, None). A video
    has it where the telephone wrote it there, images in Exif data."""
    if not is_video(path):
        image = list_images(path, "frames")[0]
        return focal_35mm(image), image
    import av  # its log stays off: turned on, it is known to dead-lock with threads

    try:
        with av.open(_name(path)) as container:
            tags = [container.metadata, *(stream.metadata for stream in container.streams.video)]
    except (av.FFmpegError, OSError):
        return None, None
    for values in tags:
        try:
            return float(values["com.apple.quicktime.camera.focal_length.35mm_equivalent"]), path
        except (KeyError, ValueError):
            continue
    return None, None


def _sources(path):
    """(where, load) of every frame: what to call it, and a function that returns its pixels."""
    if is_video(path):
        yield from _decoded(path)
    else:
        if not os.path.isdir(path) and not any(c in os.path.basename(path) for c in "*?["):
            raise InputError(f"{path}: no such file; a video, or a folder of images, is needed")
        for image in list_images(path, "frames"):
            yield image, lambda image=image: read_rgb(image)


def _decoded(path):
    import av

    count = 0
    try:
        with av.open(_name(path)) as container:
            if not container.streams.video:
                raise InputError(
                    f"{path}: holds no pictures (streams:"
                    f" {', '.join(s.type for s in container.streams) or 'none'}); a video is needed"
                )
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                yield f"{path}, frame {count}", lambda frame=frame: _upright(frame)
                count += 1
    except (av.FFmpegError, OSError) as error:
        text = getattr(error, "strerror", None) or str(error)
        at = (
            f"; the {count} frames before can be used: --last {count - 1}"
            if count
            else "; a video that FFmpeg decodes is needed"
        )
        raise InputError(
            f"{path}: cannot be decoded{f' after frame {count - 1}' if count else ''} ({text}){at}"
        ) from None


def _upright(frame):
    """Pixels of a decoded frame, turned by its display matrix (telephones store what the sensor
    saw).
    """
    turns = round(frame.rotation / 90) % 4  # quarter turns against the clock
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), turns))


def _name(path):
    """The path as FFmpeg must be given it: a colon in a name is not the end of a protocol's."""
    return "file:" + os.fspath(path)
