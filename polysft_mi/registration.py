"""The images' part of the objective to second order: how well a surface explains a frame, and how that changes with each vertex.

Visibility comes from Mitsuba (one ray a pixel, :meth:`RasterIntegrator.look`), the texture from the template's BSDF, blurred like the
frame; residuals and their derivatives are closed forms, summed on the device per triangle. Import only after a Mitsuba variant is set.
"""

import math
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from .light import Brightness
from .problem import BadFrame
from .pyramid import FARTHEST, POOL, blur, compared, level_image

_TEXELS = 1.5  # texels of the baked texture to a pixel of the first frame
_PIXEL_BLUR = 0.29  # standard deviation of a pixel's own square [pixels]
_CORNERS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_SUMS = 18 + 9 + 4  # of second derivatives, of first ones and of figures, a triangle
_SILHOUETTE = 0.1  # of k_silhouette: robust, normalised residuals are smaller than colours, and masks are ragged
_MISFIT = 0.5  # residual, in local standard deviations, that counts half a misfit
_CACHED_FRAMES = 4
_TAPS = 2  # across a pixel's footprint on the texture, and along it
_FREE = 2.0  # windows from the border beyond which the background has no say in a frame's local statistics
_LONGEST = 12.0  # footprint of a pixel beyond which it is cut [pixels of the first frame]
SHADE = "shade"  # a frame as shading is read from it, beside its levels


@dataclass
class Evaluation:
    """A frame's images against a surface. Energies are weighted like the objective; a pixel is one of the level's grid.

    ``photometric``, ``silhouette``: energies; ``gradient`` (N, 3) of both [1/m]; ``second`` (F, 9, 2, 2): the photometric term's
    Gauss-Newton blocks of each triangle's corner pairs (row by row) with respect to the corners' projections [1/pixel^2]; ``rows``: the
    silhouette's residuals as (i, j, ci, cj, h), each with derivative ci (K, 2) and cj by the projections of the vertices i and j and
    curvature h (K,); ``pixels``: how many were compared; ``outlying``: the mean of r^2 / (r^2 + scale^2) over them, and ``misfit`` with a
    fixed scale; both 1 where no pixel is compared; ``seen`` (F,): pixels of the video that see each triangle and are compared.
    """

    photometric: float
    silhouette: float
    outlying: float
    misfit: float
    gradient: np.ndarray
    second: np.ndarray
    rows: tuple
    pixels: float
    seen: np.ndarray


@dataclass
class Appearance:
    """What the camera's blur makes of a sheet in one frame, at one surface and level, and its texture on the template, blurred there, does not.

    ``excess``: the texture's colours less those of the sheet's image, packed Float of 4 channels on a part of the level's grid of
    ``shape`` (h, w) from its pixel ``corner`` (x, y) on; ``luminance`` (F,): of the triangles' texture as the image shows it, as
    :attr:`polysft_mi.light.Shade.texture`, or None."""

    excess: object
    shape: tuple
    corner: tuple
    luminance: np.ndarray = None


def _packed(colour, fourth):
    """(h, w, 3) and (h, w) as one Float of 4 channels on the device."""
    return mi.Float(np.ascontiguousarray(np.concatenate([colour, fourth[..., None]], -1), np.float32).ravel())


