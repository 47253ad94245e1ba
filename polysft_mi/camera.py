"""The pinhole camera: intrinsics K in pixels, read, checked, and written as a Mitsuba sensor."""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import InputError

LARGEST = 1e9  # [pixels, m]: a number beyond it is a mistake, and overflows where it is squared
_WIDEST = 170.0  # [degrees] across a pinhole's picture
_LENS = re.compile("k[1-6]|p[12]|skew|gamma|.*(dist|radial|tangential|fisheye|model|coef).*", re.I)
_NO_PINHOLE = re.compile("fish|omni|radial|equidistant|kannala|spheric|division|prism", re.I)


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera in its own frame (OpenCV: x right, y down, z forward, origin at the centre
    of projection).

    A point (X, Y, Z) is seen at pixel ``(fx X/Z + cx, fy Y/Z + cy)``; the centre of the first pixel
    is (0.5, 0.5). All values are in pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if not all(abs(v) <= LARGEST for v in values) or min(self.fx, self.fy) <= 0:
            raise InputError(
                f"camera: (fx, fy, cx, cy) = {values} is not a pinhole; finite values and positive"
                f" focal lengths are needed, none beyond {LARGEST:g}"
            )
        if not (1 <= self.width <= LARGEST and 1 <= self.height <= LARGEST):
            raise InputError(
                f"camera: image size {self.width:g}x{self.height:g}; both must be positive, and at"
                f" most {LARGEST:g}"
            )
        for focal, side in ((self.fx, self.width), (self.fy, self.height)):
            angle = 2 * math.degrees(math.atan(side / (2 * focal)))
            if angle > _WIDEST:
                raise InputError(
                    f"camera: a focal length of {focal:g} pixels sees {angle:.1f} degrees of"
                    f" {side:g} pixels; at most {_WIDEST:g} can be used: pixels are needed, not"
                    " shares of the picture"
                )

    def matrix(self) -> np.ndarray:
        """K, shape (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of the points (N, 3) [m, camera frame]."""
        points = np.asarray(points, dtype=np.float64)
        return points[:, :2] / points[:, 2:] * (self.fx, self.fy) + (self.cx, self.cy)

    @classmethod
    def from_matrix(
        cls, K: np.ndarray, width: int, height: int, where: str = "camera"
    ) -> Intrinsics:
        """From K (3, 3). Raises InputError where K is not that of a pinhole without skew."""
        K = np.asarray(K, dtype=np.float64)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise InputError(
                f"{where}: K has shape {K.shape} or values that are not finite; a finite 3x3 matrix"
                " is needed"
            )
        if np.abs(K[[1, 2, 2], [0, 0, 1]]).max() > 1e-9 or abs(K[2, 2] - 1) > 1e-9:
            raise InputError(
                f"{where}: K = {K.tolist()} is not a pinhole; it must read [[fx, 0, cx], [0, fy,"
                " cy], [0, 0, 1]]"
            )
        if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
            raise InputError(
                f"{where}: K has skew {K[0, 1]:g}; only a pinhole without skew is supported"
            )
        return cls(K[0, 0], K[1, 1], K[0, 2], K[1, 2], int(width), int(height))

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> Intrinsics:
        """From a JSON file with the keys fx, fy, cx, cy, width, height. Raises InputError, also for
        a lens that is no pinhole.
        """
        try:
            with open(path, encoding="utf-8-sig") as file:
                data = json.load(file)
        except FileNotFoundError:
            raise InputError(
                f"{path}: no such file; a camera file holds fx, fy, cx, cy, width, height in pixels"
            ) from None
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: not JSON ({error})") from None
        if not isinstance(data, dict):
            raise InputError(f"{path}: not a JSON object; fx, fy, cx, cy, width, height are needed")

        def number(name: str, whole: bool = False) -> float:
            if name not in data:
                raise InputError(f"{path}: no {name}; fx, fy, cx, cy, width, height are needed")
            try:
                value = float(data[name])
            except (TypeError, ValueError, OverflowError):
                value = math.nan
            if not (value.is_integer() if whole else math.isfinite(value)):
                kind = "a whole number" if whole else "a number"
                raise InputError(f"{path}: {name} = {data[name]!r:.40}; {kind} is needed")
            return value

        lens = number("fx"), number("fy"), number("cx"), number("cy")
        size = int(number("width", whole=True)), int(number("height", whole=True))
        try:
            check_pinhole(data)
            return cls(*lens, *size)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def sensor_xml(self, indent: str = "    ", world_to_camera: Any = None) -> str:
        """The ``<sensor>`` element: Mitsuba's ``perspective`` where the pixels are square, else our
        ``pinhole``; it stands where ``world_to_camera`` (4, 4) says, or at the world's origin.

        Only ``perspective`` is accepted by path replay with moving silhouettes
        (``prb_projective``).
        """
        if math.isclose(self.fx, self.fy, rel_tol=1e-6):
            fov = math.degrees(2 * math.atan(self.width / (2 * self.fx)))
            lens = [
                '<sensor type="perspective">',
                f'    <float name="fov" value="{fov:.12g}"/>',
                '    <string name="fov_axis" value="x"/>',
                (
                    '    <float name="principal_point_offset_x"'
                    f' value="{0.5 - self.cx / self.width:.12g}"/>'
                ),
                (
                    '    <float name="principal_point_offset_y"'
                    f' value="{0.5 - self.cy / self.height:.12g}"/>'
                ),
                '    <float name="near_clip" value="0.001"/>',
            ]
        else:
            lens = ['<sensor type="pinhole">'] + [
                f'    <float name="{k}" value="{getattr(self, k):.12g}"/>'
                for k in ("fx", "fy", "cx", "cy")
            ]
        place = 'origin="0, 0, 0" target="0, 0, 1" up="0, -1, 0"'
        if world_to_camera is not None:
            pose = np.asarray(world_to_camera, dtype=np.float64)
            rotation, origin = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
            points = {"origin": origin, "target": origin + rotation[2], "up": -rotation[1]}
            text = lambda x: ", ".join(f"{value:.12g}" for value in x + 0.0)
            place = " ".join(f'{name}="{text(x)}"' for name, x in points.items())
        lines = lens + [
            '    <transform name="to_world">',
            f"        <lookat {place}/>",
            "    </transform>",
            '    <film type="hdrfilm">',
            f'        <integer name="width" value="{self.width}"/>',
            f'        <integer name="height" value="{self.height}"/>',
            '        <string name="pixel_format" value="rgba"/>',
            '        <rfilter type="box"/>',
            '        <boolean name="sample_border" value="true"/>',
            "    </film>",
            "</sensor>",
        ]
        return "\n".join(indent + line for line in lines)


def check_pinhole(known: dict[str, Any], *, distortion: bool = False) -> None:
    """Raise InputError where what a camera's file holds, ``known``, says of the lens what no
    pinhole has; ``distortion``: but under that name it may.
    """

    def told(name: str, value: Any) -> bool:
        if not _LENS.fullmatch(name) or (distortion and name == "distortion"):
            return False
        if isinstance(value, str):  # a lens's, or a phone's
            return bool(_NO_PINHOLE.search(value))
        return bool(np.any(value))

    found = next((name for name, value in known.items() if told(name, value)), None)
    if found is None:
        return
    needed = (
        "a lens is known by distortion alone, a list of OpenCV's k1, k2, p1, p2, k3, ..."
        if distortion
        else "frames without distortion are needed; polysft prepare VIDEO removes it (the folder of"
        " the frames may be its VIDEO)"
    )
    raise InputError(f"{found} = {known[found]!r:.40}; {needed}")
