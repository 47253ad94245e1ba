"""A video file as players show it: turned and mirrored, of square pixels, without the lines of
interlacing, opaque, in sRGB; and how fast its frames follow each other.
"""

import os
from collections import deque
from dataclasses import dataclass, field
from fractions import Fraction

import cv2
import numpy as np

from polysft_mi.errors import InputError

from . import hdr

# FFmpeg's numbers of what a container says of its fields: that of the top lines is shown first, or
# that of the bottom ones. Where it says nothing, each frame does.
_FIELD_ORDERS = {2: "tff", 5: "tff", 3: "bff", 4: "bff"}


@dataclass
class Film:
    """What is learned of a video while its frames are read: ``times`` [s] of the frames that were
    taken, None for one without; ``notes``: lines for a person, each once; ``rates``: what the file
    says of its frames a second; ``tick`` [s]: how finely it keeps time.
    """

    times: list = field(default_factory=list)
    notes: list = field(default_factory=list)
    rates: list = field(default_factory=list)
    tick: float = 0.0

    def note(self, line):
        if line not in self.notes:
            self.notes.append(line)

    def rate(self, stride=1):
        """(frames a second of those that were taken, every ``stride``-th, or None where nothing
        says; a line where they do not follow each other evenly, or None).

        That which the file says where its times agree, else the mean over the times.
        """
        said = [float(rate) / stride for rate in self.rates if rate and 0 < rate <= 1000]
        if len(self.times) < 2 or any(t is None for t in self.times):
            return (said[0] if said else None), None
        steps = np.diff(self.times)
        mean = (self.times[-1] - self.times[0]) / len(steps)
        end = 1.01 * self.tick / len(steps)  # what rounding does to the mean
        if not (steps > 0).all():
            return (said[0] if said else None), None
        for rate in [*said, 1 / mean]:
            room = 1.01 * self.tick + 0.05 / rate
            if np.abs(steps - 1 / rate).max() <= room and abs(mean - 1 / rate) <= end + 0.01 / rate:
                return rate, None
        slowest, fastest = 1 / steps.max(), 1 / steps.min()
        return 1 / mean, (
            f"its rate varies from {slowest:.3g} to {fastest:.3g} frames a second; {1 / mean:.4g},"
            " their mean, is kept"
        )


def decoded(path, film):
    """Yield (time [s] or None, load) of each frame of a video file; ``load()`` returns its pixels
    (H, W, 3) uint8 sRGB, as a player shows them. ``film`` is told what the file says. Raises
    InputError for a file that holds no pictures; FFmpeg's errors pass.
    """
    import av  # its log stays off: turned on, it is known to dead-lock with threads

    with av.open(file_name(path)) as container:
        stream = container.streams.best("video")
        if stream is None:
            kinds = ", ".join(s.type for s in container.streams) or "none"
            raise InputError(f"{path}: holds no pictures (streams: {kinds}); a video is needed")
        stream.thread_type = "AUTO"
        film.rates = [stream.guessed_rate, stream.average_rate, stream.base_rate]
        film.tick = float(stream.time_base or 0)
        aspect = _pixel_aspect(stream)
        for frame, time, side in _progressive(_frames(container, stream), stream, film):
            curve = hdr.curve_of(frame)
            if curve:
                film.note(f"HDR ({curve}); its colours are brought to those of a plain video (SDR)")
            yield time, lambda frame=frame, side=side: _shown(frame, side, aspect, path)


def file_name(path):
    """The path as FFmpeg must be given it: a colon in a name is not the end of a protocol's."""
    return "file:" + os.fspath(path)


def _frames(container, stream):
    """The decoded frames; those of WebM with an alpha channel by the decoder that reads it."""
    import av

    name = {"vp8": "libvpx", "vp9": "libvpx-vp9"}.get(stream.codec_context.name)
    if stream.metadata.get("alpha_mode") != "1" or name not in av.codecs_available:
        yield from container.decode(stream)
        return
    decoder = av.CodecContext.create(name, "r")
    for packet in container.demux(stream):
        yield from decoder.decode(packet if packet.size else None)


