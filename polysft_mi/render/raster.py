"""The ``raster`` integrator: primary visibility, attached shading, analytic antialiasing of
silhouettes.

One ray a pixel finds the visible triangle (detached). Its hit point, texture coordinates and colour
are then recomputed with gradients. At silhouettes the colours of two neighbouring pixels are
blended by where the edge crosses (:mod:`polysft_mi.render.silhouette`), which makes the image a
continuous, differentiable function of the vertices. ``docs/raster.md`` explains it.

Import only after a Mitsuba variant is set.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.errors import InputError

from .pinhole import MIN_DEPTH, Pinhole
from .shading import interaction, unlit
from .silhouette import blend, crossings
from .topology import Topology
from .view import View, gather_point, margin, point2, rays

_AOVS = {"depth": 1, "normal": 3, "uv": 2, "triangle": 1}
_AOV_CHANNELS = {"depth": "Z", "normal": "XYZ", "uv": "UV", "triangle": "I"}


class RasterIntegrator(mi.SamplingIntegrator):
    """

    .. pluginparameters::

     * - shading
       - |string|
       - ``unlit``: the diffuse reflectance itself, from both sides. ``bsdf``: the BSDF under the
         scene's emitters at the first hit, by ``shading_samples`` samples of the emitters, with
         shadows; the environment shows behind the surface. (Default: ``unlit``)
     * - shading_samples
       - |int|
       - Emitter samples of each image sample where ``shading`` is ``bsdf``. (Default: 1)
     * - hide_emitters
       - |bool|
       - Black instead of the environment behind the surface, where ``shading`` is ``bsdf``.
         (Default: false)
     * - antialias
       - |bool|
       - Blend the colours across silhouettes. Without it silhouettes carry no gradient. (Default:
         true)
     * - aovs
       - |string|
       - Comma-separated channels behind colour and alpha: ``depth`` (z along the optical axis [m]),
         ``normal`` (unit, world frame, towards the camera), ``uv`` (texture coordinates),
         ``triangle`` (index over all meshes in the scene's order, -1 for none). They are not
         antialiased. (Default: none)

    What it is for: fitting a surface to an image and its silhouette together, from one noise-free
    render. RGB is over black (premultiplied by alpha) where ``shading`` is ``unlit``. ``spp`` takes
    square numbers: 4 is a grid of 2x2 samples a pixel, each pixel their mean. The film's
    reconstruction filter is not used: a pixel is its own square.

    It is used like any integrator: ``mi.render(scene, params, integrator=...)``, in forward and
    reverse mode. Called directly under Dr.Jit's AD, ``render()`` returns an attached image in one
    pass.
    """

    def __init__(self, props):
        super().__init__(props)
        self.shading = props.get("shading", "unlit")
        self.shading_samples = props.get("shading_samples", 1)
        self.antialias = props.get("antialias", True)
        self.aovs = [name.strip() for name in props.get("aovs", "").split(",") if name.strip()]
        if self.shading not in ("unlit", "bsdf"):
            raise InputError(f"raster: shading = {self.shading!r}; known: unlit, bsdf")
        if self.shading_samples < 1:
            raise InputError(
                f"raster: shading_samples = {self.shading_samples}; it must be at least 1"
            )
        for name in self.aovs:
            if name not in _AOVS:
                raise InputError(f"raster: aov {name!r}; known: {', '.join(_AOVS)}")
        self._topology = None
        self._camera_of = self._pinhole = None

    def aov_names(self):
        return [f"{name}.{channel}" for name in self.aovs for channel in _AOV_CHANNELS[name]]

    def to_string(self):
        return (
            f"RasterIntegrator[shading = {self.shading}, antialias = {self.antialias}, aovs ="
            f" {self.aovs}]"
        )

    # -- Mitsuba's interface ------------------------------------------------

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Image tensor (H, W, C) of the crop window, attached to whatever the scene is attached
        to.
        """
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        image = self.image(scene, sensor, int(seed) if not dr.is_array_v(seed) else seed, spp)
        film = sensor.film()
        if not dr.grad_enabled(
            image
        ):  # let the film have it too, for whoever develops or writes that
            film.prepare(self.aov_names())
            film.put_block(self._block(film, image))
            if evaluate:
                dr.eval(image)
        return image if develop else mi.TensorXf()

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        image = self.render(scene, sensor, seed, spp)
        dr.forward_to(image)
        return dr.grad(image)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        image = self.render(scene, sensor, seed, spp)
        dr.backward_from(dr.dot(image.array, dr.detach(grad_in.array)))

    def _block(self, film, image):
        """The image as the film expects it: colour, alpha, weight, AOVs."""
        height, width, channels = image.shape
        data, n, k = image.array, width * height, len(self.aov_names())
        base = channels - k
        pixel = dr.arange(mi.UInt32, n)
        film_channels = film.prepare(self.aov_names())
        has_weight = film_channels - channels
        out = dr.zeros(mi.Float, n * film_channels)
        for c in range(film_channels):
            if c < base:
                value = dr.gather(mi.Float, data, pixel * channels + c)
            elif has_weight and c == base:
                value = mi.Float(1)
            else:
                value = dr.gather(mi.Float, data, pixel * channels + (c - has_weight))
            dr.scatter(out, value, pixel * film_channels + c)
        block = mi.TensorXf(out, (height, width, film_channels))
        return mi.ImageBlock(block, film.crop_offset(), border=False)

    # -- the image ----------------------------------------------------------

    def _camera(self, sensor):
        """The sensor as a linear map, made anew when the sensor, its pose, its lens or its crop
        window has changed.
        """
        film = sensor.film()
        pose = [sensor.world_transform()] + (
            [sensor.projection_transform()] if hasattr(sensor, "projection_transform") else []
        )
        with dr.suspend_grad():
            key = (
                id(sensor),
                tuple(film.crop_size()),
                tuple(film.crop_offset()),
                *(np.array(t.matrix).tobytes() for t in pose),
            )
        if self._camera_of != key:
            self._camera_of, self._pinhole = key, Pinhole(sensor)
        return self._pinhole

    def topology(self, scene):
        """The :class:`Topology` of the scene, made anew where its meshes are others."""
        if self._topology is None or not self._topology.fits(scene):
            self._topology = Topology(scene)
        return self._topology

    def view(self, scene, sensor, scale=1, box=None):
        """Trace one ray a pixel: the :class:`View` of the scene at ``scale`` pixels a pixel and
        axis (a fraction for a coarser grid).

        ``box`` (x, y, x, y) [pixels]: what the surface covers, where the caller knows; else it is
        computed.
        """
        camera, topology = self._camera(sensor), self.topology(scene)
        width, height = int(camera.width * scale), int(camera.height * scale)
        basis, inverse, origin = camera.device(scale)

        positions = topology.positions()
        vertex = gather_point(positions, dr.arange(mi.UInt32, topology.vertex_count))
        relative = inverse @ (vertex - origin)  # (x z, y z, z): pixels times depth
        screen = mi.Point3d(
            mi.Point3f(relative.x / relative.z, relative.y / relative.z, relative.z)
        )
        dr.eval(screen)
        x0, y0, w, h = (
            self._bounds(screen, width, height)
            if box is None
            else margin([scale * x for x in box], width, height)
        )

        with dr.suspend_grad():
            region = tuple(dr.opaque(mi.UInt32, k) for k in (x0, y0, w, h))
            ray, length = rays(region, basis, origin, w * h)
            pi = scene.ray_intersect_preliminary(ray, coherent=True)
            hit = pi.is_valid()
            shape = dr.reinterpret_array(mi.UInt32, pi.shape)
            triangle = dr.select(
                hit,
                mi.Int32(dr.gather(mi.UInt32, topology.face_offset, shape, hit) + pi.prim_index),
                -1,
            )
            depth = dr.select(hit, pi.t / length, dr.inf)
            dr.eval(
                pi, triangle, depth
            )  # once: everything below reads it, and the scene may change before it is evaluated
        return View(
            region, basis, origin, positions, screen, triangle, depth, (w, h), ray, length, pi
        )

    def image(self, scene, sensor, seed=0, spp=0):
        """What :meth:`render` returns, without a copy of it in the sensor's film."""
        spp = spp or sensor.sampler().sample_count()
        scale = math.isqrt(spp)
        if scale * scale != spp:
            raise InputError(f"raster: spp = {spp}; a square number is needed (1, 4, 9, 16, ...)")
        view = self.view(scene, sensor, scale)
        topology, hit = self._topology, view.hit
        ray = view.triangle, view.ray, view.length, hit
        si, z = interaction(topology, view.positions, view.intersection.shape, *ray)
        colour = (
            unlit(si, hit)
            if self.shading == "unlit"
            else self._lit(scene, view.intersection, view.ray, hit, seed)
        )
        # red, green, blue and alpha packed; in double for the gradients, as positions are
        rgba = dr.ravel(mi.Vector4d(*colour, dr.select(hit, mi.Float(1), 0)))
        if self.antialias:
            rgba = self._antialias(topology, view, rgba)
        aovs = [
            channel
            for name in self.aovs
            for channel in self._aov(name, si, z, view.triangle, view.ray, hit)
        ]
        alpha = mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha)
        return self._assemble(rgba, aovs, view, self._camera(sensor), scale, alpha)

    def _bounds(self, screen, width, height):
        """Pixels that the surface can cover: (x, y, width, height), at least one pixel."""
        if self.shading != "unlit" and not self.hide_emitters:
            return 0, 0, width, height  # the environment is seen everywhere
        with dr.suspend_grad():
            box = [
                dr.min(screen.x),
                dr.min(screen.y),
                dr.max(screen.x),
                dr.max(screen.y),
                dr.min(screen.z),
            ]
            dr.eval(box)
            xa, ya, xb, yb, near = (x[0] for x in box)
        if not near > MIN_DEPTH or not all(map(math.isfinite, (xa, ya, xb, yb))):
            return 0, 0, width, height
        return margin((xa, ya, xb, yb), width, height)

    def _lit(self, scene, pi, ray, hit, seed):
        """Emitted and directly reflected radiance at the first hit; the environment where there is
        none.
        """
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, hit)
        bsdf = si.bsdf()
        seen = hit if self.hide_emitters else mi.Bool(True)
        colour = si.emitter(scene).eval(si, seen) & seen
        emitters = len(scene.emitters())
        if emitters:
            n = self.shading_samples
            rng = mi.PCG32(size=dr.width(hit), initstate=seed + 1)
            context = mi.BSDFContext()
            for _ in range(n):
                sample = mi.Point2f(rng.next_float32(), rng.next_float32())
                ds, weight = scene.sample_emitter_direction(si, sample, True, hit)
                colour += (
                    bsdf.eval(context, si, si.to_local(ds.d), hit & (ds.pdf != 0)) * weight / n
                )
        return list(mi.Color3f(colour))

    def _aov(self, name, si, z, triangle, ray, hit):
        if name == "depth":
            return [dr.select(hit, z, 0)]
        if name == "normal":
            return [dr.select(hit, x, 0) for x in si.n]
        if name == "uv":
            return [dr.select(hit, x, 0) for x in si.uv]
        return [mi.Float(triangle)]

    def crossings(self, view, outline=False):
        """:func:`polysft_mi.render.silhouette.crossings` of a view of the scene seen last."""
        return crossings(self._topology, view, outline)

    def _antialias(self, topology, view, rgba):
        """Blend the colours (packed, 4 w h) across the silhouettes that run between neighbouring
        pixel centres.
        """
        pairs = self.crossings(view)
        if pairs is None:
            return rgba
        va, vb, near, far, horizontal = pairs
        ea, eb = point2(view.screen, va), point2(view.screen, vb)
        target, other, weight, place = blend(view, ea, eb, near, far, horizontal)

        # The colour that comes in is the other sheet's where the edge crosses, not at the other
        # pixel's centre: so the image stays continuous when a pixel's centre passes from one sheet
        # to the other. (Local reduction, because the default would bake the size of the region into
        # the kernels.)
        incoming = dr.gather(mi.Vector4d, rgba, other, mode=dr.ReduceMode.Local)
        if self.shading == "unlit":
            direction = view.basis @ mi.Vector3f(place.x, place.y, 1)
            length = dr.norm(direction)
            shape = dr.gather(
                mi.UInt32, dr.reinterpret_array(mi.UInt32, view.intersection.shape), other
            )
            visible = dr.gather(mi.Int32, view.triangle, other)
            ray = mi.Ray3f(view.origin, direction / length)
            shape = dr.reinterpret_array(mi.ShapePtr, shape)
            ray = visible, ray, length, visible >= 0
            si, _ = interaction(topology, view.positions, shape, *ray)
            incoming = mi.Vector4d(*unlit(si, visible >= 0), incoming.w)
        difference = incoming - dr.gather(mi.Vector4d, rgba, target, mode=dr.ReduceMode.Local)
        out = rgba + 0
        dr.scatter_add(out, weight * difference, target, mode=dr.ReduceMode.Local)
        return out

    def _assemble(self, rgba, aovs, view, camera, scale, alpha):
        """Put the region into the full image and shape it (H, W, C): colours averaged over the
        samples of a pixel, AOVs of its middle one.
        """
        (x0, y0, w_, _), (w, h) = view.region, view.size
        width, height = camera.width, camera.height
        colours = 4 if alpha else 3
        count = colours + len(aovs)
        index = dr.arange(mi.UInt32, w * h)
        y = index // w_
        sx, sy = index - y * w_ + x0, y + y0
        px, py = sx // scale, sy // scale
        pixel = py * dr.opaque(mi.UInt32, width) + px
        out = dr.zeros(mi.Float, width * height * count)
        value = mi.Vector4f(dr.gather(mi.Vector4d, rgba, index, mode=dr.ReduceMode.Local))
        value = value if alpha else mi.Vector3f(value.x, value.y, value.z)
        place = (
            [(value, pixel)]
            if not aovs
            else [(value[c], pixel * count + c) for c in range(colours)]
        )
        for part, at in place:
            if scale > 1:
                dr.scatter_add(out, part / (scale * scale), at, mode=dr.ReduceMode.Local)
            else:
                dr.scatter(out, part, at)
        if "triangle" in self.aovs:  # no triangle is -1, outside the region too
            dr.scatter(
                out,
                mi.Float(-1),
                dr.arange(mi.UInt32, width * height) * count
                + colours
                + self.aov_names().index("triangle.I"),
            )
        middle = (sx - px * scale == scale // 2) & (sy - py * scale == scale // 2)
        for c, part in enumerate(aovs):
            dr.scatter(out, part, pixel * count + colours + c, middle)
        return mi.TensorXf(out, (height, width, count))
