"""The whole objective of a garment's deformation in a few frames (paper, section "OneFit"): what
training lowers, and what a drape is measured by.
"""

from dataclasses import dataclass

import torch

from . import losses

_RANDOM_POINTS = (
    1000  # vertices drawn for the collision, beside those nearest to the metric's points
)


@dataclass(frozen=True)
class Scene:
    """T frames of bodies, each on its own: ``transforms`` (T, J, 3, 4); ``body`` (T, V, 3) [m], the
    posed surface; ``collider``, the :class:`onefit.body.ClosestSurface` of its triangles;
    ``rest`` (N, T, 3) [m], the garment's vertices in the rest space, graded to each frame's shape,
    and ``field`` (3 P, T, 3), what :attr:`onefit.PatchedGarment.field` makes of them.
    """

    transforms: torch.Tensor
    body: torch.Tensor
    collider: object
    rest: torch.Tensor
    field: torch.Tensor


def posed(points, weights, transforms):
    """Points (N, T, 3) of the rest space, skinned with blend weights (N, J) and transforms (T, J,
    3, 4): (N, T, 3) [m].
    """
    T, J = transforms.shape[:2]
    maps = (weights @ transforms.transpose(0, 1).reshape(J, T * 12)).unflatten(1, (T, 3, 4))
    return (maps[..., :3] @ points[..., None])[..., 0] + maps[..., 3]


def vertices(garment, changes, rest, transforms):
    """The garment's vertices (N, T, 3) [m], of :meth:`onefit.PatchedGarment.changes`, rest
    (N, T, 3) [m] and transforms (T, J, 3, 4).
    """
    return posed(rest + garment.displacement(changes), garment.garment.blend_weights, transforms)


def evaluate(garment, deformation, scene, weights, epoch=100, past=None, dt=1 / 30, generator=None):
    """The terms of the objective, a dict of tensors in which the weights are in force, and the
    posed vertices (N, T, 3) [m].

    ``garment``: a :class:`onefit.PatchedGarment`; ``deformation``: its
    :class:`onefit.garment.charts.Deformation` in the T frames; ``past``: the vertices one and two
    frames, of ``dt`` [s], before each of them, (N, T, 3) [m] each; None leaves inertia out. A term
    whose weight is 0 is left out too.
    """
    changes = garment.changes(deformation)
    x = vertices(garment, changes, scene.rest, scene.transforms)
    area = garment.vertex_area
    terms = {}
    k_ext = torch.ones((), device=x.device)
    if weights.k_c:
        terms["collision"], distance = collision(garment, x, scene, weights, generator)
        k_ext = losses.extension(distance[: len(garment.metric_vertex)], epoch, weights.epsilon)
    if weights.k_i:
        terms["inextensibility"] = weights.k_i * _metric_term(garment, changes, scene, k_ext)
    if weights.k_mi:
        a, b = garment.edges.T
        rest = (scene.rest[a] - scene.rest[b]).norm(dim=-1)
        length = ((x[a] - x[b]).square().sum(-1) + 1e-12).sqrt()
        terms["mesh_inextensibility"] = weights.k_mi * losses.mesh_inextensibility(length, rest)
    if weights.k_b or weights.k_bn:
        at = garment.at_boundary(changes)  # (2, B, 3, T, 3)
        tangents = garment.boundary_tangents[:, :, :, None] + at[:, :, 1:]
        normals = losses.normals(tangents.unbind(2))
        terms["boundary"] = losses.boundary(at[:, :, 0], normals, weights.k_b, weights.k_bn)
    mass = losses.DENSITY * area
    if weights.k_g:
        terms["gravity"] = weights.k_g * losses.gravity(
            x[..., 2] - scene.transforms[:, 0, 2, 3], mass
        )
    if weights.k_in and past is not None:
        terms["inertia"] = weights.k_in * losses.inertia(x, *past, mass, dt)
    return terms, x


def collision(garment, x, scene, weights, generator=None):
    """The collision's term for vertices ``x`` (N, T, 3) [m], and signed distances (P, T) [m] of
    those nearest to the metric's points and of :data:`_RANDOM_POINTS` more.
    """
    drawn = torch.randint(len(x), (_RANDOM_POINTS,), generator=generator).to(x.device)
    chosen = torch.cat([garment.metric_vertex, drawn])
    distance = scene.collider.distances(x[chosen].transpose(0, 1), scene.body).T
    share = (garment.vertex_area.sum() / len(chosen)).expand(len(chosen))
    return weights.k_c * losses.collision(distance, share, weights.epsilon), distance


def _metric_term(garment, changes, scene, k_ext):
    points, *tangents = scene.field.unflatten(0, (-1, 3)).unbind(1)
    moved = garment.at_metric(changes).unbind(1)
    deformed = [t + d for t, d in zip(tangents, moved[1:])]
    skinned = losses.skinned_tangents(
        points + moved[0], deformed, garment.metric_weights, scene.transforms
    )
    s = garment.frame.s.to(points).repeat_interleave(len(points) // len(garment))
    return losses.inextensibility(losses.metric(tangents), losses.metric(skinned), k_ext, s)
