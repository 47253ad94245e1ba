"""The losses of OneFit (paper, section "OneFit"), each a function of tensors and differentiable in
those that the network moves.

Points stand first and frames second, (N, T, 3), as :mod:`onefit.garment.charts` makes them. Every
loss is a mean over frames. The paper leaves the normalisations open. Here all is in SI units; a sum
over points has ten points for each square centimetre, whatever the mesh's own resolution, so that
the paper's weights mean the same for all garments. docs/onefit.md lists every choice.
"""

from dataclasses import dataclass

import torch

from polyfit.errors import InputError

GRAVITY = 9.81  # [m/s^2], along -z
DENSITY = 0.2  # [kg/m^2], a light cotton jersey
METRIC_FACTOR = 0.1  # what a change of the metric by the square of the patch's radius counts for
POINT_AREA = 1e-5  # [m^2] that a point of a sum stands for


@dataclass(frozen=True)
class Weights:
    """The paper's weights, and what it leaves open: ``k_bn`` and ``epsilon`` [m]. ``k_m``: of the
    energies of the objective "material", which has ``k_c`` and ``epsilon`` as well; ``k_t``: of a
    teacher's lessons. 0 switches a loss off.
    """

    k_c: float = 1.0
    k_i: float = 0.5
    k_b: float = 5e3
    k_bn: float = 1.0
    k_mi: float = 2.0
    k_g: float = 1.0
    k_in: float = 1.0
    k_m: float = 1.0
    k_t: float = 1.0
    epsilon: float = 0.004

    def __post_init__(self):
        for name, value in vars(self).items():
            if not 0 <= value < float("inf"):
                raise InputError(f"{name} = {value}: a number, 0 or more")


def _penetration(distance, epsilon):
    """d_c = max(epsilon - d, 0) of signed distances [m]: how far a point is from being ``epsilon``
    outside the body.
    """
    return (epsilon - distance).clamp(min=0)


def collision(distance, area, epsilon):
    """Sum over points of d_c^2 [m^2], of signed distances (N, T) [m] at points that stand for
    ``area`` (N,) [m^2] each.
    """
    return (_penetration(distance, epsilon).square() * (area / POINT_AREA)[:, None]).sum(0).mean()


def extension(distance, epoch, epsilon):
    """k_ext = 1 + min(d_c, 0.01) min(e, 100), of the same shape: how much the metric may stretch
    where the body is in the way. Without gradient."""
    return 1 + _penetration(distance.detach(), epsilon).clamp(max=0.01) * min(epoch, 100)


def metric(tangents):
    """First fundamental forms (..., 3) [m^2], the entries E, F, G, of the pair ``tangents`` along u
    and v, (..., 3) [m] each.
    """
    u, v = tangents
    return torch.stack([(u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)], -1)


def skinned_tangents(points, tangents, weights, transforms):
    """Tangents J_psi J_phi (2 of (P, T, 3)) of a skinned surface.

    ``points`` (P, T, 3) and ``tangents`` (2 of (P, T, 3)) in the rest space; ``weights`` (P, 3, J):
    blend weights and their derivatives along u and v; ``transforms`` (T, J, 3, 4). The weights
    change along the surface, so that J_psi is not the blended rotation alone: d psi = (sum_j w_j
    R_j) d phi + sum_j dw_j (R_j x + t_j).
    """
    T, J = transforms.shape[:2]
    flat = transforms.transpose(0, 1).reshape(J, T * 12)
    blended, du, dv = ((w @ flat).unflatten(1, (T, 3, 4)) for w in weights.unbind(1))
    turn = lambda m, x: (m[..., :3] @ x[..., None])[..., 0]
    return tuple(turn(blended, t) + turn(d, points) + d[..., 3] for t, d in zip(tangents, (du, dv)))


def inextensibility(rest, posed, k_ext, s):
    """METRIC times the mean over points of |k_ext g_T - g_P|, both metrics (P, T, 3) as
    :func:`metric` gives them, in units of the patches' radius ``s`` (P,) [m]. The off-diagonal
    entry counts twice, as it stands twice in the matrix."""
    difference = (k_ext[..., None] * rest - posed) / s[:, None, None].square()
    return METRIC_FACTOR * (difference.abs() * difference.new_tensor([1, 2, 1])).sum(-1).mean()


def mesh_inextensibility(lengths, rest):
    """Sum over edges of squared changes of length [m^2], of ``lengths`` and ``rest`` (E, T) [m]. It
    depends on strain and area alone, not on how fine the mesh is, for the squared lengths of a
    mesh's edges add up to about 3.5 times its area.
    """
    return (lengths - rest).square().sum(0).mean()


def boundary(displacement, normals, k_b, k_bn):
    """Positions and normals of the same point in two charts: ``displacement`` and unit ``normals``
    (2, B, T, 3).
    """
    apart = (displacement[0] - displacement[1]).square().sum(-1)
    cosine = (normals[0] * normals[1]).sum(-1)
    return k_b * apart.mean() + k_bn * (1 - cosine).square().mean()


def normals(tangents):
    """Unit normals (..., 3) of the pair ``tangents`` along u and v, (..., 3) [m] each."""
    return torch.nn.functional.normalize(torch.linalg.cross(*tangents), dim=-1)


def gravity(height, mass):
    """Potential energy [J] of points at ``height`` (N, T) [m] with ``mass`` (N,) [kg]."""
    return GRAVITY * (mass[:, None] * height).sum(0).mean()


def inertia(x, before, earlier, mass, dt):
    """sum m / (2 dt^2) |x - x' - dt v'|^2 [J], v' = (x' - x'') / dt, of points (N, T, 3) [m] now,
    one and two frames ago (Santesteban et al. 2022).

    The gradient reaches the past, too. With a past that is given, a swing of frequency w costs k -
    m w^2: cloth that swings more slowly by itself than the body moves it is no minimum, and a
    network learns to swing more and more.
    """
    return ((x - 2 * before + earlier).square().sum(-1) * mass[:, None]).sum(0).mean() / (
        2 * dt * dt
    )
