"""Drapes as patches: the deformation of a garment's patches that comes nearest to given vertices,
by least squares. What a teacher's drape is to a network, and how much of it patches can hold.
"""

from __future__ import annotations

import scipy.linalg
import torch

from onefit.garment import PatchedGarment

_RIDGE = (
    1e-6  # of the normal matrix's mean diagonal: monomials that no vertex sees stay where they are
)


def unposed(
    vertices: torch.Tensor, weights: torch.Tensor, transforms: torch.Tensor
) -> torch.Tensor:
    """Points (N, T, 3) [m] of the rest space that skinning with blend weights (N, J) and transforms
    (T, J, 3, 4) brings to vertices (T, N, 3) [m].
    """
    maps = torch.einsum("nj,tjab->ntab", weights, transforms)
    return torch.linalg.solve(maps[..., :3], vertices.transpose(0, 1) - maps[..., 3])


class Projection:
    """Least squares onto ``patched``'s patches, factored once."""

    def __init__(self, patched: PatchedGarment) -> None:
        self.patched = patched
        blend = patched.blend @ torch.eye(patched.blend.shape[1])
        self._blend = blend.double().numpy()
        normal = self._blend.T @ self._blend
        normal[range(len(normal)), range(len(normal))] += _RIDGE * normal.diagonal().mean()
        self._factor = scipy.linalg.cho_factor(normal)

    def __call__(self, displacement: torch.Tensor) -> torch.Tensor:
        """The changes (K, A, T, 3) [m] of the patches whose :meth:`PatchedGarment.displacement` is
        nearest to a displacement (N, T, 3) [m] in the rest space.
        """
        N, T, _ = displacement.shape
        right = self._blend.T @ displacement.double().numpy().reshape(N, 3 * T)
        found = scipy.linalg.cho_solve(self._factor, right)
        changes = torch.as_tensor(found).to(displacement)
        return changes.reshape(len(self.patched), -1, T, 3)
