"""Warp kernels that find where a sheet lies near to itself."""

from onefit.body.quietwarp import warp as ready

wp = ready()
wp.set_module_options({"enable_backward": False})


@wp.struct
class Layers:
    """A sheet: its vertices at ``x`` (N,) [m], which go a ``way`` (N,) [m] in the step; the
    hierarchy ``tree`` of the boxes in which its ``faces`` (F, 3) do so; where the vertices are at
    ``rest``, and how far ``along`` (N,) [m] the sheet from four vertices far from each other; the
    ends of its ``edges`` (E, 2), the edges of each face ``edges_of`` (F, 3), and the first face of
    each edge, its ``owner`` (E,).
    """

    tree: wp.uint64
    faces: wp.array2d(dtype=int)
    x: wp.array(dtype=wp.vec3)
    way: wp.array(dtype=wp.vec3)
    rest: wp.array(dtype=wp.vec3)
    along: wp.array(dtype=wp.vec4)
    edges: wp.array2d(dtype=int)
    edges_of: wp.array2d(dtype=int)
    owner: wp.array(dtype=int)


@wp.struct
class Found:
    """Pairs: how many so far (``count``), and, of as many as there is room for, ``corners`` and
    ``weights`` (P, 4) of the vector sum_i w_i x_i from one to the other, and its direction, the
    ``normal``.
    """

    count: wp.array(dtype=int)
    corners: wp.array2d(dtype=int)
    weights: wp.array2d(dtype=float)
    normal: wp.array(dtype=wp.vec3)


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


@wp.func
def _keep(found: Found, corners: wp.vec4i, weights: wp.vec4, normal: wp.vec3):
    at = wp.atomic_add(found.count, 0, 1)
    if at < found.corners.shape[0]:
        found.normal[at] = normal
        for k in range(4):
            found.corners[at, k] = corners[k]
            found.weights[at, k] = weights[k]


@wp.func
def _is_layer(away: wp.vec3, way: wp.vec3, at_rest: wp.vec3, along: wp.vec4, neighbourhood: float):
    """Whether two points that lie ``away`` from each other, and go a ``way`` against each other,
    are of two layers that meet: half as far from each other as at rest, or less. There they are as
    far from each other as ``at_rest`` says, or, as two thighs of trousers, farther along the sheet:
    at least by the difference of what they are ``along`` it from a third. What is as near at rest
    as layers are held (a hem turned in) stays as it is.
    """
    distance, apart = wp.length(away), wp.length(at_rest)
    farther = wp.max(apart, wp.max(wp.max(along), -wp.min(along)))
    if distance == 0.0 or apart <= 0.5 * neighbourhood:
        return False
    if farther <= wp.max(2.0 * distance, neighbourhood):
        return False
    return distance + wp.min(wp.dot(way, away) / distance, 0.0) < neighbourhood


@wp.kernel
def boxes(layers: Layers, lower: wp.array(dtype=wp.vec3), upper: wp.array(dtype=wp.vec3)):
    """The corners of the boxes (F,) in which the faces are in the step."""
    f = wp.tid()
    a, b, c = layers.faces[f, 0], layers.faces[f, 1], layers.faces[f, 2]
    x, w = layers.x, layers.way
    low, high = wp.min(x[a], wp.min(x[b], x[c])), wp.max(x[a], wp.max(x[b], x[c]))
    p, q, r = x[a] + w[a], x[b] + w[b], x[c] + w[c]
    lower[f] = wp.min(low, wp.min(p, wp.min(q, r)))
    upper[f] = wp.max(high, wp.max(p, wp.max(q, r)))


@wp.kernel
def vertices_near(
    first: int,
    layers: Layers,
    neighbourhood: float,  # [m]; what is nearer at rest is no other layer, what comes nearer meets
    layered: wp.array(dtype=int),  # receives 1 where a layer meets the vertex
    found: Found,
):
    """For each vertex from ``first`` on the triangles of other layers that meet it: those that it
    stands above, and the nearest one.
    """
    i = first + wp.tid()
    p, q, w = layers.x[i], layers.rest[i], layers.way[i]
    box = wp.vec3(neighbourhood, neighbourhood, neighbourhood)
    query = wp.bvh_query_aabb(layers.tree, wp.min(p, p + w) - box, wp.max(p, p + w) + box)
    nearest = wp.float32(1.0e9)
    corners, weights, normal = wp.vec4i(), wp.vec4(), wp.vec3()
    inner = int(0)  # noqa: RUF046, UP018 - a variable to Warp
    layered[i] = 0
    f = int(0)  # noqa: RUF046, UP018
    while wp.bvh_query_next(query, f):
        a, b, c = layers.faces[f, 0], layers.faces[f, 1], layers.faces[f, 2]
        if i != a and i != b and i != c:
            x = layers.x
            on = _closest_on_triangle(p, x[a], x[b], x[c])
            away = p - (on[0] * x[a] + on[1] * x[b] + on[2] * x[c])
            distance = wp.length(away)
            r, s = layers.rest, layers.along
            at_rest = q - (on[0] * r[a] + on[1] * r[b] + on[2] * r[c])
            along = s[i] - (on[0] * s[a] + on[1] * s[b] + on[2] * s[c])
            v = layers.way
            against = w - (on[0] * v[a] + on[1] * v[b] + on[2] * v[c])
            if _is_layer(away, against, at_rest, along, neighbourhood):
                layered[i] = 1
                is_inner = wp.min(on[0], wp.min(on[1], on[2])) > 0.0
                if is_inner:
                    _keep(
                        found,
                        wp.vec4i(i, a, b, c),
                        wp.vec4(1.0, -on[0], -on[1], -on[2]),
                        away / distance,
                    )
                if distance < nearest:
                    nearest = distance
                    inner = wp.where(is_inner, 1, 0)
                    corners = wp.vec4i(i, a, b, c)
                    weights = wp.vec4(1.0, -on[0], -on[1], -on[2])
                    normal = away / distance
    if layered[i] == 1 and inner == 0:
        _keep(found, corners, weights, normal)


