"""PointNet (Qi et al. 2017) and DGCNN (Wang et al. 2019) that regress a jet's coefficients from a
patch (paper, supplement, "Additional ablation studies").

Both see a patch in the chart of its PCA frame and answer with alpha (B, A) in that chart, where
PolyFit solves for it.
"""

import torch

from polyfit import jets
from polyfit.errors import InputError
from polyfit.jets import CanonicalFrame
from polyfit.network import (
    PatchFit,
    linear,
    load_into,
    normalised_layer,
    pointwise,
    read_weights,
    subsampled,
    write_weights,
)

WEIGHTS_VERSION = 1


class Regressor(torch.nn.Module):
    """What both have in common: the PCA frame before, the layers from a patch's feature to alpha,
    the files of weights. ``points`` of each patch are read.
    """

    def __init__(self, order, points, feature, hidden=64):
        super().__init__()
        self.order, self.points = order, points
        self.head = torch.nn.Sequential(
            torch.nn.LayerNorm(feature),
            *normalised_layer(feature, hidden),
            *normalised_layer(hidden, hidden),
            torch.nn.Linear(hidden, jets.size_of(order)),
        )
        with torch.no_grad():
            self.head[-1].weight.mul_(0.1)

    def alpha(self, x, mask=None):
        """alpha (B, A) of patches x (B, P, 3) in the charts of their PCA frames."""
        return self.head(
            self.feature(subsampled(x.to(self.head[-1].weight.dtype), self.points, mask))
        )

    def forward(self, points, *, mask=None):
        """:class:`PatchFit` of patches ``points`` (B, P, 3) in any unit and frame."""
        frame = CanonicalFrame.from_points(points, mask)
        alpha = self.alpha(frame.to_chart(points), mask)
        return PatchFit(
            frame, jets.JetFit(alpha, torch.full((len(alpha),), self.order, device=alpha.device))
        )

    @classmethod
    def load(cls, path, order=None):
        """The network with the weights of the file ``path``. Raises InputError where they are no
        such, of another version, or not for ``order``.
        """
        weights, about = read_weights(path, cls.__name__.lower(), WEIGHTS_VERSION)
        if order is not None and about["order"] != order:
            raise InputError(f"{path}: weights for jets of order {about['order']}, not {order}")
        model = cls(about["order"])
        load_into(model, weights, path)
        return model.eval()

    def save(self, path, **about):
        """Writes the weights to ``path`` (safetensors), with what they are for, and ``about``,
        inside.
        """
        write_weights(
            path,
            self.state_dict(),
            dict(
                model=type(self).__name__.lower(),
                version=WEIGHTS_VERSION,
                order=self.order,
                **about,
            ),
        )


class PointNet(Regressor):
    """Each point alone through ``widths``, the maximum over points, two layers."""

    def __init__(self, order=4, points=64, widths=(32, 64, 128)):
        super().__init__(order, points, widths[-1])
        self.local = pointwise(widths)

    def feature(self, x):
        return self.local(x).amax(1)


class DGCNN(Regressor):
    """EdgeConv layers over the ``neighbours`` nearest points, anew in each layer's features; their
    outputs together through one more layer, the maximum over points, two layers.
    """

    def __init__(self, order=4, points=64, widths=(32, 64), neighbours=8, feature=128):
        super().__init__(order, points, feature)
        self.neighbours = neighbours
        entries = [3, *widths[:-1]]
        # an edge's layer on (x_i, x_j - x_i) is linear in both: one product a point instead of one
        # an edge
        self.centre = torch.nn.ModuleList(linear(e, w) for e, w in zip(entries, widths))
        self.edge = torch.nn.ModuleList(linear(e, w) for e, w in zip(entries, widths))
        self.last = linear(sum(widths), feature)

    def feature(self, x):
        outputs = []
        for centre, edge in zip(self.centre, self.edge):
            x = edge_convolution(x, nearest(x, self.neighbours), centre, edge)
            outputs.append(x)
        return torch.relu(self.last(torch.cat(outputs, -1))).amax(1)


def nearest(x, count):
    """Indices (B, P, count) of the nearest points of each of x (B, P, C), itself among them."""
    with torch.no_grad():
        return torch.cdist(x, x).topk(min(count, x.shape[1]), largest=False).indices


def edge_convolution(x, neighbours, centre, edge):
    """max_j relu(centre(x_i) + edge(x_j - x_i)) over the ``neighbours`` (B, P, k) of each of x (B,
    P, C): (B, P, W).
    """
    y = torch.nn.functional.linear(x, edge.weight)
    with torch.no_grad():  # which neighbour is highest; gradients then pass through these alone
        at = neighbours.flatten(1)[..., None].expand(-1, -1, y.shape[-1])
        which = neighbours.gather(
            2, y.gather(1, at).unflatten(1, neighbours.shape[1:]).max(2).indices
        )
    return torch.relu(centre(x) + edge.bias + y.gather(1, which) - y)
