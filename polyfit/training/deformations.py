"""Random smooth maps of space that fold, bend and stretch patches. They make many garments of few
for the training, and pose garments that are held out.

A map is a stretch along random axes, then bends about random axes, then plane waves. It acts on a
batch, one map a patch, and maps normals by its derivative. Coordinates are in the unit of the patch
or garment: a ball of radius 1 about the origin.
"""

from dataclasses import dataclass

import torch

# Largest curvature * |height| of a bend, no unit: the points farthest from its axis are stretched
# by 1.8 or shrunk to 0.2.
_MAX_BEND = 0.8


@dataclass(frozen=True)
class SmoothMaps:
    """B maps of space. ``scale`` (B, 3), ``axes`` (B, 3, 3); ``bend_frames`` (B, M, 3, 3), ``bend``
    (B, M); ``wave`` (B, W, 3), ``push`` (B, W, 3), ``phase`` (B, W).
    """

    scale: torch.Tensor
    axes: torch.Tensor
    bend_frames: torch.Tensor
    bend: torch.Tensor
    wave: torch.Tensor
    push: torch.Tensor
    phase: torch.Tensor

    def __call__(self, x):
        """Where the points x (B, P, 3) go, (B, P, 3)."""
        x = (x @ self.axes * self.scale[:, None]) @ self.axes.transpose(1, 2)
        for k in range(self.bend.shape[1]):
            x = _bend(x, self.bend_frames[:, k], self.bend[:, k, None])
        angle = x @ self.wave.transpose(1, 2) + self.phase[:, None]
        return x + torch.sin(angle) @ self.push

    def map_with_normals(self, x, normals):
        """Where points and their unit normals (B, P, 3) go: (points, normals), by the map's
        derivative along two tangents.
        """
        helper = torch.nn.functional.one_hot(normals.abs().argmin(-1), 3).to(normals.dtype)
        t1 = torch.nn.functional.normalize(torch.linalg.cross(normals, helper), dim=-1)
        t2 = torch.linalg.cross(normals, t1)
        y, d1 = torch.func.jvp(self, (x,), (t1,))
        _, d2 = torch.func.jvp(self, (x,), (t2,))
        return y, torch.nn.functional.normalize(torch.linalg.cross(d1, d2), dim=-1)


def _bend(x, frame, curvature):
    """Rolls space about the second axis of ``frame`` (B, 3, 3; columns: along, across, up): the
    plane up = 0 becomes a cylinder of ``curvature`` (B, 1).
    """
    along, across, up = (x @ frame).unbind(-1)
    # at up = 1 / curvature space would shrink to a line, and turn inside out beyond
    most = _MAX_BEND / up.detach().abs().amax(1, keepdim=True).clamp_min(1e-6)
    curvature = torch.maximum(torch.minimum(curvature, most), -most)
    angle = curvature * along
    half = torch.special.sinc(angle / (2 * torch.pi))
    rolled = along * torch.special.sinc(angle / torch.pi) - up * torch.sin(angle)
    raised = along * half * half * angle / 2 + up * torch.cos(angle)
    return torch.stack([rolled, across, raised], -1) @ frame.transpose(1, 2)


def _frames(shape, generator):
    """Random rotations, (*shape, 3, 3)."""
    q, _ = torch.linalg.qr(torch.randn(*shape, 3, 3, generator=generator))
    return q * torch.linalg.det(q)[..., None, None]


def random(
    count,
    generator,
    *,
    stretch=0.3,
    bend=4.0,
    bends=3,
    waves=4,
    frequency=(1.0, 6.0),
    steepness=0.9,
):
    """``count`` random maps, float32.

    ``stretch`` is the largest logarithm of a scale; ``bend`` the largest curvature of a bend;
    ``waves`` plane waves have wave numbers in ``frequency`` and together push with a derivative of
    at most ``steepness`` (below 1 no wave folds space over itself). Every patch draws its own
    strength in [0, 1] for each of the three, so that mild maps are as frequent as strong ones.
    ``generator`` is a CPU ``torch.Generator``.
    """

    def uniform(*shape):
        return torch.rand(count, *shape, generator=generator)

    def strength():
        return uniform(1)

    scale = torch.exp(stretch * (2 * uniform(3) - 1) * strength())
    wave = torch.nn.functional.normalize(torch.randn(count, waves, 3, generator=generator), dim=-1)
    number = frequency[0] + (frequency[1] - frequency[0]) * uniform(waves, 1)
    share = torch.softmax(3 * torch.rand(count, waves, 1, generator=generator), 1)
    direction = torch.nn.functional.normalize(
        torch.randn(count, waves, 3, generator=generator), dim=-1
    )
    push = steepness * strength()[..., None] * share / number * direction
    return SmoothMaps(
        scale,
        _frames((count,), generator),
        _frames((count, bends), generator),
        bend * (2 * uniform(bends) - 1) * strength(),
        wave * number,
        push,
        2 * torch.pi * uniform(waves),
    )
