"""What the images say of a surface, to second order: how well it explains a frame, and how that
changes with each vertex.

Visibility comes from Mitsuba: one ray a pixel (:meth:`RasterIntegrator.view`). The texture is the
template's, blurred like the frame. Residuals and their derivatives are closed forms
(:mod:`polysft_mi.images.pixels`), summed on the device for each triangle and gathered at the
vertices (:mod:`polysft_mi.images.gather`). Import only after a Mitsuba variant is set.
"""

import math
from dataclasses import dataclass, replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polyfit.mesh import signed_areas
from polysft_mi.render import frozen
from polysft_mi.surface import Pattern

from . import pixels
from .chroma import Chroma
from .frames import Frames
from .gather import Gather, Images
from .light import Brightness
from .pyramid import POOL, Level, compared
from .texture import Texture, packed_image
from .triangles import TriangleColours

_ROBUST, _MEDIAN = 2.5, 0.6745  # deviations that count; the median size of a normal variable
_BEHIND = 0.03  # [m] that a surface is behind what hides it
_SHEET = 225.0  # side [pixels] of the sheet that blurs and windows are given for


@dataclass
class Evaluation:
    """A frame's images against a surface. Energies are weighted like the objective; a pixel is one
    of the level's grid.

    ``photometric``, ``silhouette``: energies; ``images``: a
    :class:`polysft_mi.images.gather.Images`, what they say at the vertices; ``outlier_share``: the
    mean of r^2 / (r^2 + scale^2) over the pixels that are compared; ``misfit``: the same with a
    fixed scale (both are 1 where none is); ``seen`` (F,): pixels of the video that see each
    triangle; ``noise``: what one unit of log-likelihood costs, were the residuals of all pixels
    independent of each other: their own size says it.
    """

    photometric: float
    silhouette: float
    outlier_share: float
    misfit: float
    images: Images
    seen: np.ndarray
    noise: float


@dataclass
class Appearance:
    """How a sheet looks in a frame, beyond what its blurred texture tells.

    ``excess``: colours of the texture less those of the sheet's image, a
    :class:`polysft_mi.images.pixels.Image` on a part of the level's grid; ``misfit``: what it alone
    would be as a misfit; ``colours`` (F, 3): of the triangles' texture as the image shows it,
    linear RGB over the mean of its luminance, or None; ``others``: of the same sheet, in other
    cameras.
    """

    excess: pixels.Image
    misfit: float
    colours: np.ndarray | None = None
    others: tuple = ()


