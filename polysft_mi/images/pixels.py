"""From what the pixels of a frame see to sums over the triangles: residuals, and their derivatives
in closed form.

Functions of Dr.Jit arrays alone: what an iteration needs of them is recorded
(:func:`polysft_mi.render.device.frozen`), for regions of any size. Hence numbers that change are
arrays of one entry, every kernel reads an array of its own size elementwise, and no array whose
size depends on the pixels is made to be scattered to. Import only after a Mitsuba variant is set.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from polysft_mi.render import blend, point2

from .pyramid import MAX_CONTOUR_DISTANCE

MISFIT = 0.5  # residual, in local standard deviations, that counts half a misfit
# pairs of a triangle's corners, as their curvatures are summed
CORNERS = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)
CURVATURES, SLOPES, FIGURES = 18, 9, 4  # sums over the pixels of a triangle
TAPS = 2  # across a pixel's footprint on the texture, and along it
# pixels by which a ray may pass the triangle that it meets: it and the projection round differently
_BOX_TOLERANCE = 0.01


@dataclass
class Image:
    """An image of one channel or of 4 packed ones: ``texels`` Float of w h or 4 w h, ``width`` and
    ``height`` [pixels], and (``x``, ``y``), the pixel of the grid that is its first; opaque."""

    texels: mi.Float
    width: mi.Int32
    height: mi.Int32
    x: mi.Int32
    y: mi.Int32

    @classmethod
    def of(cls, texels, shape, corner=(0, 0)):
        """From ``texels``, the ``shape`` (h, w) and the first pixel's place ``corner`` (x, y) on
        the grid.
        """
        return cls(texels, *(dr.opaque(mi.Int32, int(k)) for k in (shape[1], shape[0], *corner)))

    def at(self, x, y):
        """Indices of pixels (x, y) of the grid, and whether the image has them."""
        x, y = x - self.x, y - self.y
        return mi.UInt32(y * self.width + x), (x >= 0) & (x < self.width) & (y >= 0) & (
            y < self.height
        )

    def bilinear(self, at, active):
        """The image of 4 channels at a place [pixels, whole at their centres], and its derivatives
        by x and y [1/pixel]: Vector4f each.
        """
        row = mi.UInt32(self.width)
        x = dr.clip(at.x, 0, mi.Float(self.width) - 1.001)
        y = dr.clip(at.y, 0, mi.Float(self.height) - 1.001)
        ix, iy = mi.UInt32(x), mi.UInt32(y)
        fx, fy = x - mi.Float(ix), y - mi.Float(iy)
        first = iy * row + ix
        t00, t10, t01, t11 = (
            dr.gather(mi.Vector4f, self.texels, first + k, active) for k in (0, 1, row, row + 1)
        )
        top, bottom = t00 + (t10 - t00) * fx, t01 + (t11 - t01) * fx
        return top + (bottom - top) * fy, (t10 - t00) * (1 - fy) + (t11 - t01) * fy, bottom - top


@dataclass
class Sheet:
    """The rendered mesh: ``triangle`` UInt32 0, 1, ... of F; ``faces`` UInt32 of 3F, ``texcoords``
    Float of 2V, and what takes these to texels (whole at their centres): times ``scale``, plus
    ``shift``."""

    triangle: mi.UInt32
    faces: mi.UInt32
    texcoords: mi.Float
    scale: mi.Vector2f
    shift: mi.Point2f

    def corners(self, triangle, active=True):
        """The three vertices of triangles."""
        return [dr.gather(mi.UInt32, self.faces, 3 * triangle + k, active) for k in range(3)]


@dataclass
class RayHit:
    """What the ray ``ray`` of a pixel meets: the ``triangle``, its barycentric coordinates ``b1``,
    ``b2``, its edges ``e1``, ``e2`` [m], the place ``at`` on the texture [texels], and that's
    derivatives ``c1``, ``c2`` by b1 and b2 [texture coordinates].
    """

    ray: mi.Ray3f
    triangle: mi.UInt32
    b1: mi.Float
    b2: mi.Float
    e1: mi.Vector3f
    e2: mi.Vector3f
    at: mi.Point2f
    c1: mi.Vector2f
    c2: mi.Vector2f

    def plane(self):
        """(grad1, grad2, slide): derivatives of b1 and b2 by a point in the triangle's plane, and
        the normal over its product with the ray's direction: a plane that moves by m slides the
        ray's point on it by slide . m along the ray.
        """
        n = dr.cross(self.e1, self.e2)
        inverse = dr.rcp(dr.squared_norm(n))
        return (
            dr.cross(self.e2, n) * inverse,
            dr.cross(n, self.e1) * inverse,
            n * dr.rcp(dr.dot(n, self.ray.d)),
        )


def ray_hits(seen, sheet):
    """:class:`RayHit` of all pixels of a :class:`polysft_mi.render.view.Seen`."""
    hit = seen.hit
    triangle = mi.UInt32(dr.select(hit, seen.triangle, 0))
    index, flat, (ray, _) = sheet.corners(triangle, hit), mi.Float(seen.positions), seen.rays()
    p0, p1, p2 = (dr.gather(mi.Point3f, flat, i, hit) for i in index)
    c0, c1, c2 = (dr.gather(mi.Point2f, sheet.texcoords, i, hit) for i in index)
    e1, e2 = p1 - p0, p2 - p0
    pv = dr.cross(ray.d, e2)
    inverse = dr.select(hit, dr.rcp(dr.dot(e1, pv)), 0)
    tv = ray.o - p0
    b1 = dr.dot(tv, pv) * inverse
    b2 = dr.dot(ray.d, dr.cross(tv, e1)) * inverse
    at = (c0 + (c1 - c0) * b1 + (c2 - c0) * b2) * sheet.scale + sheet.shift
    return RayHit(ray, triangle, b1, b2, e1, e2, at, c1 - c0, c2 - c0)


def pixel_coordinates(seen):
    """The pixels' places (x, y) on the level's grid, Int32."""
    x0, y0, width, _ = seen.region
    local = dr.arange(mi.UInt32, dr.width(seen.triangle))
    y = local // width
    return mi.Int32(local - y * width + x0), mi.Int32(y + y0)


def across(seen):
    """What one pixel to the right and one down are at the depth of each ray's point [m]."""
    return [seen.depth * mi.Vector3f(*(seen.basis[k, axis] for k in range(3))) for axis in (0, 1)]


