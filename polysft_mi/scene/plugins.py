"""Our Mitsuba plugins, and their registration: ``polysft``, ``raster``, ``pinhole``,
``varol_template``.

Import only after a Mitsuba variant is set; :func:`register` may be called any number of times.
"""

from __future__ import annotations

import os

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.backend import set_variant
from polyfit.device import on_device
from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.render import RasterIntegrator

from . import settings


def _resolved(pattern):
    """A folder or glob pattern as Mitsuba resolves file names: beside the scene file, else from the
    working directory.
    """
    if not pattern:
        return ""
    resolve = mi.file_resolver().resolve
    path = str(resolve(pattern))
    if not os.path.exists(path):
        folder, name = os.path.split(pattern)
        path = os.path.join(str(resolve(folder or ".")), name)
    return path.replace("/./", "/")


class PolySfT(mi.SamplingIntegrator):
    """

    .. pluginparameters::

     * - frames
       - |string|
       - The video: a folder of images, or a glob pattern.
     * - masks
       - |string|
       - The silhouettes, in the same form; empty for none. (Default: none)
     * - (every field of ``polysft_mi.scene.settings.Settings``)
       - |int|, |float| or |string|
       - See ``docs/scene.md``.
     * - (nested)
       - |integrator|
       - The integrator that renders the template: ``raster``, or a differentiable one of Mitsuba's.

    A whole shape-from-template experiment beside the scene that it needs. Rendered as an
    integrator, it renders the template by the nested one, so that ``mi.render`` of a loaded scene
    file shows what a fit starts from.
    """

    def __init__(self, props):
        super().__init__(props)
        nested = [
            value for _, value in props.objects() if isinstance(value, mi.Integrator)
        ]  # asks for no other: Mitsuba tells unknown ones
        if len(nested) != 1:
            raise InputError(
                f"polysft: {len(nested)} nested integrators; exactly one is needed, e.g."
                ' <integrator type="raster"/>'
            )
        self.renderer = nested[0]
        if "frames" not in props:
            raise InputError(
                "polysft: property 'frames' is missing; a folder of images or a glob pattern is"
                " needed"
            )
        self.frames, self.masks = (
            _resolved(str(props.get(name, ""))) for name in ("frames", "masks")
        )
        self.settings = settings.from_properties(props)

    def aov_names(self):
        return self.renderer.aov_names()

    def render(self, *args, **kwargs):
        return self.renderer.render(*args, **kwargs)

    def render_forward(self, *args, **kwargs):
        return self.renderer.render_forward(*args, **kwargs)

    def render_backward(self, *args, **kwargs):
        return self.renderer.render_backward(*args, **kwargs)

    def to_string(self):
        return (
            f"PolySfT[frames = {self.frames!r}, masks = {self.masks!r}, {self.settings}, renderer ="
            f" {self.renderer}]"
        )


class PinholeSensor(mi.Sensor):
    """

    .. pluginparameters::

     * - fx, fy, cx, cy
       - |float|
       - Focal lengths and principal point [pixels]; the centre of the first pixel is (0.5, 0.5).
     * - to_world
       - |transform|
       - Camera to world, Mitsuba's camera frame (x left, y up, z forward). (Default: identity)

    Mitsuba's ``perspective`` for pixels that are not square. Path replay with moving silhouettes
    does not take it.
    """

    def __init__(self, props):
        super().__init__(props)
        missing = [k for k in ("fx", "fy", "cx", "cy") if k not in props]
        if missing:
            raise InputError(
                f"pinhole: property '{missing[0]}' is missing; fx, fy, cx, cy are needed, in pixels"
            )
        camera = Intrinsics(
            *(props[k] for k in ("fx", "fy", "cx", "cy")), *map(int, self.film().size())
        )
        self.focal, self.centre = [camera.fx, camera.fy], [camera.cx, camera.cy]

    def sample_ray(self, time, sample1, position, aperture, active=True):
        film = self.film()
        size, offset = film.crop_size(), film.crop_offset()
        x = position.x * size[0] + offset[0]
        y = position.y * size[1] + offset[1]
        # Mitsuba's camera frame has x to the left and y up
        d = mi.Vector3f(
            (self.centre[0] - x) / self.focal[0], (self.centre[1] - y) / self.focal[1], 1
        )
        wavelengths, weight = self.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), sample1, active
        )
        to_world = self.world_transform()
        return (
            mi.Ray3f(to_world @ mi.Point3f(0), dr.normalize(to_world @ d), time, wavelengths),
            weight,
        )

    def sample_ray_differential(self, time, sample1, position, aperture, active=True):
        ray, weight = self.sample_ray(time, sample1, position, aperture, active)
        size = self.film().crop_size()
        out = mi.RayDifferential3f(ray)
        for name, step in (("x", mi.Vector2f(1 / size[0], 0)), ("y", mi.Vector2f(0, 1 / size[1]))):
            shifted, _ = self.sample_ray(time, sample1, position + step, aperture, active)
            setattr(out, f"o_{name}", shifted.o)
            setattr(out, f"d_{name}", shifted.d)
        out.has_differentials = True
        return out, weight

    def bbox(self):
        return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))

    def to_string(self):
        return (
            f"PinholeSensor[fx = {self.focal[0]}, fy = {self.focal[1]}, cx = {self.centre[0]}, cy ="
            f" {self.centre[1]}]"
        )


def _varol_template(props):
    """

    .. pluginparameters::

     * - folder
       - |string|
       - A sequence in the form of Kinect-Paper (Varol et al. 2012): ``mesh.pts``, ``mesh.tri``,
         ``cam.intr``, ``cam.ext``.
     * - resolution
       - |int|
       - Vertices along each side of the subdivided grid. (Default: 33)
     * - pose_fit
       - |string|
       - ``auto``: the pose of ``cam.ext`` is moved to the edges of the first image where they are
         clear; ``none``: it is taken as it is. (Default: auto)

    The sequence's flat template as a mesh in the camera frame, its texture coordinates the
    projection into the first image.
    """
    from .kinect_paper import RESOLUTION, template

    folder = str(mi.file_resolver().resolve(str(props["folder"])))
    log = lambda line: mi.Log(mi.LogLevel.Info, line)
    vertices, faces, uv = template(
        folder, int(props.get("resolution", RESOLUTION)), str(props.get("pose_fit", "auto")), log
    )
    mesh = mi.Mesh("template", len(vertices), len(faces), has_vertex_texcoords=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = on_device(vertices, mi.Float)
    params["faces"] = on_device(faces, mi.UInt32)
    flipped = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)  # Mitsuba's v runs down
    params["vertex_texcoords"] = on_device(flipped, mi.Float)
    params.update()
    return mesh


def register() -> None:
    """Register every plugin of ours with Mitsuba's current variant. Raises InputError where that,
    or the LLVM that Dr.Jit runs on, does not fit.
    """
    set_variant(mi.variant())
    mi.register_integrator("raster", RasterIntegrator)
    mi.register_integrator("polysft", PolySfT)
    mi.register_sensor("pinhole", PinholeSensor)
    mi.register_shape("varol_template", _varol_template)
