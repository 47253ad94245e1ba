"""Masks by colour: GrabCut around the template's projection in the first frame, then around where
the optical flow carries the mask of the frame before.
"""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class MaskSettings:
    """How masks are found.

    ``side`` [pixels]: the longer side at which the work is done; ``band``: how far the border may
    lie from where it is expected, as a share of the silhouette's size; ``first_iterations``,
    ``iterations`` of GrabCut in the first frame and in the others; ``overlap``: least share of the
    mask that the photo must explain for its word on the rest to count; ``lost`` [pixels]: half the
    width of a part that only the photo tells, at least.
    """

    side: int = 480
    band: float = 0.035
    first_iterations: int = 5
    iterations: int = 2
    overlap: float = 0.8
    lost: int = 2


class Masks:
    """``first(image, silhouette)``, then ``next(image)`` for each frame: masks (H, W) uint8, 0 or
    255, of images (H, W, 3) uint8 RGB.
    """

    def __init__(self, size, registration=None, settings=None):
        """``size``: (width, height) of the frames [pixels]; ``registration``: makes of the factor
        by which frames are shrunk the :class:`Registration` of the photo, or None.
        """
        self._size, self._settings = size, settings or MaskSettings()
        self._small = tuple(
            max(1, round(n * min(1.0, self._settings.side / max(size)))) for n in size
        )
        self._flow = cv2.DISOpticalFlow_create(cv2.DISOpticalFlow_PRESET_FAST)
        self._grey = self._mask = None
        self._models = np.zeros((1, 65)), np.zeros((1, 65))
        self._registration = registration and registration(
            np.array(self._small) / np.array(self._size)
        )
        self._colours = None
        # of the last mask: 0 where its colours are those of the first, 1 where they share none
        # (Bhattacharyya)
        self.strangeness = 0.0

    def first(self, image, silhouette):
        """From the template's silhouette (H, W), 0 or 255."""
        small = self._reduced(image)
        self._grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        expected = (self._reduced(silhouette) > 127).astype(np.uint8)
        self._mask = self._cut(small, expected, self._settings.first_iterations)
        if self._registration:
            self._mask = self._completed(self._registration.first(small))
        self._colours = _histogram(small, self._mask)
        return self._enlarged()

    def next(self, image):
        small = self._reduced(image)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        flow = self._flow.calc(grey, self._grey, None)
        y, x = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float32)
        moved = cv2.remap(255 * self._mask, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)
        self._grey, self._mask = (
            grey,
            self._cut(small, (moved > 127).astype(np.uint8), self._settings.iterations),
        )
        if self._registration:
            self._mask = self._completed(self._registration.next(small))
        self.strangeness = cv2.compareHist(
            _histogram(small, self._mask), self._colours, cv2.HISTCMP_BHATTACHARYYA
        )
        return self._enlarged()

    def _completed(self, shown):
        """The mask, and the part of the frame that shows the print: where that has the
        background's colour, GrabCut takes it for background.
        """
        if shown is None:
            return self._mask
        found = self._mask > 0
        if (shown & found).sum() < self._settings.overlap * max(found.sum(), 1):
            return self._mask
        lost = (shown & ~found).astype(np.uint8)
        # along the border colours tell better than the map: only what is wide has been lost
        wide = cv2.morphologyEx(lost, cv2.MORPH_OPEN, _disc(self._settings.lost))
        return self._mask | (lost & cv2.dilate(wide, _disc(self._settings.lost + 1)))

    def _cut(self, image, expected, iterations):
        if not expected.any():
            return expected
        r = max(2, round(self._settings.band * np.sqrt(expected.sum())))
        disc = _disc(r)
        inner = cv2.erode(expected, disc, borderValue=1)
        outer = cv2.dilate(expected, disc)
        trimap = np.where(
            inner > 0,
            cv2.GC_FGD,
            np.where(outer > 0, np.where(expected > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD),
        ).astype(np.uint8)
        x, y, w, h = cv2.boundingRect(outer)
        window = np.s_[max(0, y - 4 * r) : y + h + 4 * r, max(0, x - 4 * r) : x + w + 4 * r]
        part = np.ascontiguousarray(trimap[window])
        sides = {cv2.GC_FGD, cv2.GC_PR_FGD}, {cv2.GC_BGD, cv2.GC_PR_BGD}
        if any(side.isdisjoint(np.unique(part)) for side in sides):  # it fills the picture
            return expected
        cv2.setRNGSeed(0)
        cv2.grabCut(
            np.ascontiguousarray(image[window]),
            part,
            None,
            *self._models,
            iterations,
            cv2.GC_INIT_WITH_MASK,
        )
        cut = np.zeros_like(expected)
        cut[window] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
        return _connected(cut, inner)

    def _reduced(self, image):
        return (
            image
            if self._small == self._size
            else cv2.resize(image, self._small, interpolation=cv2.INTER_AREA)
        )

    def _enlarged(self):
        if self._small == self._size:
            return 255 * self._mask
        soft = cv2.resize(self._mask.astype(np.float32), self._size, interpolation=cv2.INTER_CUBIC)
        return np.where(soft > 0.5, 255, 0).astype(np.uint8)


def _disc(radius):
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _histogram(image, mask):
    counts = cv2.calcHist([image], [0, 1, 2], mask, [8, 8, 8], [0, 256] * 3)
    return cv2.GaussianBlur(counts.reshape(8, -1), (3, 3), 0) / max(counts.sum(), 1)


def _connected(mask, core):
    """The components of a mask that meet ``core``; all of it where there is no core."""
    if not core.any():
        return mask
    _, labels = cv2.connectedComponents(mask, connectivity=8)
    keep = np.unique(labels[core > 0])
    return (np.isin(labels, keep[keep > 0])).astype(np.uint8)


def silhouette(pixels, faces, size):
    """The projection of a mesh: mask (H, W) uint8, 0 or 255, of triangles ``faces`` (F, 3) between
    ``pixels`` (N, 2), (0.5, 0.5) the first pixel's centre."""
    mask = np.zeros(size[::-1], np.uint8)
    # binary places of the fixed-point coordinates that OpenCV takes; it counts from the first
    # pixel's centre
    shift = 4
    corners = np.round((np.clip(pixels, -1e5, 1e5) - 0.5) * 2**shift).astype(np.int32)
    for face in corners[faces]:
        cv2.fillConvexPoly(mask, face, 255, cv2.LINE_8, shift)
    return mask


def iou(a, b):
    """Intersection over union of two masks, above half their largest value each; 1 where both are
    empty.
    """
    a, b = (np.asarray(m) > 0.5 * max(np.max(m), 1e-9) for m in (a, b))
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def beyond(mask, silhouette):
    """How far a mask passes a silhouette [pixels], the median along its border; negative where it
    does not reach it, 0 where one of them is empty, or the mask is all of the image.
    """
    inside = (silhouette > 127).astype(np.uint8)
    border = inside - cv2.erode(inside, _disc(1), borderValue=1)
    if not border.any() or not (mask > 127).any() or (mask > 127).all():
        return 0.0
    return float(np.median(_depths(mask)[border > 0])) - 0.5


def drawn_in(mask, pixels):
    """A mask (H, W) uint8 whose border is drawn in by so many pixels, or out where they are
    negative; it is soft there, 0 to 255.
    """
    if not pixels or not (mask > 127).any():
        return mask
    return np.round(255 * np.clip(_depths(mask) - pixels + 0.5, 0, 1)).astype(np.uint8)


def _depths(mask):
    """How far each pixel's centre lies within a mask's border [pixels]; negative outside."""
    inside = (mask > 127).astype(np.uint8)
    to_border = lambda x: cv2.distanceTransform(x, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.maximum(to_border(inside) - 0.5, 0) - np.maximum(to_border(1 - inside) - 0.5, 0)
