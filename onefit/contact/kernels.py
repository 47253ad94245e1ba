"""The Warp kernels of contact with the skin: each one compiled loop over points, on the CPU."""

from onefit.body.kernels import Surface, closest, wp

wp.set_module_options({"enable_backward": False})


@wp.func
def neighbour_mean(
    values: wp.array(dtype=wp.vec3), start: wp.array(dtype=int), other: wp.array(dtype=int), v: int
):
    """Of the neighbours of vertex ``v``, which are other[start[v]:start[v + 1]]."""
    mean = wp.vec3(0.0, 0.0, 0.0)
    for k in range(start[v], start[v + 1]):
        mean += values[other[k]]
    return mean / wp.max(float(start[v + 1] - start[v]), 1.0)


@wp.func
def _stopped(body: Surface, start: wp.vec3, end: wp.vec3, shortest: float, clearance: float):
    """Where a point that goes straight from ``start`` towards ``end`` is at the end of its way: in
    front of the body where it would enter it, if the way is not shorter than ``shortest``.
    """
    way, place = wp.length(end - start), end
    if way > shortest:
        along = (end - start) / way
        hit = wp.mesh_query_ray(body.mesh, start, along, way)
        if hit.result and wp.dot(hit.normal, along) < 0.0:
            place = start + hit.t * along + clearance * hit.normal
    return place


@wp.func
def pushed(
    body: Surface,
    point: wp.vec3,
    reach: float,
    near: float,  # what is nearer than this is pushed
    clearance: float,  # to so far from the body
):
    """(push, signed distance) of a point [m], the nearest face, -1 without one, and barycentric
    coordinates in it.
    """
    face, found = closest(body, point, reach)
    push = wp.vec3(0.0, 0.0, 0.0)
    if face >= 0 and found[6] < near:
        for k in range(3):
            push[k] = found[3 + k] + clearance * found[7 + k] - point[k]
    return push, found[6], face, wp.vec3(found[0], found[1], found[2])


@wp.kernel
def first_look(
    body: Surface,
    first: int,  # vertex
    thinnest: float,  # limb
    clearance: float,
    reach: float,
    goal: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=wp.vec3),
    push: wp.array(dtype=wp.vec3),
    known: wp.array(dtype=int),  # 1 where a vertex is pushed, 2 where it was inside
    touched: wp.array(dtype=int),  # the nearest face, -1 where none is within ``reach``
    at: wp.array(dtype=wp.vec3),  # barycentric coordinates in it
):
    """The vertices' part of :meth:`onefit.contact.SkinContact.look`."""
    v = first + wp.tid()
    push[v] = _stopped(body, goal[v], x[v], thinnest, clearance) - x[v]
    known[v] = wp.int32(wp.length_sq(push[v]) > 0.0)
    touched[v] = -1
    if known[v] == 0:
        p, d, face, b = pushed(body, x[v], reach, clearance, clearance)
        touched[v] = face
        at[v] = b
        push[v] = p
        known[v] = wp.int32(wp.length_sq(p) > 0.0) * wp.where(d < 0.0, 2, 1)