def _progressive(frames, stream, film):
    """Yield (frame, time [s] or None, display matrix or None); from the first frame that is
    interlaced on, those that are have their lines brought to one moment.
    """
    import av

    graph, waiting = None, deque()

    def pulled():
        while True:
            try:
                frame = graph.pull()
            except (BlockingIOError, EOFError):  # it wants the next frame, or has no more
                return
            if waiting:
                yield frame, *waiting.popleft()

    for frame in frames:
        about = frame.time, _matrix(frame)
        if graph is None and not frame.interlaced_frame:
            yield frame, *about
            continue
        if graph is None:
            film.note("interlaced; each frame is brought to one moment (deinterlaced)")
            graph = av.filter.Graph()
            source = graph.add_buffer(
                width=frame.width,
                height=frame.height,
                format=frame.format,
                time_base=frame.time_base or stream.time_base or Fraction(1, 1000),
            )
            first = _FIELD_ORDERS.get(getattr(stream.codec_context, "field_order", 0), "auto")
            each = graph.add("bwdif", f"mode=send_frame:deint=interlaced:parity={first}")
            sink = graph.add("buffersink")
            source.link_to(each)
            each.link_to(sink)
            graph.configure()
        waiting.append(about)
        graph.push(frame)
        yield from pulled()
    if graph is not None:
        graph.push(None)
        yield from pulled()


def _shown(frame, matrix, aspect, path):
    """Pixels (H, W, 3) uint8 of a decoded frame, as a player shows them."""
    if hdr.curve_of(frame):
        deep = frame.reformat(format="rgb48le", src_colorspace=_coefficients(frame))
        image = hdr.as_srgb(deep.to_ndarray(), frame)
    elif any(component.is_alpha for component in frame.format.components):
        image = frame.reformat(format="rgba", src_colorspace=_coefficients(frame)).to_ndarray()
        alpha = image[..., 3:].astype(np.uint16)
        image = ((image[..., :3] * alpha + 255 * (255 - alpha) + 127) // 255).astype(np.uint8)
    else:
        image = frame.reformat(format="rgb24", src_colorspace=_coefficients(frame)).to_ndarray()
    if aspect != 1:
        height, width = image.shape[:2]
        size = (round(width * max(aspect, 1)), round(height * max(1 / aspect, 1)))
        if max(size) > 16384:
            raise InputError(f"{path}: {size[0]}x{size[1]} pixels; at most 16384 a side are read")
        image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(_placed(image, matrix, path))


def _coefficients(frame):
    """What its colours are decoded with: as it says; where it does not say, BT.709 for pictures of
    high definition, as players do, and else BT.601 (swscale's numbers).
    """
    unspecified = 2
    if frame.colorspace != unspecified:
        return None
    if hdr.curve_of(frame):
        return 9  # BT.2020
    return 1 if frame.width >= 1280 or frame.height > 576 else 5


def _pixel_aspect(stream):
    """Width of a pixel by its height, as the file or the codec says; 1 where they say nothing, or
    nonsense."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return aspect if 0.1 <= aspect <= 10 and abs(aspect - 1) > 0.004 else 1.0


def _matrix(frame):
    """The display matrix (2, 2) of a frame, which takes stored pixels (right, down) to shown ones;
    None where it has none.
    """
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5] / 65536
            return np.array([[a, c], [b, d]])
    return None


def _placed(image, matrix, path):
    """An image (H, W, 3) turned and mirrored by its display matrix (2, 2), by whole quarter turns;
    its scale is left aside.
    """
    if matrix is None or np.linalg.det(matrix) == 0:
        return image
    unit = matrix / np.sqrt(abs(np.linalg.det(matrix)))
    whole = np.round(unit)
    if np.abs(unit - whole).max() > 0.1 or abs(np.linalg.det(whole)) != 1:
        raise InputError(
            f"{path}: its display matrix turns it by no whole quarter turn; export it upright"
        )
    if whole[0, 0] == 0:
        image = image.transpose(1, 0, 2)
    across, down = whole.sum(axis=1)
    return image[:: int(down), :: int(across)]