def residuals(seen, sheet, texture, frame, excess):
    """Residuals (Vector4f, its fourth entry 0) and weights of the pixels; what they met, and the
    texture's derivatives by texture coordinates.

    ``texture``: an :class:`Image` whose fourth channel tells where it is trusted; ``frame``: one
    with the weights in its fourth, which has the ``excess``, or None, beyond the texture.
    """
    hit, found = seen.hit, ray_hits(seen, sheet)
    colour, by_x, by_y = texture.bilinear(found.at, hit)
    x, y = pixel_coordinates(seen)
    pixel, known = frame.at(x, y)
    target = dr.gather(mi.Vector4f, frame.texels, pixel, hit & known)
    weight = dr.select(hit & (colour.w > 0.5), target.w, 0)
    if excess is not None:
        pixel, known = excess.at(x, y)
        target += dr.gather(mi.Vector4f, excess.texels, pixel, hit & known)
    colour.w, target.w = 0, 0
    residual = dr.select(weight > 0, colour - target, 0)
    return residual, weight, found, (by_x * sheet.scale.x, by_y * sheet.scale.y)


def squares(seen, sheet, texture, frame, excess):
    """Squared residuals r^2 = |T - I|^2 / 3 of the pixels, and their weights; arguments as of
    :func:`residuals`.
    """
    residual, weight, *_ = residuals(seen, sheet, texture, frame, excess)
    return dr.squared_norm(residual) / 3, weight