class DataTerm:
    """The frames of a ``sequence`` (:class:`polysft_mi.scene.sequence.Sequence`) against the
    texture of a ``template``, whose mesh is ``placed``
    (:class:`polysft_mi.render.placed.PlacedMesh`) in the scene.

    ``normalise``: whether images are freed from lighting. A ``blur`` [pixels, on a sheet of 225
    pixels] names the level at which images are compared; a
    :class:`polysft_mi.images.pyramid.Level` may be given in its place. Vertices are (N, 3) [m,
    world], those where the first frame begins are ``start``.
    """

    def __init__(self, placed, template, start, sequence, rules, normalise):
        self._placed, self._template, self._rules = placed, template, rules
        self._start = start
        self.camera = placed.camera
        self._raster = placed.renderer if placed.is_raster else mi.load_dict({"type": "raster"})
        self._corner, self.faces = placed.corner, placed.faces
        self.pattern = Pattern(self.faces, template.edges, len(template.vertices))
        self.gather = Gather(self.pattern, self.camera)
        self._corner_of = on_device(self._corner, mi.UInt32)
        self._triangle = on_device(np.arange(len(self.faces)), mi.UInt32)
        self._sums, self._outline = frozen(pixels.triangle_sums), frozen(pixels.silhouette_terms)
        self.normalise, self._masked = normalise, sequence.mask_files is not None
        position, _ = self.camera.project(start)
        shown = placed.mesh, placed.rendered_faces, position[self._corner]
        how = self._rules.texels, self._masked, self.normalise, len(template) > 1
        self.texture = Texture(*shown, *how)
        # of the side that is turned to the camera: the larger one, for a sheet has any winding
        signed = signed_areas(position, self.faces)
        #: of the template in the image [pixels]
        self.area = max(signed[signed > 0].sum(), -signed[signed < 0].sum())
        self._unit = max(1.0, math.sqrt(self.area) / _SHEET)
        self._frames = Frames(sequence, normalise)
        self._levels, self._last, self._colours = {}, None, None
        self._before = None  # what hides the surface

    def level(self, blur):
        """The :class:`polysft_mi.images.pyramid.Level` that a ``blur`` names."""
        if isinstance(blur, Level):
            return blur
        if blur not in self._levels:
            sigma = blur * self._unit
            window = max(self._rules.window * self._unit, 3 * sigma)
            self._levels[blur] = Level(sigma, max(1, int(0.8 * sigma)), window)
        return self._levels[blur]

    # -- what is known before a frame is looked at ---------------------------

    def prefetch(self, frames, blurs, coloured):
        """Read ``frames`` ahead in a second thread, for what follows at ``blurs``, and with
        ``coloured`` for :meth:`shade` and :meth:`chroma`; those beyond the video are left out.
        """
        # made here, because the thread must not touch the device
        colours = self.colours if coloured else None
        self._frames.prefetch(frames, [self.level(blur) for blur in blurs], colours)

    @property
    def colours(self):
        """The :class:`polysft_mi.images.triangles.TriangleColours` of the template and the video;
        others once the texture has moved.
        """
        if self._colours is None:
            position, _ = self.camera.project(self._start)
            self._colours = TriangleColours(
                self.faces, position, self.texture, self._masked, self._rules
            )
        return self._colours

    @property
    def brightness(self):
        """The :class:`polysft_mi.images.light.Brightness` of the template and the video."""
        return Brightness(self.colours, self._start)

    def on_template(self, texels):
        """Points (K, 3) [m, world] of the template, as it stands first, at ``texels`` (K, 2) of the
        baked texture; NaN beyond it.
        """
        from scipy.interpolate import LinearNDInterpolator  # a tenth of the start, seldom needed

        at = self._start[self._corner]
        return LinearNDInterpolator(self.texture.texels(), at)(texels)

    def move_texture(self, chart, displaced):
        """Show what lies at ``chart`` (N, 2) at ``displaced`` (N, 2) instead; see
        :meth:`polysft_mi.images.texture.Texture.move`.
        """
        if not self.texture.move(self._corner, chart, displaced):
            return False
        self._colours = None
        self._placed.set_texcoords(self.texture.coordinates)
        return True

    # -- what the camera sees ------------------------------------------------

    def hide(self, depth, frame, reach):
        """Let what stands before the surface hide it in ``frame``, where no mask says that it is
        seen: something at ``depth`` (H, W) [m], infinite where there is nothing, which may be
        ``reach`` pixels from there.
        """
        size = 2 * round(reach) + 1
        nearest = cv2.erode(depth, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
        mask = self._frames.mask(frame)
        if mask is not None:
            nearest[mask > 0.5] = np.inf
        nearest = on_device(nearest, mi.Float)
        self._before, self._last = pixels.Image.of(nearest, depth.shape), None

    def _hidden(self, view, level):
        """The view without what is behind that."""
        if self._before is None:
            return view
        x, y = (
            mi.Int32(mi.Float(2 * k + 1) * (level.stride / 2))
            for k in pixels.pixel_coordinates(view)
        )
        pixel, known = self._before.at(x, y)
        before = dr.gather(mi.Float, self._before.texels, pixel, known)
        hidden = known & (view.depth > before + _BEHIND)
        return replace(view, triangle=dr.select(hidden, mi.Int32(-1), view.triangle))

    def view(self, vertices, level):
        """The :class:`polysft_mi.render.view.View` of a surface on a level's grid; the last is
        kept.
        """
        last = self._last
        if last is None or last[0] != level.stride or not np.array_equal(last[1], vertices):
            self._placed.place(on_device(vertices, mi.Point3f))
            position, before = self.camera.project(vertices)
            box = (*position.min(0), *position.max(0)) if before.all() else None
            view = self._raster.view(self._placed.scene, self._placed.sensor, 1 / level.stride, box)
            with dr.suspend_grad():
                view = self._hidden(view, level)
            self._last = level.stride, vertices.copy(), view
        return self._last[2]

    @property
    def sheet(self):
        """The rendered mesh, a :class:`polysft_mi.images.pixels.Sheet`."""
        faces, texture = self._raster.topology(self._placed.scene).faces, self.texture
        return pixels.Sheet(
            self._triangle, faces, texture.coordinates, texture.scale, texture.shift
        )

    def at_pixels(self, vertices, positions):
        """What a surface shows at ``positions`` (P, 2) [pixels]: the triangles (P,), -1 where there
        is none, and the barycentric coordinates (P, 3) of the points on their planes.
        """
        with dr.suspend_grad():
            view = self.view(vertices, Level(0.0))
            triangle = np.array(view.triangle).reshape(view.size[::-1])
        x, y = (np.floor(positions[:, k]).astype(int) - int(view.region[k][0]) for k in (0, 1))
        inside = (x >= 0) & (x < view.size[0]) & (y >= 0) & (y < view.size[1])
        found = np.full(len(positions), -1)
        found[inside] = triangle[y[inside], x[inside]]
        rays = np.column_stack([positions, np.ones(len(positions))]) @ self.camera.basis.T
        corners = vertices[self.faces[np.maximum(found, 0)]] - self.camera.origin
        weights = np.linalg.solve(corners.swapaxes(1, 2), rays[..., None])[..., 0]
        return found, weights / weights.sum(1, keepdims=True)

    # -- a surface against a frame -------------------------------------------

    def seen_vertices(self, vertices, blur):
        """Which vertices of a surface belong to a triangle that a pixel sees, (N,) bool."""
        with dr.suspend_grad():
            triangle = np.array(self.view(vertices, self.level(blur)).triangle)
        seen = np.zeros(len(vertices), dtype=bool)
        seen[self.faces[np.unique(triangle[triangle >= 0])]] = True
        return seen

    def misfit(self, vertices, frame, blur):
        """The mean of r^2 / (r^2 + c^2) over the pixels that are compared, 0 to 1, with a fixed c;
        1 where there are none.
        """
        squared = self.residuals(vertices, frame, blur)
        return float((squared / (squared + pixels.MISFIT**2)).mean()) if len(squared) else 1.0

    def residuals(self, vertices, frame, blur):
        """Squared residuals r^2 = |T - I|^2 / 3 of the pixels that are compared, (P,) float32."""
        level = self.level(blur)
        with dr.suspend_grad():
            view = self.view(vertices, level)
            squared, weight = pixels.squares(*self._residual_arguments(view, frame, level))
            return np.array(squared)[np.array(weight) > 0]

    def numbers_as_one(self, vertices, frame, blur, appearance=None):
        """(pixels, colours), how many numbers of the video count as one observation of a surface:
        of one colour's, 1 or more, and of the three of a pixel, 1 to 3. The first is the sum of the
        residuals' correlation with those around, as far as the window of local brightness reaches:
        blur makes it, and whatever else is wrong alike in neighbours. Other arguments as of
        :meth:`evaluate`.
        """
        level = self.level(blur)
        with dr.suspend_grad():
            view = self.view(vertices, level)
            found = pixels.residuals(*self._residual_arguments(view, frame, level, appearance))
            residual, weight = (np.array(x, dtype=np.float32) for x in found[:2])
        known = weight > 0
        if not known.any():
            return 1.0, 1.0
        size = np.abs(residual[:3, known])
        most = _ROBUST * float(np.median(size)) / _MEDIAN
        clipped = np.where(known, np.clip(residual[:3], -most, most), 0)
        shape, reach = view.size[::-1], round(level.window / level.stride)
        images = (*clipped, clipped.sum(0), known.astype(np.float32))
        images = np.dstack([x.reshape(shape) for x in images])
        side = 2 * reach + 1, 2 * reach + 1
        around = cv2.boxFilter(images, -1, side, borderType=cv2.BORDER_CONSTANT)
        inside = known.reshape(shape)
        *each, together = (images * around)[inside][:, :-1].sum(0, dtype=np.float64).tolist()
        mean_share = float(around[inside, -1].mean(dtype=np.float64))
        power = max(float(np.square(clipped).sum(dtype=np.float64)), 1e-30)
        alike = side[0] * side[1] * sum(each) / (mean_share * power) * level.stride**2
        return max(1.0, alike), min(max(together / max(sum(each), 1e-30), 1.0), 3.0)

    def evaluate(self, vertices, frame, blur, scale, appearance=None, k_rgb=1.0, k_silhouette=1.0):
        """The :class:`Evaluation` of a surface against a frame, under the robust ``scale`` [local
        standard deviations] and the weights ``k_rgb`` and ``k_silhouette``; the frame is corrected
        by an ``appearance``.
        """
        level = self.level(blur)
        shown = self._frames.level(frame, level)
        with dr.suspend_grad():
            view = self.view(vertices, level)
            table, figures = self._sums(
                *self._residual_arguments(view, frame, level, appearance),
                dr.opaque(mi.Float, scale),
            )
            masked, error, pairs = k_silhouette > 0 and shown.mask is not None, None, None
            if masked:
                # where a sheet passes before the sheet itself, alpha does not change
                crossings = self._raster.crossings(view, outline=True)
                error, pairs = self._outline(
                    view.seen(), crossings, shown.mask, shown.distance, self._corner_of
                )
            mask_weight = k_silhouette / shown.area if masked else 0.0
            images = self.gather.images(
                table, figures, vertices, k_rgb, mask_weight, shown.area, level.stride, pairs
            )
            # waits for the device: by now it knows all that it has to do
            figures = np.array(figures).reshape(-1, pixels.FIGURES).astype(np.float64)
            energy, count, outlier_share, misfit = figures.sum(0).tolist()
            weight = k_rgb / (shown.area or max(count, 1.0))
            silhouette = 0.0
            if masked:  # the squares are of the whole frame, the errors, less these, of the region
                squares = shown.squares + float(np.array(error).sum(dtype=np.float64))
                silhouette = mask_weight * squares
        outlier_share, misfit = (outlier_share / count, misfit / count) if count else (1.0, 1.0)
        photometric, compared_pixels = weight * energy, count * level.stride**2
        noise = 2 * photometric / (3 * max(compared_pixels, 1.0))
        energies, seen = (photometric, silhouette), figures[:, 1] * level.stride**2
        return Evaluation(*energies, outlier_share, misfit, images, seen, noise)

    def shade(self, vertices, frame, seen, appearance=None):
        """The triangles' :class:`polysft_mi.images.light.Shade` in a frame; ``seen`` as in
        :class:`Evaluation`. The texture's luminance is that of the ``appearance`` where it has one.
        """
        prepared = self._frames.colours(frame, self.colours)
        position, _ = self.camera.project(vertices)
        known = appearance.colours if appearance else None
        return self.brightness.of(prepared, vertices, self.camera.origin, position, seen, known)

    def shown(self, vertices, frame):
        """The colours (F, 3) that a frame shows where the triangles of a surface are, seen or not,
        as :class:`polysft_mi.images.triangles.TriangleColours` has them.
        """
        position, _ = self.camera.project(vertices)
        centres = position[self.faces].sum(1) / 3
        return self.colours.shown(self._frames.colours(frame, self.colours), centres)

    def chroma(self, vertices, frame, seen, cast, appearance=None):
        """The triangles' :class:`polysft_mi.images.chroma.Chroma` in a frame; ``seen`` as in
        :class:`Evaluation`, ``cast`` (F, 3): :func:`polysft_mi.images.chroma.colour_cast`.
        """
        prepared = self._frames.colours(frame, self.colours)
        known = appearance.colours if appearance else None
        scale = self._rules.chroma_scale
        return Chroma.of(self.colours, prepared, vertices, self.camera, seen, cast, scale, known)

    def appearance(self, vertices, blur, light=None, shaded=False):
        """The :class:`Appearance` of a sheet.

        A frame is blurred, and freed from lighting, in the image; the texture on the template, once
        for all. Where the sheet is seen at a slant, or hides a part of itself, these differ. So the
        sheet is rendered, under the ``light`` (7,) of :class:`polysft_mi.images.light.Light` where
        it is known, and then treated like a frame. ``shaded``: with the triangles' colours.
        """
        level = self.level(blur)
        lit = np.ones(len(self.faces))
        if light is not None:
            lit = self.brightness.irradiance(vertices, self.camera.origin, light)
        lit = on_device(lit, mi.Float)
        with dr.suspend_grad():
            view = self.view(vertices, level)
            found, template = pixels.rendered(
                view.seen(),
                self.sheet,
                self.texture.level(level),
                self.texture.footprint_texture(level.stride),
                lit,
            )
            corner, (w, h) = (int(view.region[0][0]), int(view.region[1][0])), view.size
            found, template = (
                np.ascontiguousarray(np.array(x).T).reshape(h, w, 4) for x in (found, template)
            )
            image, inside = self._treated_like_a_frame(
                found[..., :3] * found[..., 3:], found[..., 3] > 0, corner, level
            )
            known = inside
            if not self._masked:  # near the border the background is in a frame's local statistics
                padded = np.pad(inside.astype(np.uint8), 1)
                distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
                border = self._rules.border * level.window / level.stride
                known = (distance > border).astype(np.float32)
            known = (known > 0)[..., None] & (template[..., 3:] > 0.5)
            excess = np.where(known, template[..., :3] - image, 0)
            squared = (excess**2).sum(-1) / 3
            misfit = float((squared / (squared + pixels.MISFIT**2)).sum() / max(inside.sum(), 1.0))
            excess = pixels.Image.of(packed_image(excess, np.zeros_like(inside)), (h, w), corner)
        colours = None
        if shaded:
            position, _ = self.camera.project(vertices)
            at = position / level.stride - corner
            colours = self.colours.of_rendering(found[..., :3], inside, level.stride, at)
        return Appearance(excess, misfit, colours)

    # -- parts ----------------------------------------------------------------

    def _residual_arguments(self, view, frame, level, appearance=None):
        """What :func:`polysft_mi.images.pixels.residuals` takes."""
        return (
            view.seen(),
            self.sheet,
            self.texture.level(level),
            self._frames.level(frame, level).image,
            appearance and appearance.excess,
        )

    def _treated_like_a_frame(self, colour, inside, corner, level):
        """An image (h, w, 3) of the sheet, ``inside`` (h, w) of it, made what frames are made at a
        level, on whose grid it begins at ``corner`` (x, y); and inside as float32.
        """
        margin = int(2 * level.window / level.stride) + 1  # of nothing, as around a mask
        pads = [
            (k - (k - margin) // POOL * POOL, -((-k - n - margin) // POOL) * POOL - k - n)
            for k, n in zip(corner[::-1], inside.shape, strict=True)
        ]
        inside = inside.astype(np.float32)
        padded = np.pad(colour, (*pads, (0, 0))), np.pad(inside, pads)
        scales = level.sigma / level.stride, level.window / level.stride
        wide = compared(*padded, *scales, self.normalise)
        (top, _), (left, _) = pads
        return wide[top : top + inside.shape[0], left : left + inside.shape[1]], inside
