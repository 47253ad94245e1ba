"""The images' part of the objective to second order: how well a surface explains a frame, and how
that changes with each vertex.

Visibility comes from Mitsuba (one ray a pixel, :meth:`RasterIntegrator.look`), the texture from the
template's BSDF, blurred like the frame; residuals and their derivatives are closed forms
(:mod:`polysft_mi.images.pixels`), summed on the device per triangle, and gathered at the vertices
(:mod:`polysft_mi.objective.assembly`). Import only after a Mitsuba variant is set.
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

from polysft_mi.objective.assembly import Assembly, Images
from polysft_mi.objective.problem import BadFrame
from polysft_mi.render.device import frozen, on_device
from polysft_mi.solvers.normal_equations import Pattern

from . import pixels
from .light import Brightness
from .pyramid import POOL, blur, compared, level_image

_TEXELS = 1.5  # texels of the baked texture to a pixel of the first frame
_PIXEL_BLUR = 0.29  # standard deviation of a pixel's own square [pixels]
# of k_silhouette: robust, normalised residuals are smaller than colours, and masks are ragged
_SILHOUETTE = 0.1
_CACHED_FRAMES = 4
# windows from the border beyond which the background has no say in a frame's local statistics
_FREE = 2.0
SHADE = "shade"  # a frame as shading is read from it, beside its levels


@dataclass
class Evaluation:
    """A frame's images against a surface. Energies are weighted like the objective; a pixel is one
    of the level's grid.

    ``photometric``, ``silhouette``: energies; ``images``:
    :class:`polysft_mi.objective.assembly.Images`, what they say at the vertices; ``pixels``: how
    many were compared; ``outlying``: the mean of r^2 / (r^2 + scale^2) over them, and ``misfit``
    with a fixed scale; both 1 where no pixel is compared; ``seen`` (F,): pixels of the video that
    see each triangle and are compared.
    """

    photometric: float
    silhouette: float
    outlying: float
    misfit: float
    images: Images
    pixels: float
    seen: np.ndarray


@dataclass
class Appearance:
    """What the camera's blur makes of a sheet in one frame, at one surface and level, and its
    texture on the template, blurred there, does not.

    ``excess``: the texture's colours less those of the sheet's image, a
    :class:`polysft_mi.images.pixels.Image` on a part of the level's grid; ``luminance`` (F,): of
    the triangles' texture as the image shows it, as :attr:`polysft_mi.images.light.Shade.texture`,
    or None."""

    excess: pixels.Image
    luminance: np.ndarray | None = None


@dataclass
class Frame:
    """A frame at a level, on the device: ``image``, with its weights in the fourth channel;
    ``mask`` and ``distance`` to its contour, or None, and the mask's ``area`` [pixels of the grid]
    and sum of ``squares``."""

    image: pixels.Image
    mask: pixels.Image | None = None
    distance: mi.Float | None = None
    area: float | None = None
    squares: float | None = None


def _packed(colour, fourth):
    """(h, w, 3) and (h, w) as one Float of 4 channels on the device."""
    return on_device(np.concatenate([colour, fourth[..., None]], -1), mi.Float)


class Registration:
    """Frames of a :class:`polysft_mi.objective.problem.Problem` against its template's texture,
    level by level.
    """

    def __init__(self, problem):
        self.problem = problem
        experiment = problem.experiment
        self.scene, self.sensor, self.camera = experiment.scene, experiment.sensor, problem.camera
        from polysft_mi.render.raster import RasterIntegrator

        self.raster = (
            experiment.renderer
            if isinstance(experiment.renderer, RasterIntegrator)
            else mi.load_dict({"type": "raster"})
        )
        mesh = experiment.mesh
        faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        self.corner = experiment.corner
        self.faces = self.corner[
            faces
        ]  # the template's vertices at the corners of the rendered triangles, (F, 3)
        self.pattern = Pattern(self.faces, problem.template.edges, len(problem.template.vertices))
        self.assembly = Assembly(self.pattern, self.camera)
        self._corner_of, self._triangle = (
            on_device(x, mi.UInt32) for x in (self.corner, np.arange(len(faces)))
        )
        self._sums, self._outline = frozen(pixels.sums), frozen(pixels.outline)
        self._texcoord = on_device(mesh.vertex_texcoords_buffer(), mi.Float)
        self._rendered = faces  # by the rendered vertices, which texture coordinates are of
        self._bake(mesh, faces)
        self._textures, self._frames, self._last = {}, OrderedDict(), None
        self._reader = ThreadPoolExecutor(1)
        sequence = problem.sequence
        self._decoded = lru_cache(2)(
            lambda frame: (sequence.frame(frame), sequence.mask(frame))
        )  # all levels are made of one decoding
        self._brightness = None
        self.normalise = problem.settings.lighting == "local"

    # -- images -------------------------------------------------------------

    def _bake(self, mesh, faces):
        """The reflectance over the box of the template's texture coordinates, as an image of a few
        texels a pixel, with a margin.
        """
        coordinates = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
        low, size = coordinates.min(0), np.maximum(np.ptp(coordinates, axis=0), 1e-9)
        position, _ = self.camera.project(self.problem.template.vertices[self.corner])

        def lengths(
            x,
        ):  # of the edges along each axis of the texture, so that both get their own density
            a, b = x[faces], x[np.roll(faces, -1, axis=1)]
            return a - b

        d = np.abs(lengths((coordinates - low) / size)).reshape(-1, 2)
        span = np.linalg.norm(lengths(position), axis=-1).ravel()
        straight = [d[:, k] > 4 * d[:, 1 - k] for k in (0, 1)]
        pixels = [
            np.median(span[m] / d[m, k]) if m.any() else np.median(span / np.linalg.norm(d, axis=1))
            for k, m in enumerate(straight)
        ]
        shape = [int(np.clip(round(_TEXELS * p), 8, 4096)) for p in pixels]
        margin = 12
        at = [
            low[k] + size[k] * (np.arange(-margin, shape[k] + margin) + 0.5) / shape[k]
            for k in (0, 1)
        ]
        total, fine = 0, 2
        for dx in (np.arange(fine) + 0.5) / fine - 0.5:
            for dy in (np.arange(fine) + 0.5) / fine - 0.5:
                x, y = np.meshgrid(at[0] + dx * size[0] / shape[0], at[1] + dy * size[1] / shape[1])
                si = dr.zeros(mi.SurfaceInteraction3f, x.size)
                si.uv, si.wi = (
                    mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32)),
                    mi.Vector3f(0, 0, 1),
                )
                total = total + np.array(mesh.bsdf().eval_diffuse_reflectance(si)).T
        self.texture = (total / fine**2).reshape(len(at[1]), len(at[0]), 3).astype(np.float32)
        x, y = np.meshgrid(*at)
        self.texture_inside = (
            (x >= low[0]) & (x <= low[0] + size[0]) & (y >= low[1]) & (y <= low[1] + size[1])
        ).astype(np.float32)
        self._texel = [
            mi.Vector2f(*(float(shape[k] / size[k]) for k in (0, 1))),
            mi.Point2f(*(float(margin - 0.5 - low[k] * shape[k] / size[k]) for k in (0, 1))),
        ]
        dr.make_opaque(self._texel)

    @property
    def brightness(self):
        """:class:`polysft_mi.images.light.Brightness` of the template and the video."""
        if self._brightness is None:
            texels = self._texels()[self._rendered].mean(1)
            vertices, masked = self.problem.template.vertices, bool(self.problem.experiment.masks)
            position, _ = self.camera.project(vertices)
            self._brightness = Brightness(
                self.faces,
                vertices,
                position,
                self.texture,
                self.texture_inside,
                texels,
                _TEXELS,
                masked,
            )
        return self._brightness

    def shade(self, vertices, frame, seen, appearance=None):
        """The triangles' :class:`polysft_mi.images.light.Shade` in a frame; vertices (N, 3) [m,
        world], ``seen`` as in :class:`Evaluation`; the texture's luminance is that of the
        ``appearance``, where it has one.
        """
        if (frame, SHADE) not in self._frames:
            self.expect([frame], [SHADE])
        position, _ = self.camera.project(vertices)
        luminance = appearance.luminance if appearance else None
        return self.brightness.of(
            self._frames[frame, SHADE].result(),
            vertices,
            self.camera.origin,
            position,
            seen,
            luminance,
        )

    def _texels(self):
        """Pixels of ``texture`` (OpenCV's, whole at their centres) of the rendered vertices, (V,
        2).
        """
        return (
            np.array(self._texcoord, dtype=np.float64).reshape(-1, 2)
            * np.array(self._texel[0]).ravel()
            + np.array(self._texel[1]).ravel()
        )

    def on_template(self, texels):
        """Points (K, 3) [m, world] of the undeformed template at pixels (K, 2) of ``texture``
        (OpenCV's, whole at their centres); NaN beyond it.
        """
        from scipy.interpolate import (
            LinearNDInterpolator,
        )  # a tenth of the start, and seldom needed

        return LinearNDInterpolator(self._texels(), self.problem.template.vertices[self.corner])(
            texels
        )

    def _texture_level(self, level):
        """The texture at a level, trusted where the fourth channel is 1:
        :class:`polysft_mi.images.pixels.Image`.
        """
        if level not in self._textures:
            sigma = _TEXELS * np.sqrt(level.sigma**2 + (_PIXEL_BLUR * level.stride) ** 2)
            weight = self.texture_inside if self.problem.experiment.masks else None
            image = compared(self.texture, weight, sigma, _TEXELS * level.window, self.normalise)
            trusted = np.ones_like(self.texture_inside)
            if (
                weight is None and self.normalise
            ):  # the background goes into a frame's local statistics near the border
                distance = cv2.distanceTransform(
                    self.texture_inside.astype(np.uint8), cv2.DIST_L2, 3
                )
                trusted = (distance > min(_TEXELS * level.window, 0.5 * distance.max())).astype(
                    np.float32
                )
            self._textures[level] = pixels.Image.of(_packed(image, trusted), trusted.shape)
        return self._textures[level]

    def _texture_fine(self, level):
        """The texture that taps are taken of at a level, as :meth:`_texture_level`."""
        key = "fine", level.stride
        if key not in self._textures:
            image = blur(
                self.texture,
                _TEXELS * _PIXEL_BLUR * level.stride / pixels.TAPS,
                self.texture_inside if self.problem.experiment.masks else None,
            )
            self._textures[key] = pixels.Image.of(
                _packed(image, np.zeros_like(self.texture_inside)), image.shape[:2]
            )
        return self._textures[key]

    def shift_texture(self, chart, displaced):
        """Move the texture on the template: what lies at ``chart`` (N, 2) is shown at ``displaced``
        (N, 2) instead. Whether that could be done.
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
        self._texcoord, self._brightness = on_device(moved, mi.Float), None
        self.problem.set_texcoords(self._texcoord)
        return True

    def expect(self, frames, levels):
        """Read and prepare frames in a second thread, for the levels given; SHADE is one."""
        brightness = (
            self.brightness if SHADE in levels else None
        )  # made here: the thread must not touch the device
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
        """The :class:`Frame` at a level."""
        key = (frame, level)
        if key not in self._frames:
            self.expect([frame], [level])
        entry = self._frames[key]
        if not isinstance(entry, Frame):
            image = entry.result()
            if not np.isfinite(image.colour).all():
                raise BadFrame(frame, math.nan)
            shape, mask = image.inside.shape, image.mask
            entry = Frame(pixels.Image.of(_packed(image.colour, image.inside), shape, image.corner))
            if mask is not None:
                entry.mask, entry.distance = (
                    pixels.Image.of(on_device(mask, mi.Float), shape, image.corner),
                    on_device(image.distance, mi.Float),
                )
                entry.area, entry.squares = (
                    max(1.0, float(mask.sum())),
                    float((mask.astype(np.float64) ** 2).sum()),
                )
            self._frames[key] = entry
        return entry

    # -- evaluation ---------------------------------------------------------

    def _look(self, vertices, level):
        """The :class:`polysft_mi.render.view.View` of the sheet with vertices (N, 3) [m, world]
        on a level's grid; the last one is kept.
        """
        if (
            self._last is None
            or self._last[0] != level.stride
            or not np.array_equal(self._last[1], vertices)
        ):
            self.problem.place(mi.Point3f(np.ascontiguousarray(vertices.T, dtype=np.float32)))
            view = self.raster.look(self.scene, self.sensor, 1 / level.stride, self._box(vertices))
            self._last = level.stride, vertices.copy(), view
        return self._last[2]

    def _box(self, vertices):
        """(x, y, x, y) [pixels of the video] around the projected vertices; None where one is not
        before the camera.
        """
        position, before = self.camera.project(vertices)
        return (*position.min(0), *position.max(0)) if before.all() else None

    @property
    def _sheet(self):
        return pixels.Sheet(
            self._triangle, self.raster.topology(self.scene).faces, self._texcoord, *self._texel
        )

    def _compared(self, view, frame, level, appearance=None):
        """What :func:`polysft_mi.images.pixels.compared` takes."""
        return (
            view.seen(),
            self._sheet,
            self._texture_level(level),
            self._frame_level(frame, level).image,
            appearance and appearance.excess,
        )

    def appearance(self, vertices, level, light=None, shaded=False):
        """The :class:`Appearance` of the sheet with vertices (N, 3) [m, world] at a level.

        A frame is blurred, and freed from lighting, in the image; the texture on the template, once
        for all. Where the sheet is seen at a slant, or hides a part of itself, these differ. So the
        sheet is rendered, under the ``light`` (7,) of :class:`polysft_mi.images.light.Light` where
        it is known, and made what the frame was made. ``shaded``: with the triangles' luminance.
        """
        lit = (
            np.ones(len(self.faces))
            if light is None
            else self.brightness.lit(vertices, self.camera.origin, light)
        )
        lit = on_device(lit, mi.Float)
        with dr.suspend_grad():
            view = self._look(vertices, level)
            stride = dr.opaque(mi.Float, level.stride * _TEXELS)
            found, template = pixels.rendered(
                view.seen(),
                self._sheet,
                self._texture_level(level),
                self._texture_fine(level),
                lit,
                stride,
            )
            corner, (w, h) = (int(view.region[0][0]), int(view.region[1][0])), view.size
            found, template = (
                np.ascontiguousarray(np.array(x).T).reshape(h, w, 4) for x in (found, template)
            )
            image, inside = self._as_frames_are(
                found[..., :3] * found[..., 3:], found[..., 3] > 0, corner, level
            )
            known = inside
            if (
                not self.problem.experiment.masks
            ):  # a frame's statistics near the border have the background in them
                padded = np.pad(inside.astype(np.uint8), 1)
                known = (
                    cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
                    > _FREE * level.window / level.stride
                ).astype(np.float32)
            excess = np.where(
                (known > 0)[..., None] & (template[..., 3:] > 0.5), template[..., :3] - image, 0
            )
            excess = pixels.Image.of(_packed(excess, np.zeros_like(inside)), (h, w), corner)
        luminance = None
        if shaded:
            position, _ = self.camera.project(vertices)
            luminance = self.brightness.shown(
                found[..., :3], inside, level.stride, position / level.stride - corner
            )
        return Appearance(excess, luminance)

    def _as_frames_are(self, colour, inside, corner, level):
        """An image (h, w, 3) of the sheet, ``inside`` (h, w) of it, made what frames are made at a
        level, on whose grid it begins at ``corner`` (x, y); and inside as float32."""
        margin = int(2 * level.window / level.stride) + 1  # of nothing, as around a mask
        pads = [
            (k - (k - margin) // POOL * POOL, -((-k - n - margin) // POOL) * POOL - k - n)
            for k, n in zip(corner[::-1], inside.shape)
        ]
        inside = inside.astype(np.float32)
        wide = compared(
            np.pad(colour, (*pads, (0, 0))),
            np.pad(inside, pads),
            level.sigma / level.stride,
            level.window / level.stride,
            self.normalise,
        )
        (top, _), (left, _) = pads
        return wide[top : top + inside.shape[0], left : left + inside.shape[1]], inside

    def residuals(self, vertices, frame, level):
        """Squared residuals r^2 = |T - I|^2 / 3 of the pixels that are compared, (P,) float32;
        vertices (N, 3) [m, world].
        """
        with dr.suspend_grad():
            view = self._look(vertices, level)
            squared, weight = pixels.squares(*self._compared(view, frame, level))
            return np.array(squared)[np.array(weight) > 0]

    def misfit(self, vertices, frame, level):
        """The mean of r^2 / (r^2 + c^2) over the pixels that are compared, 0 to 1, with a fixed c:
        1 where there are none. vertices (N, 3) [m, world].
        """
        squared = self.residuals(vertices, frame, level)
        return float((squared / (squared + pixels.MISFIT**2)).mean()) if len(squared) else 1.0

    def evaluate(self, vertices, frame, level, scale, appearance=None):
        """:class:`Evaluation` of the surface with vertices (N, 3) [m, world] against a frame, at a
        level, under the robust ``scale``; the frame has the ``appearance``'s excess.
        """
        s, shown = self.problem.settings, self._frame_level(frame, level)
        with dr.suspend_grad():
            view = self._look(vertices, level)
            table, figures = self._sums(
                *self._compared(view, frame, level, appearance), dr.opaque(mi.Float, scale)
            )
            masked, error, pairs = s.k_silhouette > 0 and shown.mask is not None, None, None
            if masked:
                crossings = self.raster.crossings(
                    view, outline=True
                )  # where a sheet passes before the sheet itself, alpha does not change
                error, pairs = self._outline(
                    view.seen(), crossings, shown.mask, shown.distance, self._corner_of
                )
            mask_weight = _SILHOUETTE * s.k_silhouette / shown.area if masked else 0.0
            images = self.assembly.images(
                table, figures, vertices, s.k_rgb, mask_weight, shown.area, level.stride, pairs
            )
            figures = (
                np.array(figures).reshape(-1, pixels.FIGURES).astype(np.float64)
            )  # waits for the device: all that it has to do is known
            energy, count, outlying, misfit = figures.sum(0).tolist()
            weight = s.k_rgb / (shown.area or max(count, 1.0))
            # the mask's squares are of the whole frame, the errors, less these, of the region
            silhouette = (
                mask_weight * (shown.squares + float(np.array(error).sum(dtype=np.float64)))
                if masked
                else 0.0
            )
        outlying, misfit = (outlying / count, misfit / count) if count else (1.0, 1.0)
        return Evaluation(
            weight * energy,
            silhouette,
            outlying,
            misfit,
            images,
            count * level.stride**2,
            figures[:, 1] * level.stride**2,
        )
