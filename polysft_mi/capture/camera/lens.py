"""The camera that took the frames: focal length, principal point, and the lens's distortion, which
is removed before anything else looks at a frame."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from polysft_mi.camera import LARGEST, Intrinsics
from polysft_mi.errors import InputError


@dataclass(frozen=True)
class Lens:
    """A pinhole and what keeps the lens from being one.

    ``camera``: :class:`polysft_mi.camera.Intrinsics` of the frames as they were taken;
    ``distortion``: OpenCV's coefficients (k1, k2, p1, p2, k3, ...), in normalised image
    coordinates; ``source``: how they are known, in words.
    """

    camera: Intrinsics
    distortion: tuple = ()
    source: str = ""

    def __post_init__(self):
        if (
            len(self.distortion) not in (0, 4, 5, 8, 12, 14)
            or not (np.abs(self.distortion) <= LARGEST).all()
        ):
            raise InputError(
                f"{self.source}: {len(self.distortion)} distortion coefficients; 4, 5, 8, 12 or 14"
                f" finite numbers, none beyond {LARGEST:g}, in OpenCV's order, are needed"
            )

    @classmethod
    def from_fov(cls, fov, width, height, source="--fov"):
        """A pinhole whose picture is ``fov`` degrees wide, its principal point in the middle."""
        if not 1 <= fov <= 170:
            raise InputError(
                f"{source} {fov:g}: 1 to 170 degrees, across the width of the picture, can be used"
            )
        f = width / (2 * math.tan(math.radians(fov) / 2))
        return cls(
            Intrinsics(f, f, width / 2, height / 2, width, height), (), f"{source} {fov:g} degrees"
        )

    @classmethod
    def from_focal_35mm(cls, focal, width, height, source):
        """A pinhole by the focal length [mm] that gives the same diagonal angle of view on film of
        36x24 mm.
        """
        f = focal / math.hypot(36, 24) * math.hypot(width, height)
        return cls(
            Intrinsics(f, f, width / 2, height / 2, width, height),
            (),
            f"{focal:g} mm on 35 mm film, as in {source}",
        )

    def resized(self, width, height):
        """The same lens for frames of another size of the same aspect. Raises InputError where the
        aspect differs.
        """
        c = self.camera
        if (width, height) == (c.width, c.height):
            return self
        x, y = width / c.width, height / c.height
        if not _same_aspect((width, height), (c.width, c.height)):
            raise InputError(
                f"{self.source}: for pictures of {c.width}x{c.height}; the frames have"
                f" {width}x{height}, another shape"
            )
        return Lens(
            Intrinsics(c.fx * x, c.fy * y, c.cx * x, c.cy * y, width, height),
            self.distortion,
            self.source,
        )

    def as_json(self):
        """What a camera file holds."""
        c = self.camera
        values = {
            "width": c.width,
            "height": c.height,
            "fx": c.fx,
            "fy": c.fy,
            "cx": c.cx,
            "cy": c.cy,
        }
        return {**values, "distortion": list(self.distortion)} if self.distortion else values


def _same_aspect(a, b):
    """Whether two sizes (width, height) are of one shape, but for rounding to whole pixels."""
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1) <= 0.01


class Undistortion:
    """Frames as the pinhole ``camera`` (its attribute) would have taken them: distortion removed,
    then scaled by ``scale``.

    The undistorted picture has the lens's own K, so that its middle keeps its size; what lies
    beyond the frame's border repeats the border.
    """

    def __init__(self, lens, scale=1.0):
        c = self._from = lens.camera
        self.size = c.width, c.height  # of the frames as they were taken
        if not 0 < scale <= 4:
            raise InputError(f"--scale {scale:g}: above 0, and at most 4, is needed")
        size = max(1, round(c.width * scale)), max(1, round(c.height * scale))
        if min(size) < 16:
            raise InputError(
                f"--scale {scale:g}: makes frames of {size[0]}x{size[1]} pixels; at least 16 a side"
                " are needed"
            )
        if not _same_aspect(size, self.size):
            raise InputError(
                f"--scale {scale:g}: makes frames of {size[0]}x{size[1]} pixels, too small to keep"
                f" the shape of {c.width}x{c.height}"
            )
        self.camera = lens.resized(*size).camera
        self._distortion = np.array(lens.distortion) if any(lens.distortion) else None
        self._K = c.matrix()
        self._K[:2, 2] -= 0.5  # OpenCV counts from the centre of the first pixel
        self._maps = None
        if self._distortion is not None:
            self._maps = cv2.initUndistortRectifyMap(
                self._K, self._distortion, None, self._K, (c.width, c.height), cv2.CV_16SC2
            )

    def image(self, image):
        """A frame (H, W, 3) uint8, undistorted and scaled."""
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        size = self.camera.width, self.camera.height
        if size != image.shape[1::-1]:
            image = cv2.resize(
                image,
                size,
                interpolation=cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_CUBIC,
            )
        return image

    def numbers(self, image):
        """An image (H, W) of numbers that have no mean (depth, 0 where it is unknown), undistorted
        and scaled: the nearest pixel of each.
        """
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        size = self.camera.width, self.camera.height
        if size != image.shape[1::-1]:
            image = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return image

    def points(self, points):
        """Where pixels (N, 2) of the frame as it was taken lie in :meth:`image`; (0.5, 0.5) is the
        centre of the first pixel of both.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if self._distortion is not None:
            points = (
                cv2.undistortPoints((points - 0.5)[:, None], self._K, self._distortion, P=self._K)[
                    :, 0
                ]
                + 0.5
            )
        return points * (
            self.camera.width / self._from.width,
            self.camera.height / self._from.height,
        )
