"""Deformations of patched garments, for tests."""

import torch

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