class Registration:
    """Frames of a :class:`polysft_mi.problem.Problem` against its template's texture, level by level."""

    def __init__(self, problem):
        self.problem = problem
        experiment = problem.experiment
        self.scene, self.sensor, self.camera = experiment.scene, experiment.sensor, problem.camera
        from .raster import RasterIntegrator

        self.raster = experiment.renderer if isinstance(experiment.renderer, RasterIntegrator) else mi.load_dict({"type": "raster"})
        mesh = experiment.mesh
        faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        self.corner = experiment.corner
        self.faces = self.corner[faces]  # the template's vertices at the corners of the rendered triangles, (F, 3)
        self._texcoord = mi.Float(np.array(mesh.vertex_texcoords_buffer()))
        self._rendered = faces  # by the rendered vertices, which texture coordinates are of
        self._bake(mesh, faces)
        self._textures, self._frames, self._last = {}, OrderedDict(), None
        self._reader = ThreadPoolExecutor(1)
        sequence = problem.sequence
        self._decoded = lru_cache(2)(lambda frame: (sequence.frame(frame), sequence.mask(frame)))  # all levels are made of one decoding
        self._brightness = None
        self.normalise = problem.settings.lighting == "local"

    # -- images -------------------------------------------------------------

    def _bake(self, mesh, faces):
        """The reflectance over the box of the template's texture coordinates, as an image of a few texels a pixel, with a margin."""
        coordinates = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
        low, size = coordinates.min(0), np.maximum(np.ptp(coordinates, axis=0), 1e-9)
        position, _ = self.camera.project(self.problem.template.vertices[self.corner])

        def lengths(x):  # of the edges along each axis of the texture, so that both get their own density
            a, b = x[faces], x[np.roll(faces, -1, axis=1)]
            return a - b

        d = np.abs(lengths((coordinates - low) / size)).reshape(-1, 2)
        span = np.linalg.norm(lengths(position), axis=-1).ravel()
        straight = [d[:, k] > 4 * d[:, 1 - k] for k in (0, 1)]
        pixels = [np.median(span[m] / d[m, k]) if m.any() else np.median(span / np.linalg.norm(d, axis=1)) for k, m in enumerate(straight)]
        shape = [int(np.clip(round(_TEXELS * p), 8, 4096)) for p in pixels]
        margin = 12
        at = [low[k] + size[k] * (np.arange(-margin, shape[k] + margin) + 0.5) / shape[k] for k in (0, 1)]
        total, fine = 0, 2
        for dx in (np.arange(fine) + 0.5) / fine - 0.5:
            for dy in (np.arange(fine) + 0.5) / fine - 0.5:
                x, y = np.meshgrid(at[0] + dx * size[0] / shape[0], at[1] + dy * size[1] / shape[1])
                si = dr.zeros(mi.SurfaceInteraction3f, x.size)
                si.uv, si.wi = mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32)), mi.Vector3f(0, 0, 1)
                total = total + np.array(mesh.bsdf().eval_diffuse_reflectance(si)).T
        self.texture = (total / fine**2).reshape(len(at[1]), len(at[0]), 3).astype(np.float32)
        x, y = np.meshgrid(*at)
        self.texture_inside = ((x >= low[0]) & (x <= low[0] + size[0]) & (y >= low[1]) & (y <= low[1] + size[1])).astype(np.float32)
        self._texel = [mi.Vector2f(*(float(shape[k] / size[k]) for k in (0, 1))), mi.Point2f(*(float(margin - 0.5 - low[k] * shape[k] / size[k]) for k in (0, 1)))]
        dr.make_opaque(self._texel)

    @property
    def brightness(self):
        """:class:`polysft_mi.light.Brightness` of the template and the video."""
        if self._brightness is None:
            texels = self._texels()[self._rendered].mean(1)
            vertices, masked = self.problem.template.vertices, bool(self.problem.experiment.masks)
            position, _ = self.camera.project(vertices)
            self._brightness = Brightness(self.faces, vertices, position, self.texture, self.texture_inside, texels, _TEXELS, masked)
        return self._brightness

    def shade(self, vertices, frame, seen, appearance=None):
        """The triangles' :class:`polysft_mi.light.Shade` in a frame; vertices (N, 3) [m, world], ``seen`` as in :class:`Evaluation`; the
        texture's luminance is that of the ``appearance``, where it has one.
        """
        if (frame, SHADE) not in self._frames:
            self.expect([frame], [SHADE])
        position, _ = self.camera.project(vertices)
        luminance = appearance.luminance if appearance else None
        return self.brightness.of(self._frames[frame, SHADE].result(), vertices, self.camera.origin, position, seen, luminance)

    def _texels(self):
        """Pixels of ``texture`` (OpenCV's, whole at their centres) of the rendered vertices, (V, 2)."""
        return np.array(self._texcoord, dtype=np.float64).reshape(-1, 2) * np.array(self._texel[0]).ravel() + np.array(self._texel[1]).ravel()

    def on_template(self, texels):
        """Points (K, 3) [m, world] of the undeformed template at pixels (K, 2) of ``texture`` (OpenCV's, whole at their centres); NaN
        beyond it.
        """
        from scipy.interpolate import LinearNDInterpolator  # a tenth of the start, and seldom needed

        return LinearNDInterpolator(self._texels(), self.problem.template.vertices[self.corner])(texels)

    def _texture_level(self, level):
        """The texture at a level: packed Float of 4 channels, width, height."""
        if level not in self._textures:
            sigma = _TEXELS * np.sqrt(level.sigma**2 + (_PIXEL_BLUR * level.stride) ** 2)
            weight = self.texture_inside if self.problem.experiment.masks else None
            image = compared(self.texture, weight, sigma, _TEXELS * level.window, self.normalise)
            trusted = np.ones_like(self.texture_inside)
            if weight is None and self.normalise:  # the background goes into a frame's local statistics near the border
                distance = cv2.distanceTransform(self.texture_inside.astype(np.uint8), cv2.DIST_L2, 3)
                trusted = (distance > min(_TEXELS * level.window, 0.5 * distance.max())).astype(np.float32)
            entry = _packed(image, trusted), image.shape[1], image.shape[0]
            dr.eval(entry[0])
            self._textures[level] = entry
        return self._textures[level]

    def _texture_fine(self, level):
        """The texture that taps are taken of at a level, as :meth:`_texture_level`."""
        key = "fine", level.stride
        if key not in self._textures:
            image = blur(self.texture, _TEXELS * _PIXEL_BLUR * level.stride / _TAPS, self.texture_inside if self.problem.experiment.masks else None)
            entry = _packed(image, np.zeros_like(self.texture_inside)), image.shape[1], image.shape[0]
            dr.eval(entry[0])
            self._textures[key] = entry
        return self._textures[key]

    def shift_texture(self, chart, displaced):
        """Move the texture on the template: what lies at ``chart`` (N, 2) is shown at ``displaced`` (N, 2) instead. Whether that could be
        done.
        """
        from scipy.interpolate import LinearNDInterpolator

        coordinates = np.array(self._texcoord, dtype=np.float64).reshape(-1, 2)
        shown = np.empty((len(chart), 2))
        shown[self.corner] = coordinates
        if np.abs(shown[self.corner] - coordinates).max() > 1e-6:
            return False  # a seam: texture coordinates are not a function of the chart
        inside = LinearNDInterpolator(displaced, shown)(chart)
        # beyond the border: by the nearest vertices' affine map
        missing = ~np.isfinite(inside).all(axis=1)
        if missing.any():
            _, near = cKDTree(displaced).query(chart[missing], k=12)
            for i, k in zip(np.flatnonzero(missing), near):
                rows = np.column_stack([np.ones(len(k)), displaced[k] - chart[i]])
                inside[i] = np.linalg.lstsq(rows, shown[k], rcond=None)[0][0]
        moved = inside[self.corner]
        self._texcoord, self._brightness = mi.Float(moved.astype(np.float32).ravel()), None
        self.problem.set_texcoords(self._texcoord)
        return True

    def expect(self, frames, levels):
        """Read and prepare frames in a second thread, for the levels given; SHADE is one."""
        brightness = self.brightness if SHADE in levels else None  # made here: the thread must not touch the device
        for frame in frames:
            for level in levels:
                key = (frame, level)
                if key not in self._frames:
                    self._frames[key] = self._reader.submit(self._read, frame, level, brightness)
        keep = _CACHED_FRAMES * max(1, len(levels))
        while len(self._frames) > keep:
            self._frames.popitem(last=False)

    def _read(self, frame, level, brightness):
        if level is SHADE:
            return brightness.prepared(*self._decoded(frame))
        return level_image(*self._decoded(frame), level, self.normalise)

    def _frame_level(self, frame, level):
        """The frame at a level, on the device: packed colour and weight; the mask or None; the :class:`LevelImage`; the mask's sum
        [pixels of the grid] and that of its squares.
        """
        key = (frame, level)
        if key not in self._frames:
            self.expect([frame], [level])
        entry = self._frames[key]
        if not isinstance(entry, tuple):
            image = entry.result()
            if not np.isfinite(image.colour).all():
                raise BadFrame(frame, math.nan)
            packed = _packed(image.colour, image.inside)
            mask = mi.Float(np.ascontiguousarray(image.mask).ravel()) if image.mask is not None else None
            sums = (max(1.0, float(image.mask.sum())), float((image.mask.astype(np.float64) ** 2).sum())) if image.mask is not None else (None, None)
            self._frames[key] = entry = packed, mask, image, *sums
        return entry

    # -- evaluation ---------------------------------------------------------

    def _look(self, vertices, level):
        """The :class:`polysft_mi.raster.View` of the sheet with vertices (N, 3) [m, world] on a level's grid; the last one is kept."""
        if self._last is None or self._last[0] != level.stride or not np.array_equal(self._last[1], vertices):
            self.problem.place(mi.Point3f(np.ascontiguousarray(vertices.T, dtype=np.float32)))
            view = self.raster.look(self.scene, self.sensor, 1 / level.stride, self._box(vertices))
            self._last = level.stride, vertices.copy(), view
        return self._last[2]

    def _box(self, vertices):
        """(x, y, x, y) [pixels of the video] around the projected vertices; None where one is not before the camera."""
        position, before = self.camera.project(vertices)
        return (*position.min(0), *position.max(0)) if before.all() else None

    def _surface(self, view):
        """What a ray meets, for all pixels of the region: (triangle, indices of its corners, (b1, b2), (p0, e1, e2), place on the baked
        texture [texels, whole at their centres], its derivatives by the other two corners).
        """
        hit, topology = view.hit, self.raster.topology(self.scene)
        triangle = mi.UInt32(dr.select(hit, view.triangle, 0))
        index = [dr.gather(mi.UInt32, topology.faces, 3 * triangle + k, hit) for k in range(3)]
        flat = mi.Float(view.positions)
        p0, p1, p2 = (dr.gather(mi.Point3f, flat, i, hit) for i in index)
        c0, c1, c2 = (dr.gather(mi.Point2f, self._texcoord, i, hit) for i in index)
        e1, e2, ray = p1 - p0, p2 - p0, view.ray
        pv = dr.cross(ray.d, e2)
        inverse = dr.select(hit, dr.rcp(dr.dot(e1, pv)), 0)
        tv = ray.o - p0
        b1 = dr.dot(tv, pv) * inverse
        b2 = dr.dot(ray.d, dr.cross(tv, e1)) * inverse
        at = (c0 + (c1 - c0) * b1 + (c2 - c0) * b2) * self._texel[0] + self._texel[1]
        return triangle, (b1, b2), (p0, e1, e2), at, (c1 - c0, c2 - c0)

    @staticmethod
    def _bilinear(texture, at, active):
        """A texture (packed Float of 4 channels, width, height) at a place [texels], and its derivatives by that [1/texel]."""
        texture, width, height = texture
        row = dr.opaque(mi.UInt32, width)
        x = dr.clip(at.x, 0, mi.Float(row) - 1.001)
        y = dr.clip(at.y, 0, mi.Float(dr.opaque(mi.UInt32, height)) - 1.001)
        ix, iy = mi.UInt32(x), mi.UInt32(y)
        fx, fy = x - mi.Float(ix), y - mi.Float(iy)
        first = iy * row + ix
        t00, t10, t01, t11 = (dr.gather(mi.Vector4f, texture, first + k, active) for k in (0, 1, row, row + 1))
        top, bottom = t00 + (t10 - t00) * fx, t01 + (t11 - t01) * fx
        return top + (bottom - top) * fy, (t10 - t00) * (1 - fy) + (t11 - t01) * fy, bottom - top

    @staticmethod
    def _plane(view, edges):
        """(grad1, grad2, slide): derivatives of the second and third barycentric coordinates by a point in the triangle's plane, and the
        normal over its product with the ray's direction: a plane that moves by m slides the ray's point on it by slide . m along the ray.
        """
        _, e1, e2 = edges
        n = dr.cross(e1, e2)
        inverse = dr.rcp(dr.squared_norm(n))
        return dr.cross(e2, n) * inverse, dr.cross(n, e1) * inverse, n * dr.rcp(dr.dot(n, view.ray.d))

    @staticmethod
    def _across(view):
        """What one pixel to the right and one down are at the depth of each ray's point [m]."""
        return [view.depth * mi.Vector3f(*(view.basis[k, axis] for k in range(3))) for axis in (0, 1)]

    def _pixels(self, view, frame, level, appearance=None):
        """Residuals (Vector4f, its fourth entry 0) and weights of the region's pixels, and what their derivatives need."""
        hit, packed, image = view.hit, *self._frame_level(frame, level)[:3:2]
        triangle, b, edges, at, along = self._surface(view)
        seen, by_x, by_y = self._bilinear(self._texture_level(level), at, hit)
        pixel, known = self._at(view, image.inside.shape, image.corner)
        target = dr.gather(mi.Vector4f, packed, pixel, hit & known)
        weight = dr.select(hit & (seen.w > 0.5), target.w, 0)
        if appearance:
            pixel, known = self._at(view, appearance.shape, appearance.corner)
            target += dr.gather(mi.Vector4f, appearance.excess, pixel, hit & known)
        seen.w, target.w = 0, 0
        residual = dr.select(weight > 0, seen - target, 0)
        return residual, weight, triangle, b, edges, along, (by_x * self._texel[0].x, by_y * self._texel[0].y)

    @staticmethod
    def _at(view, shape, corner):
        """Indices of the region's pixels in an array of ``shape`` (h, w) whose first pixel is ``corner`` (x, y) of the grid, and whether they
        lie there."""
        x0, y0, width, w, h = view.region
        local = dr.arange(mi.UInt32, w * h)
        ly = local // width
        (rows, columns), corner = (dr.opaque(mi.Int32, int(k)) for k in shape), (dr.opaque(mi.Int32, int(k)) for k in corner)
        x, y = (mi.Int32(a) - b for a, b in zip((local - ly * width + x0, ly + y0), corner))
        return mi.UInt32(y * columns + x), (x >= 0) & (x < columns) & (y >= 0) & (y < rows)

    def appearance(self, vertices, level, light=None, shaded=False):
        """The :class:`Appearance` of the sheet with vertices (N, 3) [m, world] at a level.

        A frame is blurred, and freed from lighting, in the image; the texture on the template, once for all. Where the sheet is seen at a
        slant, or hides a part of itself, these differ. So the sheet is rendered, under the ``light`` (7,) of :class:`polysft_mi.light.Light`
        where it is known, and made what the frame was made. ``shaded``: with the triangles' luminance.
        """
        lit = np.ones(len(self.faces)) if light is None else self.brightness.lit(vertices, self.camera.origin, light)
        lit = mi.Float(lit.astype(np.float32))
        with dr.suspend_grad():
            view = self._look(vertices, level)
            hit = view.hit
            triangle, _, edges, at, (c01, c02) = self._surface(view)
            seen, *_ = self._bilinear(self._texture_level(level), at, hit)
            grad1, grad2, slide = self._plane(view, edges)
            footprint = []
            for pixel in self._across(view):
                pixel -= view.ray.d * dr.dot(slide, pixel)
                step = (c01 * dr.dot(grad1, pixel) + c02 * dr.dot(grad2, pixel)) * self._texel[0]
                footprint.append(step * dr.minimum(1, _LONGEST * _TEXELS * level.stride * dr.rcp(dr.norm(step))))
            colour = mi.Vector4f(0)
            for i in range(_TAPS):
                for j in range(_TAPS):
                    a, b = ((k + 0.5) / _TAPS - 0.5 for k in (i, j))
                    colour += self._bilinear(self._texture_fine(level), at + a * footprint[0] + b * footprint[1], hit)[0]
            colour /= _TAPS**2
            colour.w = dr.select(hit, dr.gather(mi.Float, lit, triangle, hit), 0)
            colour = dr.select(hit, colour, 0)
            flat = dr.ravel(colour)
            dr.eval(flat, seen)
            x0, y0, _, w, h = view.region
            corner = int(x0[0]), int(y0[0])
            found = np.array(flat).reshape(h, w, 4)
            image, inside = self._as_frames_are(found[..., :3] * found[..., 3:], found[..., 3] > 0, corner, level)
            packed = _packed(image, np.zeros_like(inside))
            known = inside
            if not self.problem.experiment.masks:  # a frame's statistics near the border have the background in them
                padded = np.pad(inside.astype(np.uint8), 1)
                known = (cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1] > _FREE * level.window / level.stride).astype(np.float32)
            known = (mi.Float(known.ravel()) > 0) & (seen.w > 0.5)
            difference = dr.select(known, seen - dr.gather(mi.Vector4f, packed, dr.arange(mi.UInt32, w * h)), 0)
            excess = dr.ravel(difference)
            dr.eval(excess)
        luminance = None
        if shaded:
            position, _ = self.camera.project(vertices)
            luminance = self.brightness.shown(found[..., :3], inside, level.stride, position / level.stride - corner)
        return Appearance(excess, (h, w), corner, luminance)

    def _as_frames_are(self, colour, inside, corner, level):
        """An image (h, w, 3) of the sheet, ``inside`` (h, w) of it, made what frames are made at a level, on whose grid it begins at ``corner`` (x, y);
        and inside as float32."""
        margin = int(2 * level.window / level.stride) + 1  # of nothing, as around a mask
        pads = [(k - (k - margin) // POOL * POOL, -((-k - n - margin) // POOL) * POOL - k - n) for k, n in zip(corner[::-1], inside.shape)]
        inside = inside.astype(np.float32)
        wide = compared(np.pad(colour, (*pads, (0, 0))), np.pad(inside, pads), level.sigma / level.stride, level.window / level.stride, self.normalise)
        (top, _), (left, _) = pads
        return wide[top : top + inside.shape[0], left : left + inside.shape[1]], inside

    def residuals(self, vertices, frame, level):
        """Squared residuals r^2 = |T - I|^2 / 3 of the pixels that are compared, (P,) float32; vertices (N, 3) [m, world]."""
        with dr.suspend_grad():
            view = self._look(vertices, level)
            residual, weight, *_ = self._pixels(view, frame, level)
            squared = dr.squared_norm(residual) / 3
            dr.eval(squared, weight)
            return np.array(squared)[np.array(weight) > 0]

    def misfit(self, vertices, frame, level):
        """The mean of r^2 / (r^2 + c^2) over the pixels that are compared, 0 to 1, with a fixed c: 1 where there are none. vertices (N, 3)
        [m, world].
        """
        squared = self.residuals(vertices, frame, level)
        return float((squared / (squared + _MISFIT**2)).mean()) if len(squared) else 1.0

    def evaluate(self, vertices, frame, level, scale, appearance=None):
        """:class:`Evaluation` of the surface with vertices (N, 3) [m, world] against a frame, at a level, under the robust ``scale``; the
        frame has the ``appearance``'s excess.
        """
        s = self.problem.settings
        with dr.suspend_grad():
            view = self._look(vertices, level)
            residual, weight, triangle, (b1, b2), edges, (c01, c02), (by_x, by_y) = self._pixels(view, frame, level, appearance)
            squared = dr.squared_norm(residual) / 3
            c2 = dr.opaque(mi.Float, scale * scale)
            # the texture coordinate under a pixel moves against the triangle's plane, which slides along the ray
            grad1, grad2, slide = self._plane(view, edges)
            grad_x, grad_y = c01.x * grad1 + c02.x * grad2, c01.y * grad1 + c02.y * grad2
            robust = 2 * weight / (3 * (1 + squared / c2))
            first = mi.Vector3f(0)
            xx, xy, yy = mi.Float(0), mi.Float(0), mi.Float(0)
            right, down = self._across(view)
            for c in range(3):
                k = grad_x * by_x[c] + grad_y * by_y[c]
                g = slide * dr.dot(k, view.ray.d) - k
                first += residual[c] * g
                a, b = dr.dot(g, right), dr.dot(g, down)
                xx, xy, yy = xx + a * a, xy + a * b, yy + b * b
            first *= robust
            xx, xy, yy = (robust * x for x in (xx, xy, yy))
            figures = weight * c2 * dr.log(1 + squared / c2), weight, weight * squared / (squared + c2), weight * squared / (squared + _MISFIT**2)
            found = mi.Vector4f(xx, xy, yy, b1), mi.Vector4f(first.x, first.y, first.z, b2), mi.Vector4f(*figures)
            table = self._by_triangle(view.triangle, found)
            pairs = self._silhouette(view, frame, level) if s.k_silhouette > 0 else None
        *_, area, _ = self._frame_level(frame, level)
        energy, pixels, outlying, misfit = table[:, 27:31].sum(0).tolist()
        weight = s.k_rgb / (area or max(pixels, 1.0))
        blocks = table[:, :18].reshape(-1, 6, 3)
        second = blocks[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]][:, :, [0, 1, 1, 2]].reshape(-1, 9, 2, 2) * (weight / level.stride**2)
        gradient = np.zeros((len(self.problem.template.vertices), 3))
        for k in range(3):
            for axis in range(3):
                gradient[:, axis] += np.bincount(self.faces[:, k], table[:, 18 + 3 * k + axis] * weight, len(gradient))
        silhouette, rows = 0.0, None
        if pairs is not None:
            silhouette, rows, pull = self._pull(vertices, pairs, frame, level, _SILHOUETTE * s.k_silhouette / area)
            gradient += pull
        outlying, misfit = (outlying / pixels, misfit / pixels) if pixels else (1.0, 1.0)
        return Evaluation(weight * energy, silhouette, outlying, misfit, gradient, second, rows, pixels * level.stride**2, table[:, 28] * level.stride**2)

    def _by_triangle(self, triangle, found):
        """Sums over the pixels that see each triangle (F, 31) float64: 18 of curvature, 9 of slope and 4 figures.

        ``triangle``: of each pixel, -1 for none; ``found``: (xx, xy, yy, b1), (slope, b2) and the figures of each, where b1 and b2 are its
        barycentric coordinates. A thread a triangle adds its pixels up in their order: in a fraction of the time of atomic additions by
        the pixels, and always alike.
        """
        buffers = [dr.ravel(x) for x in found]
        seen, faces = np.array(triangle), len(self.faces)
        dr.eval(buffers)  # while pixels are sorted
        order = np.argsort((seen + 1).astype(np.uint16) if faces < 2**16 - 1 else seen, kind="stable")  # of 16 bits NumPy sorts by radix
        ends = np.cumsum(np.bincount(seen + 1, minlength=faces + 1))
        order, start, end = (mi.UInt32(x.astype(np.uint32)) for x in (order, ends[:-1], ends[1:]))

        def add(k, *sums):
            pixel = dr.gather(mi.UInt32, order, k)
            second, slope, figures = (dr.gather(mi.Vector4f, x, pixel) for x in buffers)
            corner = 1 - second.w - slope.w, second.w, slope.w
            new = [corner[a] * corner[b] * x for a, b in _CORNERS for x in (second.x, second.y, second.z)]
            new += [b * x for b in corner for x in (slope.x, slope.y, slope.z)] + list(figures)
            return k + 1, *(a + b for a, b in zip(sums, new))

        sums = dr.while_loop((start, *(dr.zeros(mi.Float, faces) for _ in range(_SUMS))), lambda k, *_: k < end, add, label="sums")[1:]
        table, at = dr.empty(mi.Float, faces * _SUMS), dr.arange(mi.UInt32, faces) * _SUMS
        for k, x in enumerate(sums):
            dr.scatter(table, x, at + k, mode=dr.ReduceMode.Permute)
        return np.array(table).reshape(faces, _SUMS).astype(np.float64)

    # -- silhouettes --------------------------------------------------------

    def _silhouette(self, view, frame, level):
        """The rendered silhouette against the mask: (energy without its weight, per pair of pixels: va, vb, derivative of the pixel's
        alpha by the edge's ends (K, 2) each, alpha less mask, distance to the mask's contour); None without masks."""
        _, mask, image, _, total = self._frame_level(frame, level)  # the total of the whole frame, less the region's, which alpha is subtracted from
        if mask is None:
            return None
        pixel, known = self._at(view, image.inside.shape, image.corner)
        alpha = dr.select(view.hit, mi.Float(1), 0)
        wanted = dr.gather(mi.Float, mask, pixel, known)
        crossings = self.raster.crossings(view, outline=True)  # where a sheet passes before the sheet itself, alpha does not change
        if crossings is None:
            error = dr.sum(dr.square(alpha - wanted) - dr.square(wanted))
            return total + float(error[0]), None
        va, vb, near, far, horizontal = crossings
        ea, eb = (mi.Point2f(*(mi.Float(dr.gather(mi.Float64, x, i)) for x in (view.screen.x, view.screen.y))) for i in (va, vb))
        with dr.resume_grad():
            dr.enable_grad(ea, eb)
            to, other, weight, _ = self.raster.blend(view, ea, eb, near, far, horizontal)
            dr.backward(weight)
            weight, da, db = dr.detach(weight), dr.grad(ea), dr.grad(eb)
        step = dr.gather(mi.Float, alpha, other) - dr.gather(mi.Float, alpha, to)
        alpha = mi.Float64(alpha)
        dr.scatter_add(alpha, mi.Float64(weight * step), to)
        alpha = mi.Float(alpha)
        error = dr.sum(dr.square(alpha - wanted) - dr.square(wanted))
        excess = dr.gather(mi.Float, alpha - wanted, to)
        at = dr.select(dr.gather(mi.Bool, known, to), mi.Int32(dr.gather(mi.UInt32, pixel, to)), -1)
        dr.eval(va, vb, da, db, step, excess, at, error)
        at = np.array(at)
        distance = np.where(at >= 0, image.distance.ravel()[at], FARTHEST)
        ends = [self.corner[np.array(i)] for i in (va, vb)]
        by = [np.array(d).T.astype(np.float64) * np.array(step)[:, None] for d in (da, db)]
        return total + float(error[0]), (*ends, *by, np.array(excess).astype(np.float64), distance)

    def _pull(self, vertices, pairs, frame, level, weight):
        """Energy, rows and gradient (N, 3) of the silhouette term.

        The curvature is that of the quadratic which has the term's slope here and its minimum at the mask's contour: a step then goes all
        the way, where plain Gauss-Newton, whose residuals are pixels, would go one pixel.
        """
        energy, found = pairs
        gradient = np.zeros((len(vertices), 3))
        if found is None:
            return weight * energy, None, gradient
        i, j, ci, cj, excess, distance = found
        slope = np.linalg.norm(ci + cj, axis=1)  # as the edge moves as a whole
        curvature = 2 * weight / np.maximum(1.0, slope * np.minimum(distance, FARTHEST))
        scale = 1 / level.stride
        jacobian = self.projection(vertices)
        for k, c in ((i, ci), (j, cj)):
            pull = np.einsum("ka,kab->kb", (2 * weight * excess * scale)[:, None] * c, jacobian[k])
            for axis in range(3):
                gradient[:, axis] += np.bincount(k, pull[:, axis], len(gradient))
        return weight * energy, (i, j, ci * scale, cj * scale, curvature), gradient

    def projection(self, vertices):
        """Derivatives (N, 2, 3) of the vertices' projections [pixels of the video] by their positions [m, world]."""
        x = (vertices - self.camera.origin) @ self.camera.inverse.T
        z = x[:, 2]
        position = x[:, :2] / z[:, None]
        return (self.camera.inverse[None, :2] - position[:, :, None] * self.camera.inverse[None, 2:]) / z[:, None, None]
