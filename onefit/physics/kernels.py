"""Warp kernels of the implicit step: gradient and Hessian of a sheet's energies. On the CPU each is
one compiled loop.

Matrices have 3 x 3 blocks, at the diagonal and where two vertices share an edge. Double precision:
in single precision the rounding of a coordinate of 1 m is a strain of 1e-5.
"""

import numpy as np

from onefit.body.quietwarp import warp as ready

wp = ready()

real = wp.float64
vec2 = wp.types.vector(length=2, dtype=real)
vec3 = wp.types.vector(length=3, dtype=real)
_mat2 = wp.types.matrix(shape=(2, 2), dtype=real)
mat3 = wp.types.matrix(shape=(3, 3), dtype=real)
_mat32 = wp.types.matrix(shape=(3, 2), dtype=real)
_mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
wp.set_module_options({"enable_backward": False})


def ints(a):
    """``a``, an array of whole numbers, for kernels."""
    return wp.array(np.ascontiguousarray(a, dtype=np.int32), dtype=int, device="cpu")


def reals(a, dtype=real):
    """``a``, an array of numbers, for kernels: of vectors or matrices by their ``dtype``."""
    return wp.array(np.ascontiguousarray(a, dtype=np.float64), dtype=dtype, device="cpu")


@wp.kernel
def stretching(
    first: int,  # face
    x: wp.array(dtype=vec3),
    faces: wp.array2d(dtype=int),
    gradients: wp.array2d(dtype=vec2),
    weight: wp.array(dtype=real),  # stretch * area [N m]
    blocks: wp.array2d(dtype=int),  # (F, 9): where the blocks of the corners' pairs lie
    force: wp.array(dtype=vec3),  # receives the gradient
    matrix: wp.array(dtype=mat3),  # receives the Hessian, its negative eigenvalues set to 0
):
    """stretch / 2 * area * |F - R|^2: gradient weight (F - R) g_a; Hessian by the modes of F.

    With F = R S, S = sum_i s_i v_i v_i^T and n the normal: in the plane all modes have 1, but the
    rotation of F in its plane 1 - 2 / (s_1 + s_2); out of it 1 - 1 / s_i.
    """
    f = first + wp.tid()
    one, two, half = real(1.0), real(2.0), real(0.5)
    F = _mat32()
    for a in range(3):
        F += wp.outer(x[faces[f, a]], gradients[f, a])
    C = wp.transpose(F) * F
    det = wp.sqrt(wp.max(C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1], real(1.0e-12)))
    trace = wp.sqrt(C[0, 0] + C[1, 1] + two * det)  # s_1 + s_2
    S = (C + det * _mat2(one, real(0.0), real(0.0), one)) / trace
    inverse = _mat2(S[1, 1], -S[0, 1], -S[0, 1], S[0, 0]) / det
    R = F * inverse
    r0 = vec3(R[0, 0], R[1, 0], R[2, 0])
    r1 = vec3(R[0, 1], R[1, 1], R[2, 1])
    n = wp.cross(r0, r1)
    twist = wp.min(one, two / trace)
    # G = sum_i max(1 - 1 / s_i, 0) v_i v_i^T
    middle = half * trace
    apart = wp.sqrt(wp.max(middle * middle - det, real(0.0)))
    g1 = wp.max(one - one / (middle + apart), real(0.0))
    g2 = wp.max(one - one / wp.max(middle - apart, real(1.0e-6)), real(0.0))
    G = half * (g1 + g2) * _mat2(one, real(0.0), real(0.0), one)
    if apart > real(1.0e-9):
        G = G + (g1 - g2) / (two * apart) * (S - middle * _mat2(one, real(0.0), real(0.0), one))
    w = weight[f]
    P = F - R
    nn = wp.outer(n, n)
    inside = mat3(one, real(0.0), real(0.0), real(0.0), one, real(0.0), real(0.0), real(0.0), one)
    inside = inside - nn
    for a in range(3):
        ga = gradients[f, a]
        force[faces[f, a]] += w * (P * ga)
        ta = r1 * ga[0] - r0 * ga[1]
        for b in range(3):
            gb = gradients[f, b]
            tb = r1 * gb[0] - r0 * gb[1]
            block = wp.dot(ga, gb) * inside + wp.dot(ga, G * gb) * nn
            matrix[blocks[f, 3 * a + b]] += w * (block - half * twist * wp.outer(ta, tb))


@wp.func
def _angle_between(one: vec3, two: vec3, edge: vec3):
    return wp.atan2(wp.dot(wp.cross(one, two), edge), wp.dot(one, two))


