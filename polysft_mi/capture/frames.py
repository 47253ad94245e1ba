"""The frames of a video file, or of a folder of images: decoded one after the other, checked, as
players and viewers show them.
"""

import os

from polysft_mi.errors import InputError
from polysft_mi.scene import focal_35mm, list_images, read_rgb

from .footage import Film, decoded, file_name


def read_frames(path, first=0, last=-1, stride=1, film=None):
    """Yield (index, image (H, W, 3) uint8 sRGB) of the frames ``first`` to ``last`` (inclusive, -1
    for the end) in steps of ``stride``.

    ``path``: a video file, a folder of images or a glob pattern; ``film``: a
    :class:`polysft_mi.capture.footage.Film` that is told about it. Raises InputError: for a file
    that is not a video or breaks off, for no frames, for frames of several sizes, and where
    ``first`` or ``last`` lies beyond the end.
    """
    film = Film() if film is None else film
    if first < 0 or last < -1 or (last != -1 and last < first) or stride < 1:
        raise InputError(
            f"first = {first}, last = {last}, stride = {stride}; 0 <= first <= last (or last = -1"
            " for the end) and stride >= 1 are needed"
        )
    seen, size = 0, None
    for index, (where, time, load) in enumerate(_sources(path, film)):
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
        film.times.append(time)
        yield index, image
    if not seen:
        raise InputError(f"{path}: holds no frames; a video, or a folder of images, is needed")
    if seen <= first:
        raise InputError(f"first = {first}; {path} holds {seen} frames, counted from 0")
    if last >= seen:
        raise InputError(
            f"last = {last}; {path} holds {seen} frames, counted from 0 (-1 is for the end)"
        )


def count_frames(path):
    """How many frames a video, a folder or a pattern of images holds; of a video that breaks off,
    those before. Raises InputError where there are none to read.
    """
    count = 0
    try:
        for _ in _sources(path, Film()):
            count += 1
    except InputError:
        if not count:
            raise
    return count


def is_video(path):
    """Whether ``path`` is a file, other than a folder or pattern of images."""
    return os.path.isfile(path)


def focal_length(path):
    """(the focal length for film of 36x24 mm [mm], where it is written), or (None, None). A video
    has it where the telephone wrote it there, images in Exif data."""
    if not is_video(path):
        image = list_images(path, "frames")[0]
        return focal_35mm(image), image
    import av

    try:
        with av.open(file_name(path)) as container:
            tags = [container.metadata, *(stream.metadata for stream in container.streams.video)]
    except (av.FFmpegError, OSError):
        return None, None
    for values in tags:
        try:
            return float(values["com.apple.quicktime.camera.focal_length.35mm_equivalent"]), path
        except (KeyError, ValueError):
            continue
    return None, None


def _sources(path, film):
    """(where, time [s] or None, load) of every frame: what to call it, when it is shown, and a
    function that returns its pixels.
    """
    if is_video(path):
        yield from _decoded(path, film)
    else:
        if not os.path.isdir(path) and not any(c in os.path.basename(path) for c in "*?["):
            raise InputError(f"{path}: no such file; a video, or a folder of images, is needed")
        for image in list_images(path, "frames"):
            yield image, None, lambda image=image: read_rgb(image)


def _decoded(path, film):
    import av

    count = 0
    try:
        for time, load in decoded(path, film):
            yield f"{path}, frame {count}", time, load
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
