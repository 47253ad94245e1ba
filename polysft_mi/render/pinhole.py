"""A pinhole sensor as a linear map, whatever plugin it is. Import only after a Mitsuba variant is
set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError

MIN_DEPTH = 1e-6  # depth [m] up to which a point counts as behind the camera


class Pinhole:
    """A pinhole sensor as a linear map, read off its rays: any sensor whose rays meet in a point,
    any crop.

    With C = ``basis`` (3x3, camera-to-world applied), the pixel (x, y) of the crop window sees
    along C (x, y, 1), scaled so that depth is the coordinate along the optical axis; ``project`` is
    the inverse.
    """

    def __init__(self, sensor):
        film = sensor.film()
        self._device = {}
        self.width, self.height = (int(x) for x in film.crop_size())

        corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=np.float32)
        with dr.suspend_grad():
            ray, _ = sensor.sample_ray(
                0.0, 0.5, mi.Point2f(corners.T.copy()), mi.Point2f(0.5), True
            )
            to_world = sensor.world_transform()
        o, d = np.array(ray.o, dtype=np.float64).T, np.array(ray.d, dtype=np.float64).T
        matrix = np.array(to_world.matrix, dtype=np.float64).reshape(4, 4)
        axis = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        d /= (d @ axis)[:, None]  # depth 1 along the axis
        self.origin = matrix[:3, 3]
        # what every ray of a pinhole passes through, and what the fourth corner must be if the map
        # is linear
        drift = np.linalg.norm(
            np.cross(o - self.origin, d / np.linalg.norm(d, axis=1, keepdims=True)), axis=1
        ).max()
        skewed = np.abs(d[3] - (d[1] + d[2] - d[0])).max()
        if drift > 1e-4 * max(1.0, np.linalg.norm(self.origin)) or skewed > 1e-4:
            raise InputError(
                f"sensor {type(sensor).__name__}: its rays are not those of a pinhole; use"
                " perspective or pinhole"
            )
        self.basis = np.stack(
            [(d[1] - d[0]) / self.width, (d[2] - d[0]) / self.height, d[0]], axis=1
        )
        self.inverse = np.linalg.inv(self.basis)
        # rows: right, down and forward of the OpenCV camera frame, in the world
        self.axes = np.stack([np.cross(axis, matrix[:3, 1]), -matrix[:3, 1], axis])

    @property
    def focal(self):
        """The focal length along x [pixels]."""
        return float(1 / np.linalg.norm(self.basis[:, 0]))

    def project(self, points):
        """Pixels (N, 2) of world points (N, 3) in the crop window, and whether each lies before the
        camera (N,).
        """
        x = (np.asarray(points, dtype=np.float64) - self.origin) @ self.inverse.T
        before = x[:, 2] > MIN_DEPTH
        return x[:, :2] / np.where(before, x[:, 2], 1)[:, None], before

    def attached(self, points):
        """:meth:`project` of a Point3d before the camera, in the same precision, attached: a
        Vector2d.
        """
        x = mi.Matrix3d(self.inverse) @ (points - mi.Point3d(self.origin))
        return mi.Vector2d(x.x / x.z, x.y / x.z)

    def derivatives(self, points):
        """Those of :meth:`project` by the points (N, 3) before the camera, (N, 2, 3) [pixels/m]."""
        x = (np.asarray(points, dtype=np.float64) - self.origin) @ self.inverse.T
        depth = np.maximum(x[:, 2], MIN_DEPTH)
        at = x[:, :2] / depth[:, None]
        return (self.inverse[:2] - at[:, :, None] * self.inverse[2]) / depth[:, None, None]

    def intrinsics(self):
        """The same camera as :class:`polysft_mi.camera.Intrinsics`, for points in the OpenCV camera
        frame.
        """
        K = self.inverse @ self.axes.T
        return Intrinsics(
            *(float(K[i, j] / K[2, 2]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))),
            self.width,
            self.height,
        )

    def to_camera(self, points):
        """World points (..., 3) in the OpenCV camera frame."""
        return (np.asarray(points) - self.origin) @ self.axes.T

    def device(self, scale=1):
        """The map as opaque Dr.Jit values (so that no number of it is baked into a kernel);
        ``scale`` samples a pixel and axis (a fraction: a coarser grid).
        """
        if scale not in self._device:
            basis, inverse = self.basis.copy(), self.inverse.copy()
            basis[:, :2] /= scale
            inverse[:2] *= scale
            values = [mi.Matrix3f(basis), mi.Matrix3f(inverse), mi.Point3f(self.origin)]
            dr.make_opaque(values)
            self._device[scale] = values
        return self._device[scale]