def triangle_sums(seen, sheet, texture, frame, excess, scale):
    """Sums over the pixels that see each triangle, under the robust ``scale`` (Float): curvatures
    and slopes, Float of 27 F, and figures, Float of 4 F: energy, pixels, r^2 / (r^2 + scale^2) and
    the same with the fixed ``MISFIT``. Other arguments as of :func:`residuals`.

    The curvatures (xx, xy, yy) of each pair of ``CORNERS`` are in the image plane [1/pixel^2 of the
    grid], the slopes of each corner in space [1/m].
    """
    residual, weight, found, (by_x, by_y) = residuals(seen, sheet, texture, frame, excess)
    squared, c2 = dr.squared_norm(residual) / 3, scale * scale
    # the texture coordinate under a pixel moves against the triangle's plane, which slides along
    # the ray
    grad1, grad2, slide = found.plane()
    grad_x, grad_y = (
        found.c1.x * grad1 + found.c2.x * grad2,
        found.c1.y * grad1 + found.c2.y * grad2,
    )
    robust = 2 * weight / (3 * (1 + squared / c2))
    first, (xx, xy, yy) = mi.Vector3f(0), 3 * [mi.Float(0)]
    right, down = across(seen)
    for c in range(3):
        k = grad_x * by_x[c] + grad_y * by_y[c]
        g = slide * dr.dot(k, found.ray.d) - k
        first += residual[c] * g
        a, b = dr.dot(g, right), dr.dot(g, down)
        xx, xy, yy = xx + a * a, xy + a * b, yy + b * b
    first *= robust
    xx, xy, yy = (robust * x for x in (xx, xy, yy))
    figures = (
        weight * c2 * dr.log(1 + squared / c2),
        weight,
        weight * squared / (squared + c2),
        weight * squared / (squared + MISFIT**2),
    )
    return by_triangle(
        seen,
        sheet,
        (mi.Vector4f(xx, xy, yy, found.b1), mi.Vector4f(*first, found.b2), mi.Vector4f(*figures)),
    )


def by_triangle(seen, sheet, found):
    """Sums over the pixels that see each triangle: curvatures and slopes, Float of 27 F, and
    figures, Float of 4 F.

    ``found``: (xx, xy, yy, b1), (slope, b2) and the figures of each pixel, b1 and b2 its
    barycentric coordinates. A thread a triangle goes through the pixels of its box in the image and
    adds up those that see it, in their order: in a fraction of the time of atomic additions by the
    pixels, and always alike.
    """
    dr.eval(found)
    triangle = sheet.triangle
    (left, top, right, bottom), width = (
        _box(seen, sheet.corners(triangle)),
        mi.Int32(seen.region[2]),
    )
    columns = dr.maximum(right - left, 0)

    def add(x, y, missing, *before):
        pixel = mi.UInt32(y * width + x)
        mine = dr.gather(mi.Int32, seen.triangle, pixel) == mi.Int32(triangle)
        second, slope, figures = (
            mi.Vector4f(*(dr.gather(mi.Float, c, pixel, mine) for c in x)) for x in found
        )
        corner = 1 - second.w - slope.w, second.w, slope.w
        new = [
            corner[a] * corner[b] * z for a, b in CORNERS for z in (second.x, second.y, second.z)
        ]
        new += [b * z for b in corner for z in (slope.x, slope.y, slope.z)] + list(figures)
        last = x + 1 >= right
        return (
            dr.select(last, left, x + 1),
            dr.select(last, y + 1, y),
            missing - 1,
            *(a + b for a, b in zip(before, new)),
        )

    start = (
        left,
        top,
        columns * dr.maximum(bottom - top, 0),
        *(dr.zeros(mi.Float, dr.width(triangle)) for _ in range(CURVATURES + SLOPES + FIGURES)),
    )
    *total, a, b, c, d = dr.while_loop(
        start, lambda x, y, missing, *_: missing > 0, add, label="sums"
    )[3:]
    return packed(total, triangle), packed((a, b, c, d), triangle)


def _box(seen, corners):
    """(left, top, right, bottom) in the region, the last two excluded, of the pixels whose centres
    lie in the boxes of triangles with the vertices ``corners``; all of it where one is not before
    the camera."""
    point = [dr.gather(mi.Point3f, mi.Float(dr.ravel(seen.screen)), i) for i in corners]
    before = (point[0].z > 0) & (point[1].z > 0) & (point[2].z > 0)
    ends = []
    for axis in range(2):
        a, b, c = (p[axis] for p in point)
        low, high = dr.minimum(dr.minimum(a, b), c), dr.maximum(dr.maximum(a, b), c)
        first, size = mi.Float(seen.region[axis]) + 0.5, mi.Float(seen.region[2 + axis])
        start, end = (
            dr.ceil(low - _BOX_TOLERANCE - first),
            dr.floor(high + _BOX_TOLERANCE - first) + 1,
        )
        ends.append(
            [
                mi.Int32(dr.select(before, dr.clip(x, 0, size), all))
                for x, all in ((start, 0), (end, size))
            ]
        )
    (left, right), (top, bottom) = ends
    return left, top, right, bottom