@wp.func
def _edge_pair(layers: Layers, e: int, g: int, neighbourhood: float, found: Found):
    """Keeps the edges e and g, the lower number first, if they are a pair (nearest points: Ericson
    2005, section 5.1.9).
    """
    one, two = wp.min(e, g), wp.max(e, g)
    i, j = layers.edges[one, 0], layers.edges[one, 1]
    m, n = layers.edges[two, 0], layers.edges[two, 1]
    has_no_common_end = i != m and i != n and j != m and j != n
    if not has_no_common_end:
        return
    x, r = layers.x, layers.rest
    along, other, between = x[j] - x[i], x[n] - x[m], x[i] - x[m]
    aa, bb, ab = wp.dot(along, along), wp.dot(other, other), wp.dot(along, other)
    ca, cb = wp.dot(along, between), wp.dot(other, between)
    det = aa * bb - ab * ab
    if det > 1.0e-6 * aa * bb:
        s, t = (ab * cb - ca * bb) / det, (aa * cb - ab * ca) / det
        if wp.min(s, t) > 0.0 and wp.max(s, t) < 1.0:
            away = between + s * along - t * other
            distance = wp.length(away)
            at_rest = (1.0 - s) * r[i] + s * r[j] - (1.0 - t) * r[m] - t * r[n]
            w, u = layers.way, layers.along
            against = (1.0 - s) * w[i] + s * w[j] - (1.0 - t) * w[m] - t * w[n]
            differ = (1.0 - s) * u[i] + s * u[j] - (1.0 - t) * u[m] - t * u[n]
            if _is_layer(away, against, at_rest, differ, neighbourhood):
                _keep(
                    found,
                    wp.vec4i(i, j, m, n),
                    wp.vec4(1.0 - s, s, t - 1.0, -t),
                    away / distance,
                )


@wp.kernel
def edges_that_look(
    layers: Layers,
    neighbourhood: float,
    layered: wp.array(dtype=int),  # as :func:`vertices_near` leaves it
    looks: wp.array(dtype=int),  # receives 1 for each edge that looks for others
):
    """An edge looks for others if a layer meets one of its ends, or it is so long that one may
    meet its middle alone.
    """
    e = wp.tid()
    i, j = layers.edges[e, 0], layers.edges[e, 1]
    goes = wp.max(wp.length(layers.way[i]), wp.length(layers.way[j]))
    is_long = wp.length(layers.rest[i] - layers.rest[j]) > 2.0 * (neighbourhood + goes)
    looks[e] = wp.where(is_long or layered[i] + layered[j] > 0, 1, 0)


@wp.kernel
def edges_near(
    first: int,
    layers: Layers,
    neighbourhood: float,
    looks: wp.array(dtype=int),  # as :func:`edges_that_look` leaves it
    found: Found,
):
    """For each edge from ``first`` on that looks for others the edges of layers that meet it, where
    both are nearest to each other between their ends.
    """
    e = first + wp.tid()
    if looks[e] == 0:
        return
    i, j = layers.edges[e, 0], layers.edges[e, 1]
    a, b = layers.x[i], layers.x[j]
    p, q = a + layers.way[i], b + layers.way[j]
    box = wp.vec3(neighbourhood, neighbourhood, neighbourhood)
    low, high = wp.min(wp.min(a, b), wp.min(p, q)), wp.max(wp.max(a, b), wp.max(p, q))
    query = wp.bvh_query_aabb(layers.tree, low - box, high + box)
    f = int(0)  # noqa: RUF046, UP018
    while wp.bvh_query_next(query, f):
        for k in range(3):
            g = layers.edges_of[f, k]
            # each pair once
            if layers.owner[g] == f and (looks[g] == 0 or g > e):
                _edge_pair(layers, e, g, neighbourhood, found)
