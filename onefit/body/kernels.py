"""Warp kernels of :mod:`onefit.body.nearest`; for other kernels, what they ask of a mesh."""

from .quietwarp import warp as ready

wp = ready()

EDGE_TOLERANCE = wp.constant(1e-5)  # barycentric coordinates below it are on an edge
row = wp.types.vector(
    length=10, dtype=float
)  # barycentric coordinates, point, distance [m], normal


@wp.struct
class Surface:
    """A closed mesh, as Warp knows it, and its faces around each vertex: corner ``around[j]`` % 3
    of face ``around[j]`` // 3 is vertex v, for j from ``first[v]`` to ``first[v + 1]`` - 1.
    """

    mesh: wp.uint64
    first: wp.array(dtype=int)
    around: wp.array(dtype=int)


@wp.func
def pseudonormal(surface: Surface, face: int, b: wp.vec3):
    """The unit pseudonormal at the point of a face with barycentric coordinates ``b``."""
    mesh = surface.mesh
    most = 0
    for k in range(3):
        if b[k] > b[most]:
            most = k
    one, two = (most + 1) % 3, (most + 2) % 3
    normal = wp.mesh_eval_face_normal(mesh, face)
    if wp.min(b[one], b[two]) < EDGE_TOLERANCE:
        on_vertex = wp.max(b[one], b[two]) < EDGE_TOLERANCE
        v = wp.mesh_get_index(mesh, 3 * face + most)
        other = wp.mesh_get_index(mesh, 3 * face + wp.where(b[one] > b[two], one, two))
        points = wp.mesh_get(mesh).points
        normal = wp.vec3(0.0, 0.0, 0.0)
        for j in range(surface.first[v], surface.first[v + 1]):
            f, k = surface.around[j] // 3, surface.around[j] % 3
            p, q = (
                wp.mesh_get_index(mesh, 3 * f + (k + 1) % 3),
                wp.mesh_get_index(mesh, 3 * f + (k + 2) % 3),
            )
            weight = 0.0
            if on_vertex:
                weight = wp.acos(
                    wp.dot(wp.normalize(points[p] - points[v]), wp.normalize(points[q] - points[v]))
                )
            elif p == other or q == other:
                weight = 1.0
            normal += weight * wp.mesh_eval_face_normal(mesh, f)
    return wp.normalize(normal)


@wp.func
def closest(surface: Surface, point: wp.vec3, reach: float):
    """(face, row) of the surface's point nearest to ``point``, no farther than ``reach`` [m]; the
    face is -1 without one.
    """
    query = wp.mesh_query_point_no_sign(surface.mesh, point, reach)
    face = wp.int32(-1)
    found = row()
    found[6] = reach
    if query.result:
        face = query.face
        b = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
        at = wp.mesh_eval_position(surface.mesh, query.face, query.u, query.v)
        normal = pseudonormal(surface, query.face, b)
        away = point - at
        for k in range(3):
            found[k] = b[k]
            found[3 + k] = at[k]
            found[7 + k] = normal[k]
        found[6] = wp.length(away) * wp.where(wp.dot(away, normal) < 0.0, -1.0, 1.0)
    return face, found


@wp.kernel
def nearest(
    surface: Surface,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    face: wp.array(dtype=int),
    found: wp.array(dtype=row),  # comes filled with NaN
):
    i = wp.tid()
    at, what = closest(surface, points[i], reach)
    face[i] = at
    if at < 0:
        found[i][6] = reach
    else:
        found[i] = what