def packed(columns, index):
    """Arrays of as many entries as ``index`` (0, 1, ...) side by side in one, row by row."""
    out = dr.empty(type(columns[0]), len(columns) * dr.width(index))
    for k, x in enumerate(columns):
        dr.scatter(out, x, index * len(columns) + k, mode=dr.ReduceMode.Permute)
    return out


def rendered(seen, sheet, texture, fine, lit):
    """The sheet as the camera has it before any blur: colour and, in the fourth channel, the light
    on it (0 where there is no sheet), Vector4f of n; and the ``texture``, an :class:`Image`, as
    :func:`residuals` takes it, likewise.

    ``fine``: the :class:`Image` that a pixel's footprint is averaged over; ``lit`` Float of F:
    light on the triangles.
    """
    hit, found = seen.hit, ray_hits(seen, sheet)
    template = texture.bilinear(found.at, hit)[0]
    grad1, grad2, slide = found.plane()
    footprint = []
    for pixel in across(seen):
        pixel -= found.ray.d * dr.dot(slide, pixel)
        step = (found.c1 * dr.dot(grad1, pixel) + found.c2 * dr.dot(grad2, pixel)) * sheet.scale
        footprint.append(step)
    colour = mi.Vector4f(0)
    for i in range(TAPS):
        for j in range(TAPS):
            a, b = ((k + 0.5) / TAPS - 0.5 for k in (i, j))
            colour += fine.bilinear(found.at + a * footprint[0] + b * footprint[1], hit)[0]
    colour /= TAPS**2
    colour.w = dr.select(hit, dr.gather(mi.Float, lit, found.triangle, hit), 0)
    return dr.select(hit, colour, 0), template


def silhouette_terms(seen, pairs, mask, distance, corner_of):
    """The silhouette against the mask, before its weight.

    ``pairs``: of :meth:`RasterIntegrator.crossings`; ``mask``: an :class:`Image` whose texels are
    of one channel, as is ``distance`` (Float) to the mask's contour [pixels of the grid];
    ``corner_of``: the template's vertex at each rendered one. Returns (alpha - mask)^2 - mask^2 of
    the region's pixels, and of each pair: the edge's ends (i, j) on the template, the derivatives
    ci and cj of the pixel's alpha by them [1/pixel of the grid], alpha less mask, and the share of
    the squares' curvature that counts: with it the curvature is that of the quadratic which has the
    term's slope here and its minimum at the mask's contour. A step then goes all the way, where
    plain Gauss-Newton, whose residuals are pixels, would go one pixel.
    """
    x, y = pixel_coordinates(seen)
    pixel, known = mask.at(x, y)
    wanted, alpha = (
        dr.gather(mi.Float, mask.texels, pixel, known),
        dr.select(seen.hit, mi.Float(1), 0),
    )
    if pairs is None:
        return dr.square(alpha - wanted) - dr.square(wanted), None
    alpha = mi.Float64(alpha)
    dr.eval(alpha, wanted, pixel, known)  # in one kernel, which reads what pixels see
    va, vb, near, far, horizontal = pairs
    ea, eb = point2(seen.screen, va), point2(seen.screen, vb)
    with dr.resume_grad():
        dr.enable_grad(ea, eb)
        to, other, weight, _ = blend(seen, ea, eb, near, far, horizontal)
        dr.backward(weight)
        weight, da, db = dr.detach(weight), dr.grad(ea), dr.grad(eb)
    step = mi.Float(dr.gather(mi.Float64, alpha, other) - dr.gather(mi.Float64, alpha, to))
    dr.scatter_add(alpha, mi.Float64(weight * step), to, mode=dr.ReduceMode.Local)
    alpha = mi.Float(alpha)
    excess = dr.gather(mi.Float, alpha - wanted, to)
    far = dr.select(
        dr.gather(mi.Bool, known, to),
        dr.gather(mi.Float, distance, dr.gather(mi.UInt32, pixel, to)),
        MAX_CONTOUR_DISTANCE,
    )
    ci, cj = da * step, db * step
    share = dr.rcp(dr.maximum(1, dr.norm(ci + cj) * dr.minimum(far, MAX_CONTOUR_DISTANCE)))
    ends = [dr.gather(mi.UInt32, corner_of, i) for i in (va, vb)]
    return dr.square(alpha - wanted) - dr.square(wanted), (*ends, ci, cj, excess, share)
