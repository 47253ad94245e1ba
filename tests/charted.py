"""Deformations of patched garments, for tests."""

import torch

from onefit.garment.charts import Deformation

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