@wp.func
def weighted(
    values: wp.array(dtype=wp.vec3),
    corners: wp.array2d(dtype=int),
    weights: wp.array2d(dtype=float),
    s: int,
):
    """sum_i weights[s, i] values[corners[s, i]]."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(corners.shape[1]):
        total += weights[s, k] * values[corners[s, k]]
    return total


@wp.kernel
def points_looked_at(
    body: Surface,
    first: int,  # point
    near: float,  # a point that is nearer to the body is to be pushed
    clearance: float,  # to so far from it
    reach: float,
    x: wp.array(dtype=wp.vec3),
    corners: wp.array2d(dtype=int),  # points of large faces: sum_i weights[s, i] x[corners[s, i]]
    weights: wp.array2d(dtype=float),
    wanted: wp.array(dtype=wp.vec3),  # by how much a point is to be pushed
    gap: wp.array(dtype=float),  # its signed distance from the body, ``reach`` at most
    touched: wp.array(dtype=int),  # as first_look has them, below those of the vertices
    at: wp.array(dtype=wp.vec3),
):
    """The same of points of the faces."""
    s = first + wp.tid()
    p, d, face, b = pushed(body, weighted(x, corners, weights, s), reach, near, clearance)
    wanted[s] = p
    gap[s] = d
    touched[x.shape[0] + s] = face
    at[x.shape[0] + s] = b


@wp.kernel
def pushed_out(
    body: Surface,
    start: wp.array(dtype=int),  # the neighbours of vertex v are other[start[v]:start[v + 1]]
    other: wp.array(dtype=int),
    corners: wp.array2d(dtype=int),  # of points, as points_looked_at has them
    weights: wp.array2d(dtype=float),
    wanted: wp.array(dtype=wp.vec3),  # as points_looked_at says
    gap: wp.array(dtype=float),  # likewise; later at most the distance from the body
    rounds: int,
    smoothing: int,
    clearance: float,
    deepest: float,
    near: float,  # a point that is nearer is pushed
    face_clearance: float,  # to so far from the body
    face_reach: float,
    x: wp.array(dtype=wp.vec3),
    push: wp.array(dtype=wp.vec3),  # as first_look says
    known: wp.array(dtype=int),  # likewise; then > 0 where a vertex was asked deeply, or moved
    touched: wp.array(dtype=int),  # as first_look says
    at: wp.array(dtype=wp.vec3),  # likewise
    smooth: wp.array(dtype=wp.vec3),  # work
    queue: wp.array(dtype=int),  # work
):
    """See :meth:`onefit.contact.SkinContact.push_out`."""
    count = x.shape[0]
    last = wp.int32(0)
    for turn in range(rounds):
        some = wp.int32(0)
        if turn == 0:
            for v in range(count):
                some = wp.max(some, known[v])
                if known[v] == 2:
                    queue[last] = v
                    last += 1
        else:  # those that were pushed
            for i in range(last):
                v = queue[i]
                if wp.length(push[v]) < 0.02 * clearance:  # the rim of a smoothed push: not asked
                    push[v] = wp.vec3(0.0, 0.0, 0.0)
                else:
                    # no deeper than it was moved, for before it was outside, or to come there
                    far = wp.min(deepest, clearance + 2.0 * wp.length(push[v]))
                    p, d, face, b = pushed(body, x[v], far, 0.5 * clearance, clearance)
                    touched[v] = face
                    at[v] = b
                    push[v] = p
                    if wp.length_sq(p) > 0.0:
                        some = 1
            last = 0
        head = wp.int32(0)
        while head < last:  # what lies deeper, beside what was found inside
            v = queue[head]
            head += 1
            for k in range(start[v], start[v + 1]):
                n = other[k]
                if known[n] == 0:
                    known[n] = 1
                    p, d, face, b = pushed(body, x[n], deepest, clearance, clearance)
                    touched[n] = face
                    at[n] = b
                    push[n] = p
                    if d < 0.0:
                        queue[last] = n
                        last += 1
        for s in range(corners.shape[0]):
            p = wanted[s]
            if turn > 0:
                if gap[s] > near:
                    continue
                point = weighted(x, corners, weights, s)
                p, d, _f, _b = pushed(body, point, face_reach, near, face_clearance)
                gap[s] = d
            if wp.length_sq(p) > 0.0:
                some = 1
                for k in range(corners.shape[1]):
                    longer = wp.length_sq(p) > wp.length_sq(push[corners[s, k]])
                    if weights[s, k] > 0.0 and longer:
                        push[corners[s, k]] = p
        if some == 0:
            break
        last = wp.int32(0)
        for v in range(count):
            known[v] = wp.int32(wp.length_sq(push[v]) > 0.0)
            if known[v] > 0:
                queue[last] = v
                last += 1
        if turn == 0:
            for _s in range(smoothing):  # a ring of neighbours more in each
                inner = last + 0
                for i in range(inner):
                    for k in range(start[queue[i]], start[queue[i] + 1]):
                        if known[other[k]] == 0:
                            known[other[k]] = 1
                            queue[last] = other[k]
                            last += 1
                for i in range(last):
                    v = queue[i]
                    mean = neighbour_mean(push, start, other, v)
                    longer = wp.length_sq(push[v]) > wp.length_sq(mean)
                    smooth[v] = wp.where(longer, push[v], mean)
                for i in range(last):
                    push[queue[i]] = smooth[queue[i]]
        for i in range(last):
            x[queue[i]] = x[queue[i]] + push[queue[i]]
        for s in range(corners.shape[0]):  # what is moved comes nearer by no more than its way
            gap[s] = gap[s] - wp.length(weighted(push, corners, weights, s))
    for i in range(last):  # between two skins, as in the crease of an armpit: to the middle
        v = queue[i]
        far = wp.length(push[v]) + clearance
        p, d, face, b = pushed(body, x[v], far, 0.0, clearance)
        if wp.length_sq(p) > 0.0:
            push[v] = push[v] + 0.5 * p
            x[v] = x[v] + 0.5 * p


@wp.kernel
def planes(
    body: Surface,
    before: wp.array(dtype=wp.vec3),  # where the body's vertices were
    clearance: float,
    touched: wp.array(dtype=int),
    at: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    offset: wp.array(dtype=float),
    moved: wp.array(dtype=wp.vec3),
):
    """See :meth:`onefit.contact.SkinContact.follow`."""
    i = wp.tid()
    face, b = touched[i], at[i]
    if face >= 0:
        place = wp.mesh_eval_position(body.mesh, face, b[0], b[1])
        was = wp.vec3(0.0, 0.0, 0.0)
        for k in range(3):
            was += b[k] * before[wp.mesh_get_index(body.mesh, 3 * face + k)]
        n = wp.mesh_eval_face_normal(body.mesh, face)
        normal[i] = n
        offset[i] = wp.dot(n, place) + clearance
        moved[i] = place - was
