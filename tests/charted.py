"""Deformations of patched garments, for tests."""

import pytest
import torch
from slopes import slope

from onefit.body import ClosestSurface, skinning
from onefit.garment.charts import Deformation
from onefit.objective import objective

T = 6


def deformation(patched, size=1.0, frames=T, seed=0):
    g = torch.Generator().manual_seed(seed)
    K, A = patched.alpha.shape
    random = lambda *shape: size * torch.randn(*shape, generator=g)
    return Deformation(
        0.05 * random(frames, K, A),
        0.1 * random(frames, K, 3),
        0.1 * random(frames, K),
        0.2 * random(frames, K, 3),
    )


def scene(body, patched, frames=T, seed=2, bend=0.15):
    g = torch.Generator().manual_seed(seed)
    poses = body.rest_pose + bend * torch.randn(frames, 24, 3, generator=g)
    transforms = skinning.transforms(body, poses, 0.02 * torch.randn(frames, 3, generator=g))
    posed = skinning.skin(body.vertices, body.blend_weights, transforms)
    rest = patched.garment.vertices[:, None].expand(-1, frames, -1)
    return objective.Scene(
        transforms, posed, ClosestSurface(body.vertices, body.faces), rest, patched.field @ rest
    )


def scene_and_past(body, patched, name):
    """A scene, a deformation and two past positions, for the gradient of the term ``name``: little
    moves for the collision, whose distance jumps where a point in the body has another part of it
    for its nearest.
    """
    little = name == "collision"
    s = scene(body, patched, bend=0.02 if little else 0.15)
    before = [patched.changes(deformation(patched, 0.3, seed=k)) for k in (1, 2)]
    past = [objective.vertices(patched, x, s.rest, s.transforms) for x in before]
    return s, deformation(patched, 0.2 if little else 0.3), past


def assert_gradient(value, d, name):
    """The gradient of ``value`` (of alpha, translation, scale, drift) at a deformation, against
    differences along directions in which it changes: random ones, leaning towards the gradient, for
    float32 shows nothing else.
    """
    inputs = [x.clone().requires_grad_() for x in (d.alpha, d.translation, d.scale, d.drift)]
    gradients = torch.autograd.grad(value(*inputs), inputs)
    g = torch.Generator().manual_seed(7)
    for k, gradient in enumerate(gradients):
        chance = torch.randn(gradient.shape, generator=g)
        direction = gradient / gradient.norm() + 0.3 * chance / chance.norm()
        step = (1e-2 if name == "gravity" else 3e-4) / direction.abs().max().item()
        expected = slope(value, inputs, k, direction, step)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=0.03), k
