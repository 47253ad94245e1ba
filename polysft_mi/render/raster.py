"""The ``raster`` integrator: primary visibility, attached shading, analytic antialiasing of
silhouettes.

One ray a pixel finds the visible triangle (detached). Its hit point, texture coordinates and colour
are then recomputed with gradients. Where two neighbouring pixels see different sheets, the
silhouette edge between their centres is found by walking over the mesh from the nearer one, and the
two colours are blended by where the edge crosses, which makes the image a continuous,
differentiable function of the vertices (after Laine et al. 2020, "Modular Primitives for
High-Performance Differentiable Rendering", section 3.5; here the edge need not belong to the
triangles seen at the two centres). ``docs/raster.md`` explains it.

Import only after a Mitsuba variant is set.
"""

import math
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.errors import InputError

from .pinhole import NEAR, Pinhole
from .topology import Topology

# pixels by which an edge through a centre may pass it: the ray and the projection round differently
_TOLERANCE = 1e-3
_MAX_STEPS = 64  # triangles crossed between two neighbouring pixel centres before the walk gives up
_AOVS = {"depth": 1, "normal": 3, "uv": 2, "triangle": 1}
_AOV_CHANNELS = {"depth": "Z", "normal": "XYZ", "uv": "UV", "triangle": "I"}


def _cross2(a, b):
    return a.x * b.y - a.y * b.x


@dataclass
class Seen:
    """What the pixels of a region see, detached but for ``positions`` and ``screen``; region pixels
    run row by row. Arrays alone, so that frozen functions take it.

    ``region``: (x0, y0, width, height), opaque UInt32; ``basis``, ``origin``: the camera as
    :meth:`Pinhole.device` gives it; ``positions`` Float64 of 3V [m], ``screen`` Point3d of V (x, y
    [pixels], depth [m]): the vertices; ``triangle`` (-1 for none) and ``depth`` [m] of each pixel.
    """

    region: tuple
    basis: mi.Matrix3f
    origin: mi.Point3f
    positions: mi.Float64
    screen: mi.Point3d
    triangle: mi.Int32
    depth: mi.Float

    @property
    def hit(self):
        return self.triangle >= 0

    def rays(self):
        """A ray through the centre of each pixel, and the length of its direction before it was
        normalised (depth = t / length).
        """
        return _rays(self.region, self.basis, self.origin, dr.width(self.triangle))


