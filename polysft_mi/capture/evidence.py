"""What a person has beside a video, made fit to its folder's frames: tracks, depth images, and
further cameras.
"""

import os

import numpy as np

from polysft_mi.errors import InputError
from polysft_mi.scene import DepthImages, Tracks

from .output import write_png
from .rig import CAMERAS

_TRACKS, _DEPTH = "tracks.npz", "depth/{:05d}.png"
_UNIT = 1e-4  # metres of a whole number of the depth images that are written
_MOST = 65535  # what they hold; farther off there is no sheet


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

    @property
    def inputs(self):
        """The files and folders that are read."""
        rig = self.rig.path if self.rig else None
        return [path for path in (self._tracks, self._depth, rig) if path]

    def write(self, folder, indices, straight):
        """Write those of the frames ``indices`` into the folder, undistorted and scaled by
        ``straight`` (:class:`polysft_mi.capture.camera.Undistortion`), further cameras scaled
        likewise. Returns the settings that name them, and lines for a person. Raises InputError.
        """
        settings, lines = {}, []
        if self._tracks:
            known = Tracks.read(self._tracks, None, indices, self._centre)
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
            images = DepthImages.open(self._depth, None, indices, self._unit)
            os.makedirs(os.path.join(folder, os.path.dirname(_DEPTH)))
            for k in range(len(indices)):
                depth = straight.numbers(self._sized(images, k, straight))
                # what is fitted to each frame anyway is known to no scale
                unit = _UNIT if self._known_to == "metric" else depth.max() / _MOST
                whole = np.round(depth / max(unit, 1e-12))
                whole = np.where(whole <= _MOST, whole, 0).astype(np.uint16)
                write_png(os.path.join(folder, _DEPTH.format(k)), whole)
            settings |= {
                "depth": os.path.dirname(_DEPTH),
                "depth_unit": _UNIT,
                "depth_known_to": self._known_to,
            }
            lines.append(f"depth: that of {self._depth}")
        if self.rig:
            scale = straight.camera.width / straight.size[0]
            where = os.path.join(folder, CAMERAS)
            lines += self.rig.write(where, indices, straight.camera, scale)
            settings["cameras"] = CAMERAS
        return settings, lines

    @staticmethod
    def _sized(images, k, straight):
        """A depth image with as many pixels as the frames: the nearest of each."""
        depth, (width, height) = images.read(k), straight.size
        h, w = depth.shape
        if abs(w * height - h * width) > 0.02 * w * height:
            raise InputError(
                f"{images.files[k]}: {w}x{h} pixels are not of the shape of the frames,"
                f" {width}x{height}; depth as the camera of the frames sees it is needed"
            )
        rows = ((np.arange(height) + 0.5) * h / height).astype(int)
        columns = ((np.arange(width) + 0.5) * w / width).astype(int)
        return depth[rows[:, None], columns]
