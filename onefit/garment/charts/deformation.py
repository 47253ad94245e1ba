"""What the network says of the patches of a garment."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Deformation:
    """What the network says of each patch in each frame: ``alpha`` (T, K, A) added to the
    coefficients, ``translation`` (T, K, 3) in the chart and in units of s, ``scale`` (T, K), the
    logarithm of s'/s, and ``drift`` (T, K, 3), a displacement along the rest space's axes, in units
    of ``drift_scale``, that the cloth around shares: each patch takes the plane through those of
    the patches around it, so that it turns and stretches with them. Zeros leave the garment as it
    is."""

    alpha: torch.Tensor
    translation: torch.Tensor
    scale: torch.Tensor
    drift: torch.Tensor