@dataclass
class View(Seen):
    """:class:`Seen`, and what it was found with: the region's ``size`` (width, height), ``ray`` and
    ``length`` as of :meth:`Seen.rays`, and Mitsuba's preliminary ``intersection``."""

    size: tuple
    ray: mi.Ray3f
    length: mi.Float
    intersection: mi.PreliminaryIntersection3f

    def seen(self):
        """The :class:`Seen` part alone."""
        return Seen(*(getattr(self, field.name) for field in fields(Seen)))


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

    def look(self, scene, sensor, scale=1, box=None):
        """Trace one ray a pixel: the :class:`View` of the scene at ``scale`` pixels a pixel and
        axis (a fraction for a coarser grid).

        ``box`` (x, y, x, y) [pixels]: what the surface covers, where the caller knows; else it is
        computed.
        """
        camera, topology = self._camera(sensor), self.topology(scene)
        width, height = int(camera.width * scale), int(camera.height * scale)
        basis, inverse, origin = camera.device(scale)

        positions = topology.positions()
        vertex = _gather_point(positions, dr.arange(mi.UInt32, topology.vertex_count))
        relative = inverse @ (vertex - origin)  # (x z, y z, z): pixels times depth
        screen = mi.Point3d(
            mi.Point3f(relative.x / relative.z, relative.y / relative.z, relative.z)
        )
        dr.eval(screen)
        x0, y0, w, h = (
            self._bounds(screen, width, height)
            if box is None
            else _margin([scale * x for x in box], width, height)
        )

        with dr.suspend_grad():
            region = tuple(dr.opaque(mi.UInt32, k) for k in (x0, y0, w, h))
            ray, length = _rays(region, basis, origin, w * h)
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
        view = self.look(scene, sensor, scale)
        topology, hit = self._topology, view.hit
        si, z = self._interaction(
            topology,
            view.positions,
            view.intersection.shape,
            view.triangle,
            view.ray,
            view.length,
            hit,
        )
        colour = (
            self._unlit(si, hit)
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
        if not near > NEAR or not all(map(math.isfinite, (xa, ya, xb, yb))):
            return 0, 0, width, height
        return _margin((xa, ya, xb, yb), width, height)

    def _interaction(self, topology, positions, shape, triangle, ray, length, hit):
        """Surface interaction of rays with the planes of their triangles (attached), and depth
        along the axis.
        """
        t = mi.UInt32(dr.select(hit, triangle, 0))
        index = [dr.gather(mi.UInt32, topology.faces, 3 * t + k, hit) for k in range(3)]
        p0, p1, p2 = (_gather_point(positions, i, hit) for i in index)
        e1, e2 = p1 - p0, p2 - p0
        # Moeller-Trumbore, without its tests: the ray is known to hit
        pv = dr.cross(ray.d, e2)
        inverse = dr.select(hit, dr.rcp(dr.dot(e1, pv)), 0)
        tv = ray.o - p0
        qv = dr.cross(tv, e1)
        b1, b2 = dr.dot(tv, pv) * inverse, dr.dot(ray.d, qv) * inverse
        distance = dr.dot(e2, qv) * inverse
        texcoords = topology.texcoords()
        c0, c1, c2 = (dr.gather(mi.Point2f, texcoords, i, hit) for i in index)

        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(triangle))
        si.t = dr.select(hit, distance, dr.inf)
        si.p = ray.o + ray.d * distance
        si.uv = c0 + (c1 - c0) * b1 + (c2 - c0) * b2
        n = dr.normalize(dr.cross(e1, e2))
        si.n = dr.mulsign(n, -dr.dot(n, ray.d))  # both sides face the camera
        si.sh_frame.n = si.n
        si.wi = mi.Vector3f(0, 0, 1)  # unlit: as seen from the front
        si.shape = shape
        return si, distance / length

    @staticmethod
    def _unlit(si, hit):
        """The texture's own colour, from either side: 3 Floats, 0 where there is no surface."""
        return [
            dr.select(hit, c, 0) for c in mi.Color3f(si.bsdf().eval_diffuse_reflectance(si, hit))
        ]

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
        """The silhouette edges that run between neighbouring pixel centres of a :class:`View`:
        detached (va, vb, near, far, horizontal), None where there are none. With ``outline`` only
        those of which one centre sees no sheet at all.

        Vertices of each edge, the region's pixel whose sheet ends there, the other pixel, and
        whether the two lie side by side.
        """
        topology, (x0, y0, w_, _), (w, h) = self._topology, view.region, view.size
        horizontal_count, count = (w - 1) * h, (w - 1) * h + w * (h - 1)
        if count == 0:
            return None
        with dr.suspend_grad():
            split, columns = dr.opaque(mi.UInt32, horizontal_count), w_ - 1

            def pixels(k):
                """The pair's pixels, and whether it is horizontal."""
                horizontal = k < split
                y = dr.select(horizontal, k // dr.maximum(columns, 1), 0)
                a = dr.select(horizontal, y * w_ + (k - y * columns), k - split)
                return a, a + dr.select(horizontal, 1, w_), horizontal

            a, b, _ = pixels(dr.arange(mi.UInt32, count))
            ta, tb = (dr.gather(mi.Int32, view.triangle, k) for k in (a, b))
            pair = dr.compress((ta < 0) != (tb < 0) if outline else ta != tb)
            if dr.width(pair) == 0:
                return None
            a, b, horizontal = pixels(pair)
            swap = dr.gather(mi.Float, view.depth, b) < dr.gather(mi.Float, view.depth, a)
            near, far = dr.select(swap, b, a), dr.select(swap, a, b)
            found, va, vb, near, far = self._silhouette(
                topology, view.screen, view.triangle, near, far, x0, y0, w_, horizontal
            )
            dr.eval(
                found, va, vb, near, far, horizontal
            )  # in one kernel: compress and gather would each walk again
            kept = dr.compress(found)
            if dr.width(kept) == 0:
                return None
            va, vb, near, far = (dr.gather(mi.UInt32, i, kept) for i in (va, vb, near, far))
            return va, vb, near, far, dr.gather(mi.Bool, horizontal, kept)

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
            si, _ = self._interaction(
                topology,
                view.positions,
                dr.reinterpret_array(mi.ShapePtr, shape),
                visible,
                ray,
                length,
                visible >= 0,
            )
            incoming = mi.Vector4d(*self._unlit(si, visible >= 0), incoming.w)
        difference = incoming - dr.gather(mi.Vector4d, rgba, target, mode=dr.ReduceMode.Local)
        out = rgba + 0
        dr.scatter_add(out, weight * difference, target, mode=dr.ReduceMode.Local)
        return out

    def _silhouette(self, topology, screen, triangle, near, far, x0, y0, w, horizontal):
        """Vertices (va, vb) of the silhouette edge between the centres of two pixels, and which
        pixel it occludes.

        Walks from the near pixel's triangle towards the far centre; where that sheet has no
        silhouette in between, from the far one's.
        """
        found, va, vb, last = self._walk(
            topology, screen, triangle, near, far, x0, y0, w, mi.Bool(True)
        )
        beyond = dr.gather(mi.Int32, triangle, far)
        again = ~found & (beyond >= 0) & (last != beyond)  # else the two centres lie on one sheet
        found2, va2, vb2, _ = self._walk(topology, screen, triangle, far, near, x0, y0, w, again)
        near, far = dr.select(found2, far, near), dr.select(found2, near, far)
        va, vb, found = dr.select(found2, va2, va), dr.select(found2, vb2, vb), found | found2
        edge = point2(screen, vb, found) - point2(screen, va, found)
        return found & (dr.select(horizontal, edge.y, edge.x) != 0), va, vb, near, far

    def _walk(self, topology, screen, triangle, start, end, x0, y0, w, active):
        """From the triangle seen at pixel ``start`` over the sheet towards the centre of ``end``:
        whether a silhouette edge comes before that centre, its vertices, and the last triangle
        reached."""
        c0, c1 = _centre(start, x0, y0, w), _centre(end, x0, y0, w)

        def corners(t, mask):
            return [
                dr.gather(mi.UInt32, topology.faces, 3 * mi.UInt32(t) + k, mask) for k in range(3)
            ]

        def area(points):
            return _cross2(points[1] - points[0], points[2] - points[0])

        flat = mi.Float(dr.ravel(dr.detach(screen)))
        dr.eval(flat)

        def step(active, current, found, va, vb, steps):
            index = corners(current, active)
            p = [dr.gather(mi.Point3f, flat, i, active) for i in index]
            q = [mi.Point2f(x.x, x.y) for x in p]
            sign = dr.sign(area(q))
            # the segment leaves a convex triangle by the first edge behind which it gets
            exit_at, exit_edge = mi.Float(dr.inf), mi.UInt32(0)
            for k in range(3):
                edge = q[(k + 1) % 3] - q[k]
                at0, at1 = sign * _cross2(edge, c0 - q[k]), sign * _cross2(edge, c1 - q[k])
                t = at0 / (at0 - at1)
                first = (at1 < at0) & (t < exit_at)
                exit_at, exit_edge = dr.select(first, t, exit_at), dr.select(first, k, exit_edge)
            usable = (dr.minimum(dr.minimum(p[0].z, p[1].z), p[2].z) > NEAR) & (sign != 0)
            leaves = active & usable & (exit_at < 1 + _TOLERANCE)
            across = dr.gather(
                mi.Int32, topology.neighbours, 3 * mi.UInt32(current) + exit_edge, leaves
            )
            inner = leaves & (across >= 0)
            r = [dr.gather(mi.Point3f, flat, i, inner) for i in corners(across, inner)]
            silhouette = leaves & ((across < 0) | (area(r) * sign <= 0))
            ea = dr.select(exit_edge == 0, index[0], dr.select(exit_edge == 1, index[1], index[2]))
            eb = dr.select(exit_edge == 0, index[1], dr.select(exit_edge == 1, index[2], index[0]))
            va, vb = dr.select(silhouette, ea, va), dr.select(silhouette, eb, vb)
            steps += 1
            going = leaves & ~silhouette & (steps < _MAX_STEPS)
            return going, dr.select(going, across, current), found | silhouette, va, vb, steps

        current = dr.gather(mi.Int32, triangle, start, active)
        n = dr.width(current)
        state = (
            active & (current >= 0) & dr.full(mi.Bool, True, n),
            current,
            dr.full(mi.Bool, False, n),
            dr.zeros(mi.UInt32, n),
            dr.zeros(mi.UInt32, n),
            dr.zeros(mi.UInt32, n),
        )
        _, last, found, va, vb, _ = dr.while_loop(
            state, lambda active, *_: active, step, label="walk"
        )
        return found, va, vb, last

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


def _rays(region, basis, origin, count):
    """:meth:`Seen.rays` of a region of ``count`` pixels."""
    centre = _centre(dr.arange(mi.UInt32, count), *region[:3])
    direction = basis @ mi.Vector3f(centre.x, centre.y, 1)
    length = dr.norm(direction)
    return mi.Ray3f(origin, direction / length), length


def _centre(pixel, x0, y0, w):
    y = pixel // w
    return mi.Point2f(mi.Float(pixel - y * w + x0) + 0.5, mi.Float(y + y0) + 0.5)


def blend(seen, ea, eb, near, far, horizontal):
    """How an edge between two pixel centres blends them: (pixel that changes, pixel whose colour
    comes in, its weight, where the edge crosses).

    ``ea``, ``eb``: the edge's ends [pixels], attached; the weight and the place are.
    """
    x0, y0, w_, _ = seen.region
    cn, cf = (_centre(i, x0, y0, w_) for i in (near, far))
    # where the edge crosses, from the near centre (0) to the far one (1)
    step = eb - ea
    along, across = dr.select(horizontal, step.x, step.y), dr.select(horizontal, step.y, step.x)
    slope = along / across
    crossing = dr.select(horizontal, ea.x + (cn.y - ea.y) * slope, ea.y + (cn.x - ea.x) * slope)
    start, end = dr.select(horizontal, cn.x, cn.y), dr.select(horizontal, cf.x, cf.y)
    t = (crossing - start) / (end - start)
    place = mi.Point2f(dr.select(horizontal, crossing, cn.x), dr.select(horizontal, cn.y, crossing))
    # the near sheet covers a part of the far pixel, or the far one a part of the near
    beyond = dr.detach(t) > 0.5
    # The pairs across either axis would account for the whole edge; sin^2 and cos^2 of its angle
    # share it between them.
    weight = dr.clip(dr.abs(t - 0.5), 0, 0.5) * across * across / (along * along + across * across)
    return dr.select(beyond, far, near), dr.select(beyond, near, far), weight, place


def _margin(box, width, height):
    """(x, y, width, height) of the pixels around a box (x, y, x, y) within the image, with a margin
    for the neighbours that antialiasing blends with.
    """
    xa, ya, xb, yb = box
    xa, ya = max(0, math.floor(min(xa, width)) - 1), max(0, math.floor(min(ya, height)) - 1)
    xb, yb = min(width, math.ceil(max(xb, 0)) + 1), min(height, math.ceil(max(yb, 0)) + 1)
    return (xa, ya, xb - xa, yb - ya) if xb > xa and yb > ya else (0, 0, 1, 1)


def _gather_point(positions, index, mask=True):
    """Points of a flat Float64 array, attached to it."""
    return mi.Point3f(dr.gather(mi.Point3d, positions, index, mask))


def point2(screen, index, mask=True):
    """Screen positions of the vertices ``index``, attached to ``screen``."""
    return mi.Point2f(
        *(mi.Float(dr.gather(mi.Float64, x, index, mask)) for x in (screen.x, screen.y))
    )
