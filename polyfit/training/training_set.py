"""The training set: patches in the charts of their PCA frames, and how well a jet fits each of
them from every side.

The gradient of a fit's error leads from the PCA frame into the nearest minimum. That is often not
the right one, because across a fold the error first rises. So the discrepancy of every patch is
tabulated once, on axes all over the half sphere. Training reads the table smoothed over directions
(:meth:`TrainingSet.at`), and the smoothing narrows as training goes on.
"""

from dataclasses import dataclass, fields

import torch

from polyfit import jets
from polyfit.jets import CanonicalFrame

from . import families
from .garments import GarmentPatches
from .losses import discrepancy

_PATCHES_PER_CHUNK = 500  # patches made, and fitted, at a time
_AXIS_COUNT = 65  # axes of the half sphere along which jets are fitted
NORMAL_WEIGHT = 0.1  # weight of 1 - cosine of the normals against RMS of height


@dataclass(frozen=True)
class TrainingSet:
    """``points`` and ``normals`` (N, P, 3) in the charts of the PCA frames; ``height`` and ``loss``
    (N, D): RMS of height, and that plus ``NORMAL_WEIGHT`` (1 - cosine) between the normals, of jets
    fitted with z along each of :func:`axes`; D is 0 where no table was asked for. float32.
    """

    points: torch.Tensor
    normals: torch.Tensor
    height: torch.Tensor
    loss: torch.Tensor

    def __len__(self):
        return len(self.points)

    def to(self, device):
        return TrainingSet(*(getattr(self, f.name).to(device) for f in fields(self)))

    def at(self, index, z, sharpness):
        """Height and loss, each (B, H), of patches ``index`` (B,) fitted along unit axes z (B, H,
        3): means over the table, weighted by exp(``sharpness`` cos^2).
        """
        weight = torch.softmax(sharpness * (z @ axes(z.device).T) ** 2, -1)
        return (weight * self.height[index][:, None]).sum(-1), (
            weight * self.loss[index][:, None]
        ).sum(-1)


def axes(device=None):
    """Unit vectors (_AXIS_COUNT, 3) evenly over the half sphere z > 0, the pole first."""
    k = torch.arange(_AXIS_COUNT - 1, device=device) + 0.5
    z, turn = 1 - k / (_AXIS_COUNT - 1), k * torch.pi * (3 - 5**0.5)
    r = (1 - z * z).sqrt()
    return torch.cat(
        [z.new_tensor([[0.0, 0.0, 1.0]]), torch.stack([r * turn.cos(), r * turn.sin(), z], -1)]
    )


def rotations_to(z):
    """Rotations (..., 3, 3) whose third columns are the unit vectors z (..., 3)."""
    helper = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).to(z.dtype)
    u = torch.nn.functional.normalize(torch.linalg.cross(helper, z), dim=-1)
    return torch.stack([u, torch.linalg.cross(z, u), z], -1)


def build(
    count,
    points,
    order,
    seed,
    *,
    garments=None,
    names=families.FAMILIES,
    garment_share=0.75,
    deformed=True,
    table=True,
    device="cpu",
    advance=lambda done: None,
):
    """:class:`TrainingSet` of ``count`` patches of ``points`` points each, for jets of ``order``.

    ``garments`` (:class:`GarmentPatches` or None) are ``deformed`` at random, or as they are, and
    make up ``garment_share`` of the patches; ``names`` are the analytic families that are summed,
    or empty. Without ``table`` no jets are fitted along the axes. ``advance`` is told how many
    patches there are so far.
    """
    parts = []
    turns = rotations_to(axes()) if table else torch.empty(0, 3, 3)
    for first in range(0, count, _PATCHES_PER_CHUNK):
        size = min(_PATCHES_PER_CHUNK, count - first)
        generator = torch.Generator().manual_seed(seed * 1_000_003 + first)
        share = 0 if garments is None else garment_share if names else 1
        of_garments = round(share * size)
        made = []
        if of_garments:
            take = garments.deformed if deformed else garments.drawn
            made.append(take(of_garments, generator))
        if size > of_garments:
            samples = points if garments is None else garments.points.shape[1]
            made.append(
                GarmentPatches(
                    *(
                        t.float()
                        for t in families.sample(size - of_garments, samples, generator, names)
                    )
                )
            )
        made = GarmentPatches.join(made)
        parts.append(
            _tabulated(
                made.points[:, :points].to(device),
                made.normals[:, :points].to(device),
                turns.to(device),
                order,
            )
        )
        advance(first + size)
    return TrainingSet(
        *(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(TrainingSet))
    )


def _tabulated(points, normals, turns, order):
    frame = CanonicalFrame.from_points(points)
    x, n = frame.to_chart(points), normals @ frame.R
    height, loss = [x.new_empty(len(x), 0)], [x.new_empty(len(x), 0)]
    for turn in turns:
        y = x @ turn
        d = discrepancy(jets.fit(y, order).alpha, y, n @ turn)
        height.append(d.height[:, None])
        loss.append((d.height + NORMAL_WEIGHT * (1 - d.cosine))[:, None])
    return TrainingSet(x, n, torch.cat(height, 1), torch.cat(loss, 1))
