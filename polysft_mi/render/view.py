"""What the pixels of a region see: the triangle and its depth, found by one ray a pixel, and where
the vertices are on the screen. Import only after a Mitsuba variant is set.
"""

import math
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi


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
        return rays(self.region, self.basis, self.origin, dr.width(self.triangle))


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


def rays(region, basis, origin, count):
    """:meth:`Seen.rays` of a region of ``count`` pixels."""
    at = centre(dr.arange(mi.UInt32, count), *region[:3])
    direction = basis @ mi.Vector3f(at.x, at.y, 1)
    length = dr.norm(direction)
    return mi.Ray3f(origin, direction / length), length


def centre(pixel, x0, y0, w):
    """The centres [pixels] of pixels of a region ``w`` wide that begins at (x0, y0)."""
    y = pixel // w
    return mi.Point2f(mi.Float(pixel - y * w + x0) + 0.5, mi.Float(y + y0) + 0.5)


def margin(box, width, height):
    """(x, y, width, height) of the pixels around a box (x, y, x, y) within the image, with a margin
    for the neighbours that antialiasing blends with.
    """
    xa, ya, xb, yb = box
    xa, ya = max(0, math.floor(min(xa, width)) - 1), max(0, math.floor(min(ya, height)) - 1)
    xb, yb = min(width, math.ceil(max(xb, 0)) + 1), min(height, math.ceil(max(yb, 0)) + 1)
    return (xa, ya, xb - xa, yb - ya) if xb > xa and yb > ya else (0, 0, 1, 1)


def gather_point(positions, index, mask=True):
    """Points of a flat Float64 array, attached to it."""
    return mi.Point3f(dr.gather(mi.Point3d, positions, index, mask))


def point2(screen, index, mask=True):
    """Screen positions of the vertices ``index``, attached to ``screen``."""
    return mi.Point2f(
        *(mi.Float(dr.gather(mi.Float64, x, index, mask)) for x in (screen.x, screen.y))
    )