@wp.kernel
def bending(
    first: int,  # hinge
    x: wp.array(dtype=vec3),
    hinges: wp.array2d(dtype=int),
    angles: wp.array(dtype=real),
    stiffness: wp.array(dtype=real),
    blocks: wp.array2d(dtype=int),  # (H, 14): (i, i), then both ways 01, 02, 03, 12, 13
    force: wp.array(dtype=vec3),
    matrix: wp.array(dtype=mat3),
):
    """Gradient of stiffness / 2 (angle - rest)^2, and its Gauss-Newton matrix u u^T. The opposite
    corners share no edge: 2 (u_2 x_2)(u_3 x_3) there is replaced by (u_2 x_2)^2 + (u_3 x_3)^2,
    which is never less, and almost the same where both move alike.
    """
    h = first + wp.tid()
    x0, x1 = x[hinges[h, 0]], x[hinges[h, 1]]
    x2, x3 = x[hinges[h, 2]], x[hinges[h, 3]]
    e = x1 - x0
    length = wp.length(e)
    edge = e / length
    one, two = wp.cross(e, x2 - x0), wp.cross(x3 - x0, e)
    turned = _angle_between(one, two, edge) - angles[h]
    if turned > real(3.141592653589793):
        turned -= real(6.283185307179586)
    if turned < real(-3.141592653589793):
        turned += real(6.283185307179586)
    k = stiffness[h]
    least = real(1.0e-16)
    a = one / wp.max(wp.dot(one, one), least)
    b = two / wp.max(wp.dot(two, two), least)
    u = _mat43()
    u[0] = -(wp.dot(x2 - x1, edge) * a + wp.dot(x3 - x1, edge) * b)
    u[1] = wp.dot(x2 - x0, edge) * a + wp.dot(x3 - x0, edge) * b
    u[2] = -length * a
    u[3] = -length * b
    for i in range(4):
        force[hinges[h, i]] += k * turned * u[i]
        factor = k
        if i > 1:
            factor = real(2.0) * k
        matrix[blocks[h, i]] += factor * wp.outer(u[i], u[i])
    at = int(4)  # noqa: RUF046, UP018 - a variable to Warp
    for i in range(2):
        for j in range(i + 1, 4):
            matrix[blocks[h, at]] += k * wp.outer(u[i], u[j])
            matrix[blocks[h, at + 1]] += k * wp.outer(u[j], u[i])
            at += 2


@wp.kernel
def drag(
    first: int,  # face
    x: wp.array(dtype=vec3),
    before: wp.array(dtype=vec3),
    velocity: wp.array(dtype=vec3),  # at the start of the step [m/s]
    faces: wp.array2d(dtype=int),
    coefficient: wp.array(dtype=real),  # (F,): drag * density of the air / 2 [kg/m^3]
    dt: real,
    blocks: wp.array2d(dtype=int),
    force: wp.array(dtype=vec3),
    matrix: wp.array(dtype=mat3),
):
    """The air's drag normal to each triangle, coefficient * area * |v.n| v.n n, with |v.n| of the
    start of the step.
    """
    f = first + wp.tid()
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    normal = wp.cross(x[b] - x[a], x[c] - x[a])
    double = wp.length(normal)
    n = normal / wp.max(double, real(1.0e-12))
    third = real(1.0) / real(3.0)
    speed = third * wp.abs(wp.dot(velocity[a] + velocity[b] + velocity[c], n))
    k = coefficient[f] * real(0.5) * double * speed * third / dt
    moved = third * wp.dot(x[a] - before[a] + x[b] - before[b] + x[c] - before[c], n)
    nn = wp.outer(n, n)
    for i in range(3):
        force[faces[f, i]] += k * moved * n
        matrix[blocks[f, 4 * i]] += k * nn


@wp.kernel
def springs(
    stiffness: wp.array(dtype=real),  # (N,) [N/m], the same in all directions
    middle: wp.array(dtype=int),
    matrix: wp.array(dtype=mat3),
):
    i = wp.tid()
    matrix[middle[i]] += stiffness[i] * wp.identity(n=3, dtype=real)


@wp.kernel
def contact(
    x: wp.array(dtype=vec3),
    before: wp.array(dtype=vec3),
    corners: wp.array2d(dtype=int),  # (C, 4)
    weights: wp.array2d(dtype=real),  # (C, 4); a corner of no weight is skipped
    normal: wp.array(dtype=vec3),
    offset: wp.array(dtype=real),  # [m]; the gap is normal . sum_i weight_i x_i - offset
    moved: wp.array(dtype=vec3),  # [m]; by what the other side of the contact moved in the step
    stiffness: wp.array(dtype=real),  # (C,) [N/m]
    drag: wp.array(dtype=real),  # [N/m]; friction for a unit slip
    middle: wp.array(dtype=int),
    gap: wp.array(dtype=real),  # receives the gap [m]
    slip: wp.array(dtype=real),  # receives the length of the slip in the step [m]
    block: wp.array(dtype=mat3),  # receives the Hessian in the point
    force: wp.array(dtype=vec3),
    matrix: wp.array(dtype=mat3),  # receives the Hessian's blocks of each corner with itself
):
    """stiffness / 2 gap^2 where the gap is below 0, and drag / 2 slip^2. Where the weights sum to
    one, the other side is not the sheet, and the Hessian is lumped, as masses are; where they sum
    to zero, it is exact, with what couples the corners in :mod:`onefit.physics.solver`.
    """
    c = wp.tid()
    n = normal[c]
    at, slid = vec3(), -moved[c]
    total = real(0.0)
    for i in range(4):
        if weights[c, i] != real(0.0):
            place = x[corners[c, i]]
            at += weights[c, i] * place
            slid += weights[c, i] * (place - before[corners[c, i]])
            total += weights[c, i]
    gap[c] = wp.dot(n, at) - offset[c]
    slid = slid - wp.dot(slid, n) * n
    slip[c] = wp.length(slid)
    k = real(0.0)
    if gap[c] < real(0.0):
        k = stiffness[c]
    if k + drag[c] > real(0.0):
        g = k * gap[c] * n + drag[c] * slid
        nn = wp.outer(n, n)
        block[c] = k * nn + drag[c] * (wp.identity(n=3, dtype=real) - nn)
        for i in range(4):
            v = corners[c, i]
            if weights[c, i] != real(0.0):
                force[v] += weights[c, i] * g
                share = wp.where(total > real(0.5), real(1.0), weights[c, i])
                matrix[middle[v]] += share * weights[c, i] * block[c]
