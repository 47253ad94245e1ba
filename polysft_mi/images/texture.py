"""The template's texture as an image: baked once, blurred to each level, moved where it lies wrong.

Import only after a Mitsuba variant is set.
"""

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from polyfit.device import on_device

from . import pixels
from .pyramid import blur, compared

_PIXEL_BLUR = 0.29  # standard deviation of a pixel's own square [pixels]
_MARGIN = 12  # texels around the box of the texture coordinates


def packed_image(colour, fourth):
    """(h, w, 3) and (h, w) as one Float of 4 channels on the device."""
    return on_device(np.concatenate([colour, fourth[..., None]], -1), mi.Float)


class Texture:
    """The reflectance of a rendered mesh over the box of its texture coordinates.

    ``image`` (H, W, 3) float32, linear; ``inside`` (H, W): 1 where a triangle may have it;
    ``density``: texels a pixel of the first frame; ``coordinates``: Float of 2V, of the rendered
    vertices; ``scale``, ``shift``: take coordinates to texels (whole at their centres).
    """

    def __init__(self, mesh, faces, position, density, masked, normalise, islands=False):
        """``faces`` (F, 3): of the rendered vertices; ``position`` (V, 2) [pixels]: of these in the
        first frame; ``masked``: whether frames have masks; ``normalise``: whether images are freed
        from lighting; ``islands``: whether the texture is that of the triangles alone. A sheet's is
        that of their whole box, for it may be moved on the sheet.
        """
        self.density, self._masked, self._normalise = density, masked, normalise
        self._faces, self._levels = faces, {}
        self.coordinates = on_device(mesh.vertex_texcoords_buffer(), mi.Float)
        self._bake(mesh, position, islands)

    def _bake(self, mesh, position, islands):
        coordinates, faces = self._host_coordinates(), self._faces
        low, size = coordinates.min(0), np.maximum(np.ptp(coordinates, axis=0), 1e-9)

        def edges(x):  # along each axis of the texture, so that both get their own density
            return x[faces] - x[np.roll(faces, -1, axis=1)]

        d = np.abs(edges((coordinates - low) / size)).reshape(-1, 2)
        span = np.linalg.norm(edges(position), axis=-1).ravel()
        straight = [d[:, k] > 4 * d[:, 1 - k] for k in (0, 1)]
        lengths = [
            np.median(span[m] / d[m, k]) if m.any() else np.median(span / np.linalg.norm(d, axis=1))
            for k, m in enumerate(straight)
        ]
        shape = [int(np.clip(round(self.density * p), 8, 4096)) for p in lengths]
        at = [
            low[k] + size[k] * (np.arange(-_MARGIN, shape[k] + _MARGIN) + 0.5) / shape[k]
            for k in (0, 1)
        ]
        total, fine = 0, 2  # samples along each side of a texel
        for dx in (np.arange(fine) + 0.5) / fine - 0.5:
            for dy in (np.arange(fine) + 0.5) / fine - 0.5:
                x, y = np.meshgrid(at[0] + dx * size[0] / shape[0], at[1] + dy * size[1] / shape[1])
                si = dr.zeros(mi.SurfaceInteraction3f, x.size)
                si.uv = mi.Point2f(*(on_device(k, mi.Float) for k in (x, y)))
                si.wi = mi.Vector3f(0, 0, 1)
                total = total + np.array(mesh.bsdf().eval_diffuse_reflectance(si)).T
        self.image = (total / fine**2).reshape(len(at[1]), len(at[0]), 3).astype(np.float32)
        self.scale = mi.Vector2f(*(float(shape[k] / size[k]) for k in (0, 1)))
        self.shift = mi.Point2f(
            *(float(_MARGIN - 0.5 - low[k] * shape[k] / size[k]) for k in (0, 1))
        )
        dr.make_opaque(self.scale, self.shift)
        x, y = np.meshgrid(*at)
        inside = (x >= low[0]) & (x <= low[0] + size[0]) & (y >= low[1]) & (y <= low[1] + size[1])
        if islands:
            inside &= self._covered(inside.shape)
        self.inside = inside.astype(np.float32)

    def _covered(self, shape):
        """Which texels (H, W) touch a triangle."""
        covered, parts = np.zeros(shape, np.uint8), 8  # bits of a texel's fraction
        corners = np.round(self.texels()[self._faces] * 2**parts).astype(np.int32)
        for triangle in corners:
            cv2.fillConvexPoly(covered, triangle, 1, shift=parts)
        return covered > 0

    def _host_coordinates(self):
        return np.array(self.coordinates, dtype=np.float64).reshape(-1, 2)

    @property
    def _weight(self):
        return self.inside if self._masked else None

    def texels(self):
        """Texels (V, 2) of the rendered vertices."""
        scale, shift = (np.array(x).ravel() for x in (self.scale, self.shift))
        return self._host_coordinates() * scale + shift

    def centroids(self):
        """Texels (F, 2) of the triangles' centroids."""
        return self.texels()[self._faces].mean(1)

    def level(self, level):
        """The texture at a :class:`polysft_mi.images.pyramid.Level`: a
        :class:`polysft_mi.images.pixels.Image` whose fourth channel is 1 where it may be trusted.
        """
        if level not in self._levels:
            sigma = self.density * np.sqrt(level.sigma**2 + (_PIXEL_BLUR * level.stride) ** 2)
            window = self.density * level.window
            image = compared(self.image, self._weight, sigma, window, self._normalise)
            trusted = np.ones_like(self.inside)
            if not self._masked and self._normalise:
                # near the border the background is in a frame's local statistics
                distance = cv2.distanceTransform(self.inside.astype(np.uint8), cv2.DIST_L2, 3)
                trusted = (distance > min(window, 0.5 * distance.max())).astype(np.float32)
            self._levels[level] = pixels.Image.of(packed_image(image, trusted), trusted.shape)
        return self._levels[level]

    def footprint_texture(self, stride):
        """The texture that the footprints of pixels are averaged over, on a grid of ``stride``
        pixels; the fourth channel is 0.
        """
        key = "fine", stride
        if key not in self._levels:
            sigma = self.density * _PIXEL_BLUR * stride / pixels.TAPS
            image = blur(self.image, sigma, self._weight)
            self._levels[key] = pixels.Image.of(
                packed_image(image, np.zeros_like(self.inside)), image.shape[:2]
            )
        return self._levels[key]

    def move(self, corner, chart, displaced):
        """Show what lies at ``chart`` (N, 2) at ``displaced`` (N, 2) instead; ``corner`` (V,): the
        template's vertex of each rendered one. Returns whether that could be done: not where the
        texture coordinates have a seam, for then they are no function of the chart.
        """
        from scipy.interpolate import LinearNDInterpolator

        coordinates = self._host_coordinates()
        shown = np.empty((len(chart), 2))
        shown[corner] = coordinates
        if np.abs(shown[corner] - coordinates).max() > 1e-6:
            return False
        inside = LinearNDInterpolator(displaced, shown)(chart)
        # beyond the border: by the nearest vertices' affine map
        missing = ~np.isfinite(inside).all(axis=1)
        if missing.any():
            _, near = cKDTree(displaced).query(chart[missing], k=12)
            for i, k in zip(np.flatnonzero(missing), near, strict=True):
                rows = np.column_stack([np.ones(len(k)), displaced[k] - chart[i]])
                inside[i] = np.linalg.lstsq(rows, shown[k], rcond=None)[0][0]
        self.coordinates = on_device(inside[corner], mi.Float)
        return True
