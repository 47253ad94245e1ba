"""PolyFit as a network: the PCA frame, a spatial transformer that refines it, the jet (paper,
section "PolyFit").

PCA takes the plane of least spread. For a large or folded patch this plane is wrong: over it the
patch is no height graph. The transformer sees the patch in its PCA frame and answers with a few
unit quaternions. Each is a turn of the frame; the PCA frame itself is one of them. The turn whose
jet leaves the least height is kept. So the refined frame is never worse than PCA at the points that
were read. A patch with two plausible planes needs no guess between them. The paper's transformer
has one quaternion, and PCA's frame is no alternative: ``SpatialTransformer(turns=1, pca=False)``.

Only the direction of z counts. A rotation within the plane changes nothing, because a jet of full
degree spans the same heights in any (u, v).
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polyfit import jets
from polyfit.errors import InputError
from polyfit.jets import CanonicalFrame, rotation_matrix

from .weights import load_into, read_weights, write_weights

WEIGHTS_VERSION = 1  # of the network's shape and the meaning of its weights
_DATA = Path(__file__).parents[1] / "data"
# Weights of the package: ours, and what the paper's own training made here
PRETRAINED = {name: _DATA / f"{name}.safetensors" for name in ("polyfit", "paper")}
_IDENTITY = (0.0, 0.0, 0.0, 1.0)
_INITIAL_TILT = math.radians(55)  # between the PCA frame's z and the first guesses'


class SpatialTransformer(torch.nn.Module):
    """A PointNet that reads a patch and answers with unit quaternions.

    ``widths`` are those of the layers that see each point alone, ``hidden`` of the two layers after
    the maximum over points; at most ``points`` points are read, every so many-th of the patch's own
    order. ``turns`` quaternions are learned; they start as tilts to all sides. With ``pca`` the
    PCA frame's own, the identity, is one more answer. Without it the first of those that are
    learned starts there: with one turn, this is the paper's transformer.
    """

    def __init__(
        self,
        widths: Sequence[int] = (32, 64, 128),
        hidden: int = 64,
        points: int = 64,
        turns: int = 5,
        pca: bool = True,
    ) -> None:
        super().__init__()
        self.shape = dict(widths=list(widths), hidden=hidden, points=points, turns=turns, pca=pca)
        self.points, self.pca = points, pca
        self.local = pointwise(widths)
        layers = [
            torch.nn.LayerNorm(widths[-1]),
            *normalised_layer(widths[-1], hidden),
            *normalised_layer(hidden, hidden),
        ]
        last = torch.nn.Linear(hidden, 4 * turns)
        self.head = torch.nn.Sequential(*layers, last)
        side = torch.arange(turns) * 2 * math.pi / turns
        first = torch.stack(
            [
                math.sin(_INITIAL_TILT / 2) * side.cos(),
                math.sin(_INITIAL_TILT / 2) * side.sin(),
                0 * side,
                math.cos(_INITIAL_TILT / 2) + 0 * side,
            ],
            -1,
        )
        if not pca:
            first[0] = first.new_tensor(_IDENTITY)
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(first.flatten())

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """Unit quaternions (B, H, 4) in the order (x, y, z, w) for patches x (B, P, 3) in the chart
        of their PCA frame. H is ``turns``; with ``pca`` one more, and the first is the identity.

        ``mask`` (B, P) marks the points that count.
        """
        x = subsampled(x.to(next(self.parameters()).dtype), self.points, mask)
        turns = torch.nn.functional.normalize(
            self.head(self.local(x).amax(1)).unflatten(-1, (-1, 4)), dim=-1
        )
        if not self.pca:
            return turns
        return torch.cat([turns.new_tensor(_IDENTITY).expand(len(x), 1, 4), turns], 1)


def pointwise(widths: Sequence[int], entries: int = 3) -> torch.nn.Sequential:
    """Linear layers with ReLU that see each point alone."""
    layers = []
    for width in widths:
        layers += [linear(entries, width), torch.nn.ReLU()]
        entries = width
    return torch.nn.Sequential(*layers)


def linear(entries: int, exits: int) -> torch.nn.Linear:
    """A linear layer that keeps the size of what passes through it and a ReLU (He et al. 2015)."""
    layer = torch.nn.Linear(entries, exits)
    torch.nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    torch.nn.init.zeros_(layer.bias)
    return layer


def normalised_layer(entries: int, exits: int) -> tuple[torch.nn.Module, ...]:
    return linear(entries, exits), torch.nn.LayerNorm(exits), torch.nn.ReLU()


def subsampled(x: Tensor, count: int, mask: Tensor | None = None) -> Tensor:
    """At most ``count`` of the points x (B, P, 3), evenly through the order of those that ``mask``
    (B, P) leaves: (B, count, 3).

    A patch with fewer has some of its points twice, which no maximum over points notices.
    """
    if mask is None:
        if x.shape[1] <= count:
            return x
        return x[:, torch.arange(count, device=x.device) * x.shape[1] // count]
    count = min(count, x.shape[1])
    first = torch.argsort(mask.to(torch.int8), dim=1, descending=True, stable=True)
    index = torch.arange(count, device=x.device) * mask.sum(1, keepdim=True) // count
    return x.gather(1, first.gather(1, index)[..., None].expand(-1, -1, 3))


@dataclass(frozen=True)
class PatchFit:
    """Patches as PolyFit holds them: ``frame``, the orientation O = (s, R, T), and ``jet``, a
    :class:`polyfit.jets.JetFit` with ``alpha`` (B, A) in that frame.
    """

    frame: CanonicalFrame
    jet: jets.JetFit


class PolyFit(torch.nn.Module):
    """Patches of points to frames and jets: PCA, spatial transformer, least squares.

    ``order`` is that of the jets; ``stn`` a :class:`SpatialTransformer`, or None for the PCA frame
    alone. ``PolyFit.pretrained()`` has the weights of the package.
    """

    def __init__(self, order: int = 4, stn: SpatialTransformer | None = None) -> None:
        super().__init__()
        self.order = jets.check_order(order)
        self.stn = stn

    def frame(
        self, points: Tensor, mask: Tensor | None = None, *, weights: Tensor | None = None
    ) -> CanonicalFrame:
        """The :class:`CanonicalFrame` of patches ``points`` (B, P, 3), of which ``mask`` (B, P)
        counts; ``weights`` (B, P) for mean and spread.

        Differentiable with respect to the network's weights, through the turn that was kept. Raises
        InputError as :meth:`CanonicalFrame.from_points` does, and for points of other shapes.
        """
        if not isinstance(points, Tensor) or points.ndim != 3:
            given = f"{type(points).__name__} of shape {tuple(np.shape(points))}"
            raise InputError(f"points: {given}; a tensor of torch (patches, points, 3) is needed")
        frame = CanonicalFrame.from_points(points, mask, weights=weights)
        if self.stn is None:
            return frame
        x = frame.to_chart(points)
        turns = self.stn(x, mask)
        if turns.shape[1] == 1:
            return frame.rotated(turns[:, 0].to(frame.R.dtype))
        kept = self.least_height(
            subsampled(x, max(self.stn.points, 4 * jets.size_of(self.order)), mask), turns.detach()
        )
        return frame.rotated(
            turns[torch.arange(len(turns), device=turns.device), kept].to(frame.R.dtype)
        )

    @torch.no_grad()
    def frame_of(self, points: np.ndarray) -> CanonicalFrame:
        """The frame of one patch of points (P, 3), NumPy, in float64: its rotation is one to the
        last digit.
        """
        found = self.frame(torch.as_tensor(np.asarray(points, dtype=np.float32))[None])[0]
        s, R, T = (x.to(torch.float64).numpy() for x in (found.s, found.R, found.T))
        left, _, right = np.linalg.svd(R)
        return CanonicalFrame(s, left @ right, T)

    @torch.no_grad()
    def least_height(self, x: Tensor, turns: Tensor) -> Tensor:
        """Which of the ``turns`` (B, H, 4) leaves the jets through x (B, P, 3) the least RMS of
        height, (B,).
        """
        y = x[:, None] @ rotation_matrix(turns.to(x.dtype))
        alpha = jets.fit(y, self.order).alpha
        return (jets.height(alpha, y[..., :2]) - y[..., 2]).square().mean(-1).argmin(-1)

    def forward(
        self, points: Tensor, *, weights: Tensor | None = None, mask: Tensor | None = None
    ) -> PatchFit:
        """:class:`PatchFit` of patches ``points`` (B, P, 3) in any unit and frame; ``weights`` and
        ``mask`` (B, P) as in :func:`polyfit.jets.fit`.
        """
        frame = self.frame(points, mask, weights=weights)
        return PatchFit(
            frame, jets.fit(frame.to_chart(points), self.order, weights=weights, mask=mask)
        )

    @classmethod
    def pretrained(cls, order: int = 4, name: str = "polyfit") -> "PolyFit":
        """PolyFit with weights that ship in the package (``polyfit/data``; the JSON files there say
        what made them): "polyfit", or "paper", with one quaternion, by the paper's own training.

        Raises InputError for a name that there is not, and for an order that they are not for.
        """
        if name not in PRETRAINED:
            raise InputError(f"weights {name}: choose among {', '.join(PRETRAINED)}")
        return cls.load(PRETRAINED[name], order)

    @classmethod
    def load(cls, path: str | os.PathLike[str], order: int | None = None) -> "PolyFit":
        """PolyFit with the weights of the file ``path``, as ``polyfit.train`` writes them. Raises
        InputError where they are no such, of another version, or not for ``order``.
        """
        weights, about = read_weights(path, "polyfit", WEIGHTS_VERSION)
        if order is not None and about["order"] != order:
            raise InputError(f"{path}: weights for jets of order {about['order']}, not {order}")
        model = cls(about["order"], SpatialTransformer(**about["network"]))
        load_into(model, weights, path)
        return model.eval()

    def save(self, path: str | os.PathLike[str], **about: Any) -> None:
        """Writes the weights to ``path`` (safetensors), with what they are for and ``about``.
        Raises ValueError where there is no transformer, and so no weights.
        """
        if self.stn is None:
            raise ValueError("without a transformer there are no weights to save")
        write_weights(
            path,
            self.state_dict(),
            dict(
                model="polyfit",
                version=WEIGHTS_VERSION,
                order=self.order,
                network=self.stn.shape,
                **about,
            ),
        )
