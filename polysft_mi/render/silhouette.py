"""The silhouette edges between neighbouring pixel centres, and how they blend the two colours.

Where two neighbouring pixels see different sheets, the edge between their centres is found by
walking over the mesh from the nearer one (after Laine et al. 2020, "Modular Primitives for
High-Performance Differentiable Rendering", section 3.5; here the edge need not belong to the
triangles seen at the two centres). Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi

from .pinhole import MIN_DEPTH
from .view import centre, point2

# pixels by which an edge through a centre may pass it: the ray and the projection round differently
_TOLERANCE = 1e-3
_MAX_STEPS = 64  # triangles crossed between two neighbouring pixel centres before the walk gives up


def crossings(topology, view, outline=False):
    """The silhouette edges that run between neighbouring pixel centres of a
    :class:`~polysft_mi.render.view.View`:
        detached (va, vb, near, far, horizontal), None where there are none. With ``outline`` only
        those of which one centre sees no sheet at all.

        Vertices of each edge, the region's pixel whose sheet ends there, the other pixel, and
        whether the two lie side by side.
    """
    (x0, y0, w_, _), (w, h) = view.region, view.size
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
        found, va, vb, near, far = _silhouette(
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


def blend(seen, ea, eb, near, far, horizontal):
    """How an edge between two pixel centres blends them: (pixel that changes, pixel whose colour
    comes in, its weight, where the edge crosses).

    ``ea``, ``eb``: the edge's ends [pixels], attached; the weight and the place are.
    """
    x0, y0, w_, _ = seen.region
    cn, cf = (centre(i, x0, y0, w_) for i in (near, far))
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


def _silhouette(topology, screen, triangle, near, far, x0, y0, w, horizontal):
    """Vertices (va, vb) of the silhouette edge between the centres of two pixels, and which
    pixel it occludes.

    Walks from the near pixel's triangle towards the far centre; where that sheet has no
    silhouette in between, from the far one's.
    """
    found, va, vb, last = _walk(topology, screen, triangle, near, far, x0, y0, w, mi.Bool(True))
    beyond = dr.gather(mi.Int32, triangle, far)
    again = ~found & (beyond >= 0) & (last != beyond)  # else the two centres lie on one sheet
    found2, va2, vb2, _ = _walk(topology, screen, triangle, far, near, x0, y0, w, again)
    near, far = dr.select(found2, far, near), dr.select(found2, near, far)
    va, vb, found = dr.select(found2, va2, va), dr.select(found2, vb2, vb), found | found2
    edge = point2(screen, vb, found) - point2(screen, va, found)
    return found & (dr.select(horizontal, edge.y, edge.x) != 0), va, vb, near, far


def _walk(topology, screen, triangle, start, end, x0, y0, w, active):
    """From the triangle seen at pixel ``start`` over the sheet towards the centre of ``end``:
    whether a silhouette edge comes before that centre, its vertices, and the last triangle
    reached."""
    c0, c1 = centre(start, x0, y0, w), centre(end, x0, y0, w)

    def corners(t, mask):
        return [dr.gather(mi.UInt32, topology.faces, 3 * mi.UInt32(t) + k, mask) for k in range(3)]

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
        usable = (dr.minimum(dr.minimum(p[0].z, p[1].z), p[2].z) > MIN_DEPTH) & (sign != 0)
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
    _, last, found, va, vb, _ = dr.while_loop(state, lambda active, *_: active, step, label="walk")
    return found, va, vb, last


def _cross2(a, b):
    return a.x * b.y - a.y * b.x
