"""What a person has beside a video, made fit to its folder's frames: tracks, depth images, and
further cameras.
"""

import os

import numpy as np

from polysft_mi.scene import DepthImages, Tracks

from .camera import Lens
from .depth import DEPTH, check_range, recognise_depth, write_depth
from .frames import count_frames
from .rig import CAMERAS

_TRACKS = "tracks.npz"


class GivenEvidence:
    """``tracks``: a file, and the coordinate ``track_centre`` that it gives the first pixel's
    centre; ``depth``: a folder or a pattern, its whole numbers in ``depth_unit`` [m]; ``rig``: a
    :class:`polysft_mi.capture.rig.GivenRig`; None each for none; ``depth_known_to``: as the setting
    of that name.
    """

    def __init__(
        self,
        tracks=None,
        track_centre=0.5,
        depth=None,
        depth_unit=1e-3,
        depth_known_to="metric",
        rig=None,
    ):
        self._tracks, self._centre = tracks, track_centre
        self._depth, self._unit, self._known_to = depth, depth_unit, depth_known_to
        self.rig = rig

    def lens(self, width, height):
        """The :class:`polysft_mi.capture.camera.Lens` that it says the frames were taken with, for
        frames of a size; None where it says nothing.
        """
        if self.rig and (lens := self.rig.lens(width, height)) is not None:
            return lens
        colour = recognise_depth(self._depth).colour if self._depth else None
        return Lens(colour, (), self._depth).resized(width, height) if colour else None

    @property
    def inputs(self):
        """The files and folders that are read."""
        rig = self.rig.path if self.rig else None
        return [path for path in (self._tracks, self._depth, rig) if path]

    def open(self, video, size, first=0, last=-1, stride=1):
        """Read and check what there is of the frames ``first`` to ``last`` in steps of ``stride``
        of a ``video``, as :func:`polysft_mi.capture.frames.read_frames` takes them, of a ``size``
        (width, height). Raises InputError.
        """
        if not (self._tracks or self._depth):
            return
        count = count_frames(video)
        indices = list(range(count))[first : None if last == -1 else last + 1 : stride]
        if self._tracks:
            self._known = Tracks.read(self._tracks, count, indices, self._centre)
        if self._depth:
            self._source = recognise_depth(self._depth)
            self._images = DepthImages.open(
                self._source.images, count, indices, self._unit, self._known_to
            )
            check_range(self._images)
            if self._source.camera is None:
                self._images.like_frames(0, size)

    def write(self, folder, indices, straight):
        """Write what was opened, of the frames ``indices``, into the folder, undistorted and scaled
        by ``straight`` (:class:`polysft_mi.capture.camera.Undistortion`), further cameras scaled
        likewise. Returns the settings that name them, and lines for a person. Raises InputError.
        """
        settings, lines = {}, []
        if self._tracks:
            known = self._known
            positions = straight.points(known.positions).reshape(known.positions.shape)
            queries = np.zeros((len(known.query), 3))
            queries[:, 0] = np.minimum(known.query, len(indices) - 1)
            np.savez_compressed(
                os.path.join(folder, _TRACKS),
                tracks=positions.astype(np.float32),
                visible=known.visible,
                queries=queries,
            )
            settings["tracks"] = _TRACKS
            seen = 100 * known.visible.mean()
            lines.append(f"tracks: {len(known.query)} of {self._tracks}, {seen:.0f} % visible")
        if self._depth:
            source, images, where = self._source, self._images, os.path.join(folder, DEPTH)

            def converted(k):
                if source.camera is not None:
                    return source.seen_by(images.read(k), straight.camera)
                return straight.numbers(images.like_frames(k, straight.size))

            settings |= {
                "depth": DEPTH,
                **write_depth(where, images, converted),
            }
            form = f", as of {source.form}" if source.form else ""
            moved = ", as the frames' camera sees it" if source.camera is not None else ""
            lines.append(f"depth: that of {self._depth}{form}{moved}")
            lines += [source.note] if source.note else []
        if self.rig:
            scale = straight.camera.width / straight.size[0]
            where = os.path.join(folder, CAMERAS)
            lines += self.rig.write(where, indices, straight.camera, scale)
            settings["cameras"] = CAMERAS
        return settings, lines
