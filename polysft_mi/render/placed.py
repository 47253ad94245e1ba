"""The template's mesh in its Mitsuba scene: vertices go in, an image and its alpha come out,
attached. Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.colours import grey, linear, srgb
from polyfit.device import on_device
from polysft_mi.errors import InputError

from .crop import Crop
from .pinhole import Pinhole
from .raster import RasterIntegrator


class PlacedMesh:
    """The rendered ``mesh`` of a scene, seen by its sensor through a differentiable ``renderer``.

    ``corner`` (V,): the template's vertex of each rendered one (loaders split vertices along
    texture seams); ``sppi``: samples a pixel of edges met indirectly, where the renderer has such
    and the scene does not say how many; ``where``: the scene's path, for messages. Integrators of
    Mitsuba's give alpha no gradient: there alpha is the ``raster`` image's of the mesh alone,
    without what else the scene holds. Raises InputError where the sensor is no pinhole, or not one
    that the renderer takes.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        renderer: Any,
        mesh: mi.Mesh,
        corner: np.ndarray,
        sppi: int = 0,
        where: str = "scene",
    ) -> None:
        self.scene, self.sensor, self.renderer, self.mesh = scene, sensor, renderer, mesh
        self.corner, self.camera = corner, Pinhole(sensor)
        self._more = sppi, where
        #: (F, 3): the rendered vertices of the triangles
        self.rendered_faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        #: (F, 3): the template's vertices at the corners of the rendered triangles
        self.faces = corner[self.rendered_faces]
        #: (2V,): texture coordinates that replaced the mesh's own, or None
        self.texcoords: np.ndarray | None = None
        self._corner = on_device(corner, mi.UInt32)
        self._is_identity = np.array_equal(corner, np.arange(len(corner)))
        # through the scene, not the mesh alone: only so does the scene rebuild what it traces rays
        # with
        self._params = mi.traverse(scene)
        self._key = _positions_key(self._params, mesh)
        # what is behind the surface is black, with a silhouette's gradient towards black
        renderer.hide_emitters = True
        if getattr(renderer, "sppi", 0) is None:
            renderer.sppi = sppi
        self.is_raster = isinstance(renderer, RasterIntegrator)
        if not self.is_raster:
            if not str(sensor).startswith("PerspectiveCamera"):
                raise InputError(
                    f"{where}: {renderer.class_name()} takes Mitsuba's perspective sensor only"
                    " (fx = fy); use raster"
                )
            self._alone = mi.load_dict({"type": "scene", "template": mesh})
            self._params_alone = mi.traverse(self._alone)
            self._key_alone = _positions_key(self._params_alone, mesh)
            self._silhouette = mi.load_dict({"type": "raster"})

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image [pixels]."""
        return self.camera.width, self.camera.height

    def seen_by(self, sensor: mi.Sensor) -> PlacedMesh:
        """The same mesh, seen by another sensor."""
        return PlacedMesh(self.scene, sensor, self.renderer, self.mesh, self.corner, *self._more)

    def place(self, vertices: mi.Point3f) -> None:
        """Put the template's ``vertices`` (Point3f of N [m, world], attached or not) into the
        scene.
        """
        points = vertices
        if not (
            self._is_identity and dr.width(vertices) == len(self.corner)
        ):  # gradients sum in double
            flat = mi.Float64(dr.ravel(vertices))
            points = mi.Point3f(dr.gather(mi.Point3d, flat, self._corner))
        self._params[self._key] = dr.ravel(points)
        self._params.update()
        if not self.is_raster:
            self._params_alone[self._key_alone] = dr.ravel(points)
            self._params_alone.update()

    def set_texcoords(self, texcoords: mi.Float) -> None:
        """Replace the texture coordinates (Float of 2V, of the rendered vertices)."""
        self.texcoords = np.array(texcoords)
        self._params[self._key.removesuffix("positions") + "texcoords"] = texcoords
        self._params.update()

    def make_grey(self, weights: np.ndarray, is_coded: bool) -> bool:
        """Take the colours of the mesh's reflectance away, as :func:`polyfit.colours.grey` does;
        returns whether it had some.
        """
        params, had = mi.traverse(self.mesh.bsdf()), False
        for key in [key for key in params.keys() if "reflectance" in key or "base_color" in key]:
            old = np.array(params[key])
            if key.endswith(".data") and old.ndim == 3 and old.shape[2] >= 3:  # (H, W, 3 or 4)
                colour, is_byte = old[..., :3].astype(np.float32), old.dtype == np.uint8
                now = grey(linear(colour / 255) if is_byte else colour, weights, is_coded)
                if is_byte:
                    now = np.round(255 * srgb(now))
                new = np.concatenate([now, old[..., 3:]], 2).astype(old.dtype)
            elif key.endswith(".value") and old.shape[0] == 3:
                colour = old.reshape(3).astype(np.float32)
                new = grey(colour, weights, is_coded).reshape(old.shape)
            else:
                continue
            params[key] = type(params[key])(new)
            had |= not np.allclose(old, new, atol=0.01 * max(float(old.max()), 1e-9))
        if had:
            params.update()
        return had

    def crop(
        self,
        vertices: np.ndarray,
        boxes: Sequence[tuple[float, float, float, float]] = (),
        margin: int = 0,
        grid: int = 1,
    ) -> Crop:
        """What of the image the surface (N, 3) [m, world] and the ``boxes`` (x, y, x, y) [pixels]
        cover, and a ``margin`` [pixels] around: beyond it is nothing. It begins at a multiple of
        ``grid``. The whole image where the scene may show something else.
        """
        position, before = self.camera.project(vertices)
        if not (self.is_raster and len(self.scene.shapes()) == 1 and before.all()):
            return Crop(0, 0, *self.size)
        own = (*position.min(0), *position.max(0))
        return Crop.around([own, *boxes], margin + 1, self.size, grid)  # 1: antialiasing blends

    def image(
        self, vertices: mi.Point3f, seed: int = 0, spp: int = 0, crop: Crop | None = None
    ) -> tuple[mi.TensorXf, mi.TensorXf]:
        """Render the surface: (rgb (H, W, 3), linear, over black, and alpha (H, W, 1)), attached
        to the vertices (Point3f of N [m, world]); of the whole image, or of a ``crop``. ``spp``:
        samples a pixel; 0: 1 by raster, 4 by path replay, which has noise.
        """
        spp = spp or (1 if self.is_raster else 4)
        self.place(vertices)
        crop = crop or Crop(0, 0, *self.size)
        if self.is_raster:
            image = mask = self.renderer.image(self.scene, self.sensor, seed, spp)
        else:
            shown = partial(mi.render, self.scene, self._params, self.sensor)
            image = shown(self.renderer, spp=spp, seed=seed)
            mask = self._silhouette.image(self._alone, self.sensor, spp=1)
        return crop.cut(image, 0, 3), crop.cut(mask, 3, 4)


def _positions_key(params, mesh):
    """The key of the mesh's vertex positions among a scene's parameters. (Mitsuba names meshes by
    id, or by address where they have none.)
    """
    keys = [k for k in params.keys() if k.endswith("vertex_positions")]
    for key in keys:
        if len(keys) == 1 or key.split(".")[0] == mesh.id():
            return key
    raise InputError(
        f"template {mesh.id()!r}: not found among the scene's parameters; give its shape"
        ' id="template"'
    )
