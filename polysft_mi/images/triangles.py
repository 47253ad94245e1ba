"""Colours of a template's texture and of frames at the size of its triangles. NumPy and OpenCV."""

import math

import cv2
import numpy as np

from polyfit.colours import LUMINANCE
from polyfit.mesh import signed_areas

from .pyramid import blur, shrink


def luminance(colour):
    """Of linear RGB (..., 3)."""
    return colour @ LUMINANCE


class TriangleColours:
    """Colours of the template's texture and of frames, blurred alike to the size of the triangles
    ``faces`` (F, 3), linear, over the mean of the texture's luminance.

    ``position`` (N, 2) [pixels]: of the template in the image; ``texture``:
    :class:`polysft_mi.images.texture.Texture`; ``masked``: whether the frames have masks.

    ``colour`` (F, 3): of the texture; ``trusted`` (F,): which say something.
    """

    def __init__(self, faces, position, texture, masked, rules):
        self.faces = faces
        self.sigma = rules.shading_blur * math.sqrt(
            max(np.abs(signed_areas(position, faces)).mean(), 1.0)
        )
        sigma, inside, centroids = texture.density * self.sigma, texture.inside, texture.centroids()
        covered = cv2.GaussianBlur(inside, (0, 0), sigma)
        found = sampled(blur(texture.image, sigma, inside if masked else None), centroids)
        self.trusted = sampled(covered, centroids) > 0
        usual = luminance(found[self.trusted]).mean() if self.trusted.any() else 0.0
        self.mean = max(float(usual), 1e-6)
        self.colour = found / self.mean
        self.trusted &= luminance(self.colour) > 0

    def of_frame(self, colour, mask):
        """A frame ``colour`` (H, W, 3) [linear RGB] with its ``mask`` (H, W) or None, as
        :meth:`shown` wants it: colours, blurred, on a grid of blocks of ``pool`` x ``pool`` pixels,
        and ``pool``.
        """
        pool = max(1, int(self.sigma / 2))
        if pool > 1:
            colour, mask = shrink(colour, pool), None if mask is None else shrink(mask, pool)
        return blur(colour, self.sigma / pool, mask) / np.float32(self.mean), pool

    def shown(self, prepared, centres):
        """What a frame shows at ``centres`` (K, 2) [pixels], (K, 3)."""
        image, pool = prepared
        return sampled(image, centres / pool - 0.5)

    def slopes(self, prepared, centres):
        """The derivatives (K, 3, 2) of :meth:`shown` by the centres [1/pixel], over a block to
        either side.
        """
        _, pool = prepared
        return np.stack(
            [
                self.shown(prepared, centres + step) - self.shown(prepared, centres - step)
                for step in pool * np.eye(2)
            ],
            -1,
        ) / (2 * pool)

    def of_rendering(self, colour, inside, stride, position):
        """Colours (F, 3) of the triangles' texture, where a sheet's image without light is
        ``colour`` (h, w, 3), covered by it where ``inside`` (h, w) is 1, of blocks of ``stride`` x
        ``stride`` pixels, and its vertices lie at ``position`` (N, 2) [blocks] there.
        """
        image = blur(np.ascontiguousarray(colour), self.sigma / stride, inside)
        return sampled(image, position[self.faces].sum(1) / 3 - 0.5) / self.mean

    def known(self, colour):
        """The ``colour`` (F, 3) of the texture as an image shows it, that of the texture itself
        where this is black, or where it is None.
        """
        if colour is None:
            return self.colour
        return np.where((luminance(colour) > 0)[:, None], colour, self.colour)


def sampled(image, points):
    """The image (h, w) or (h, w, 3) at points (K, 2) [pixels, whole at their centres], (K,) or
    (K, 3) float64, bilinear; the border's values beyond it.
    """
    x, y = (np.ascontiguousarray(points[None, :, k], np.float32) for k in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0].astype(
        np.float64
    )


def cross(a, b):
    """a x b of (F, 3) each; several times faster than numpy.cross."""
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], 1)
