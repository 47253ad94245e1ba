"""Warp kernels of cloth that meets itself: which vertices and edges are near to another layer. On
the CPU each is one compiled loop.
"""

from onefit.body.quietwarp import warp as ready

wp = ready()
wp.set_module_options({"enable_backward": False})


@wp.func
def _closest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentric coordinates of the nearest point (Ericson 2005, section 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = wp.dot(ab, ap), wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0)
    bp = p - b
    d3, d4 = wp.dot(ab, bp), wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(0.0, 1.0, 0.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return wp.vec3(1.0 - v, v, 0.0)
    cp = p - c
    d5, d6 = wp.dot(ab, cp), wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 0.0, 1.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return wp.vec3(1.0 - w, 0.0, w)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3(0.0, 1.0 - w, w)
    v = vb / (va + vb + vc)
    w = vc / (va + vb + vc)
    return wp.vec3(1.0 - v - w, v, w)


@wp.kernel
def proximity(
    mesh: wp.uint64,  # of the vertices x
    x: wp.array(dtype=wp.vec3),
    rest: wp.array(dtype=wp.vec3),
    reach: float,
    first: int,  # vertex that is asked
    face: wp.array(dtype=int),  # receives the nearest face within reach of another layer, or -1
    found: wp.array(dtype=wp.vec3),  # receives its barycentric coordinates
    normal: wp.array(dtype=wp.vec3),  # receives the direction in which the vertex must stay away
):
    """For each vertex of the sheet the nearest triangle of another layer within ``reach``: one that
    is no farther than half of what its nearest corner is at rest.
    """
    i = first + wp.tid()
    p = x[i]
    face[i] = -1
    closest = reach * reach
    around = wp.vec3(reach, reach, reach)
    query = wp.mesh_query_aabb(mesh, p - around, p + around)
    f = int(0)  # noqa: RUF046, UP018 - a variable to Warp
    while wp.mesh_query_aabb_next(query, f):
        a = wp.mesh_get_index(mesh, 3 * f)
        b = wp.mesh_get_index(mesh, 3 * f + 1)
        c = wp.mesh_get_index(mesh, 3 * f + 2)
        beside = wp.min(
            wp.length_sq(rest[a] - rest[i]),
            wp.min(wp.length_sq(rest[b] - rest[i]), wp.length_sq(rest[c] - rest[i])),
        )
        near = _closest_on_triangle(p, x[a], x[b], x[c])
        away = p - (near[0] * x[a] + near[1] * x[b] + near[2] * x[c])
        if wp.length_sq(away) < wp.min(closest, 0.25 * beside):
            closest = wp.length_sq(away)
            face[i] = f
            normal[i] = wp.normalize(away)
            found[i] = near


@wp.func
def _closest_of_edges(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3):
    """Shares (s, t) of the edges ab and cd at which the lines through them are nearest, (-1, -1)
    where they are parallel (Ericson 2005, section 5.1.8).
    """
    one, two, between = b - a, d - c, a - c
    oo, tt, ot = wp.length_sq(one), wp.length_sq(two), wp.dot(one, two)
    across = oo * tt - ot * ot
    nearest = wp.vec2(-1.0, -1.0)
    if across > 1e-4 * oo * tt:
        ob, tb = wp.dot(one, between), wp.dot(two, between)
        nearest = wp.vec2((ot * tb - tt * ob) / across, (oo * tb - ot * ob) / across)
    return nearest


@wp.kernel
def edge_proximity(
    mesh: wp.uint64,  # of the vertices x
    x: wp.array(dtype=wp.vec3),
    rest: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=wp.vec2i),
    reach: float,
    other: wp.array(dtype=wp.vec2i),  # receives the nearest edge within reach, or (-1, -1)
    found: wp.array(dtype=wp.vec2),  # receives where on both, as shares
    normal: wp.array(dtype=wp.vec3),  # receives the direction in which the edge must stay away
):
    """As :func:`proximity`, for edges that are nearest to each other between their ends."""
    e = wp.tid()
    i, j = edges[e][0], edges[e][1]
    a, b = x[i], x[j]
    other[e] = wp.vec2i(-1, -1)
    closest = reach * reach
    around = wp.vec3(reach, reach, reach)
    query = wp.mesh_query_aabb(mesh, wp.min(a, b) - around, wp.max(a, b) + around)
    f = int(0)  # noqa: RUF046, UP018 - a variable to Warp
    while wp.mesh_query_aabb_next(query, f):
        for k in range(3):
            m = wp.mesh_get_index(mesh, 3 * f + k)
            n = wp.mesh_get_index(mesh, 3 * f + (k + 1) % 3)
            at = _closest_of_edges(a, b, x[m], x[n])
            if wp.min(at[0], at[1]) > 0.0 and wp.max(at[0], at[1]) < 1.0:
                away = a + at[0] * (b - a) - x[m] - at[1] * (x[n] - x[m])
                beside = wp.min(
                    wp.min(wp.length_sq(rest[m] - rest[i]), wp.length_sq(rest[m] - rest[j])),
                    wp.min(wp.length_sq(rest[n] - rest[i]), wp.length_sq(rest[n] - rest[j])),
                )
                if wp.length_sq(away) < wp.min(closest, 0.25 * beside):
                    closest = wp.length_sq(away)
                    other[e] = wp.vec2i(m, n)
                    found[e] = at
                    normal[e] = wp.normalize(away)
