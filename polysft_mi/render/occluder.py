"""What stands before the surface: a mesh of its own scene, as depth. Import only after a Mitsuba
variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device

from .raster import RasterIntegrator


class Occluder:
    """A mesh with ``faces`` (F, 3) of ``count`` vertices, seen by a ``sensor``."""

    def __init__(self, faces: np.ndarray, count: int, sensor: mi.Sensor) -> None:
        mesh = mi.Mesh("occluder", count, len(faces))
        params = mi.traverse(mesh)
        params["faces"] = on_device(faces, mi.UInt32)
        params["vertex_positions"] = dr.zeros(mi.Float, 3 * count)
        params.update()
        self._sensor = sensor
        self._scene = mi.load_dict({"type": "scene", "occluder": mesh})
        self._params = mi.traverse(self._scene)
        self._key = next(k for k in self._params.keys() if k.endswith("vertex_positions"))
        self._raster: RasterIntegrator = mi.load_dict({"type": "raster"})

    def depth(self, vertices: np.ndarray) -> np.ndarray:
        """Its depth (H, W) float32 [m] along the camera's axis, its vertices at (N, 3) [m, world];
        infinite where there is nothing.
        """
        self._params[self._key] = on_device(vertices, mi.Float)
        self._params.update()
        with dr.suspend_grad():
            view = self._raster.view(self._scene, self._sensor)
            found = np.array(view.depth).reshape(view.size[::-1])
        width, height = self._sensor.film().crop_size()
        out = np.full((int(height), int(width)), np.inf, dtype=np.float32)
        x, y = (int(view.region[k][0]) for k in (0, 1))
        out[y : y + found.shape[0], x : x + found.shape[1]] = found
        return out
