"""Bodies in poses, for tests."""

import torch


def random_poses(count, seed=0, size=0.5):
    return torch.randn(count, 24, 3, generator=torch.Generator().manual_seed(seed)) * size
