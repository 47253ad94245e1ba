"""Distances and the objective of patched garments."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from charted import assert_gradient, deformation, scene, scene_and_past

from onefit.body import AnnyBody, ClosestSurface, skinning
from onefit.body.nearest import SEARCH_RADIUS
from onefit.garment.charts import Deformation
from onefit.objective import losses, objective


def test_signed_distances(body):
    collider = ClosestSurface(body.vertices, body.faces)
    g = torch.Generator().manual_seed(1)
    face = torch.randint(len(body.faces), (200,), generator=g)
    corners = body.vertices[body.faces[face]]
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1
    )
    for away in (0.002, -0.002):
        found = collider.distances((corners.mean(1) + away * normal)[None], body.vertices[None])[0]
        assert (found - away).abs().median() < 1e-5
        assert (found * away > 0).float().mean() > 0.97  # thin places: lips, fingers
    # moved bodies move their distances; the far is far
    shift = torch.tensor([0.5, 0, 0])
    x = corners.mean(1) + 0.01 * normal
    both = collider.distances(
        torch.stack([x, x + shift]), torch.stack([body.vertices, body.vertices + shift])
    )
    assert torch.allclose(both[0], both[1], atol=1e-5)
    assert collider.distances(
        torch.full((1, 1, 3), 9.0), body.vertices[None]
    ).item() == pytest.approx(SEARCH_RADIUS)


def test_gradient_of_the_signed_distance(body):
    collider = ClosestSurface(body.vertices, body.faces)
    x = (body.vertices[::400] + 0.02 * torch.tensor([0.3, -0.8, 0.4]))[None].requires_grad_()
    distance = collider.distances(x, body.vertices[None])
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    step = 1e-3
    for k, axis in enumerate(torch.eye(3)):
        ends = [
            collider.distances((x + sign * step * axis).detach(), body.vertices[None])
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2 * step)
        assert (gradient[..., k] - slope).abs().median() < 1e-2
    assert torch.allclose(gradient.norm(dim=-1), torch.ones(1), atol=1e-4)


def test_without_deformation_the_objective_is_plain_skinning(patched, garment, body):
    s = scene(body, patched)
    _, x = objective.evaluate(
        patched,
        deformation(patched, 0.0),
        s,
        losses.Weights(),
        generator=torch.Generator().manual_seed(0),
    )
    expected = skinning.skin(garment.vertices, garment.blend_weights, s.transforms)
    assert torch.allclose(x.transpose(0, 1), expected, atol=1e-5)


@pytest.mark.parametrize(
    "name",
    ["collision", "inextensibility", "mesh_inextensibility", "boundary", "gravity", "inertia"],
)
def test_gradient_of_the_whole_objective(patched, body, name):
    s, d, past = scene_and_past(body, patched, name)
    switches = dict(
        collision="k_c",
        inextensibility="k_i",
        mesh_inextensibility="k_mi",
        boundary="k_b",
        gravity="k_g",
        inertia="k_in",
    )
    off = dict.fromkeys(("k_c", "k_i", "k_b", "k_bn", "k_mi", "k_g", "k_in"), 0.0)
    on = {switches[name]: 1.0} | ({"k_bn": 1.0} if name == "boundary" else {})
    weights = losses.Weights(**off | on)

    def value(*parts):
        generator = torch.Generator().manual_seed(5)
        terms, _ = objective.evaluate(
            patched, Deformation(*parts), s, weights, past=past, generator=generator
        )
        assert list(terms) == [name]
        return terms[name]

    assert_gradient(value, d, name)


def test_metric_points_lie_on_their_vertices(patched, garment):
    value = (patched.field @ garment.vertices).unflatten(0, (-1, 3))[:, 0]
    apart = (value - garment.vertices[patched.metric_vertex]).norm(dim=-1)
    edge = (garment.vertices[patched.edges[:, 0]] - garment.vertices[patched.edges[:, 1]]).norm(
        dim=-1
    )
    assert apart.max() < 2 * np.float64(edge.max())


def test_transforms_of_a_body_for_each_frame():
    model = AnnyBody()
    bodies = [model.body(), model.body(torch.tensor([0.9, 0.7, 0.5, 0.6, 0.7, 0.4]))]
    g = torch.Generator().manual_seed(4)
    poses, translation = 0.3 * torch.randn(2, 24, 3, generator=g), torch.randn(2, 3, generator=g)
    both = replace(
        bodies[0],
        **{
            name: torch.stack([getattr(b, name) for b in bodies])
            for name in ("joints", "rest_pose")
        },
    )
    together = skinning.transforms(both, poses, translation)
    for k, body in enumerate(bodies):
        assert torch.allclose(
            together[k],
            skinning.transforms(body, poses[k : k + 1], translation[k : k + 1])[0],
            atol=1e-6,
        )
