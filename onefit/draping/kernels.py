"""The Warp kernels of post-processing: each one compiled loop over a frame, on the CPU."""

from onefit.body.kernels import Surface, wp
from onefit.contact import neighbour_mean

wp.set_module_options({"enable_backward": False})


@wp.kernel
def moved(
    x: wp.array(dtype=wp.vec3),  # where the cloth is drawn to; then where it is
    before: wp.array(dtype=wp.vec3),  # a step ago
    was: wp.array(dtype=wp.vec3),  # two steps ago
    pull: wp.array(dtype=float),
    drag: float,
    dt: float,
    start: wp.array(dtype=int),
    other: wp.array(dtype=int),
    smoothing: int,
    away: wp.array(dtype=wp.vec3),  # work
    smooth: wp.array(dtype=wp.vec3),  # work
):
    """See :meth:`onefit.draping.post.PostProcessing.move`."""
    for v in range(x.shape[0]):
        way = before[v] - was[v]
        away[v] = before[v] + way / (1.0 + drag * wp.length(way)) - x[v]
    for _s in range(smoothing):
        for v in range(x.shape[0]):
            smooth[v] = 0.5 * (away[v] + neighbour_mean(away, start, other, v))
        for v in range(x.shape[0]):
            away[v] = smooth[v]
    for v in range(x.shape[0]):
        x[v] = x[v] + away[v] / (1.0 + pull[v] * dt * dt)


@wp.kernel
def lengths_restored(
    edges: wp.array(dtype=wp.vec2i),
    squares: wp.array(dtype=float),  # of their lengths at rest [m^2]
    degree: wp.array(dtype=float),  # edges at each vertex, at least 1
    rounds: int,
    radius: float,
    clearance: float,
    farthest: float,  # from the place that it touched, that a vertex is held in front of it
    body: Surface,
    touched: wp.array(dtype=int),  # the body's face in front of which a vertex stays; -1: none
    at: wp.array(dtype=wp.vec3),  # barycentric coordinates of the place in it
    x: wp.array(dtype=wp.vec3),
    old: wp.array(dtype=wp.vec3),  # work: the vertices a round ago
    pull: wp.array(dtype=wp.vec3),  # work
    normal: wp.array(dtype=wp.vec3),  # work: of the body's face
    height: wp.array(dtype=float),  # work: the vertex' least, along the normal
):
    """Iterations of Jacobi's method for the sum of (|e| - length)^2 [m^2], accelerated by
    Chebyshev's polynomials; (|e|^2 - length^2) / (|e|^2 + length^2) stands for 1 - length / |e|.
    After each, a vertex that would come nearer than ``clearance`` to the plane of the face that it
    touches is put there.

    Wang 2015, "A Chebyshev semi-iterative approach for accelerating projective and position-based
    dynamics"; ``radius``: what it takes a round's spectral radius to be.
    """
    ahead = wp.float32(1.0)
    for v in range(x.shape[0]):
        old[v] = x[v]
        pull[v] = wp.vec3(0.0, 0.0, 0.0)
        if touched[v] >= 0:
            n = wp.mesh_eval_face_normal(body.mesh, touched[v])
            place = wp.mesh_eval_position(body.mesh, touched[v], at[v][0], at[v][1])
            normal[v] = n
            height[v] = wp.dot(n, place) + clearance
            if wp.length(x[v] - place) > farthest:
                touched[v] = -1
    for turn in range(rounds):
        for e in range(edges.shape[0]):
            ends = edges[e]
            edge = x[ends[1]] - x[ends[0]]
            now, rest = wp.length_sq(edge), squares[e]
            p = (now - rest) / (now + rest) * edge
            pull[ends[0]] = pull[ends[0]] + p
            pull[ends[1]] = pull[ends[1]] - p
        if turn == 1:
            ahead = 1.0 / (1.0 - 0.5 * radius * radius)
        if turn > 1:
            ahead = 1.0 / (1.0 - 0.25 * radius * radius * ahead)
        for v in range(x.shape[0]):
            here = x[v]
            there = old[v] + ahead * (here + pull[v] / degree[v] - old[v])
            if touched[v] >= 0:
                there += wp.max(height[v] - wp.dot(normal[v], there), 0.0) * normal[v]
            x[v] = there
            old[v] = here
            pull[v] = wp.vec3(0.0, 0.0, 0.0)
