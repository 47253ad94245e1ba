"""AtlasNet's autoencoder with square charts (Groueix et al. 2018; paper, section "Experiments"): a
PointNet encodes a surface, K small networks map a square each to a piece of it.
"""

import itertools

import torch

from polyfit.errors import InputError
from polyfit.network import load_into, pointwise, read_weights, write_weights

WEIGHTS_VERSION = 1


class AtlasNet(torch.nn.Module):
    """``charts`` squares [0, 1]^2, each with a decoder of its own of ``widths``; ``latent`` numbers
    describe a surface.

    Points are in a unit of the caller's, best scaled to the unit sphere (:func:`normalised`).
    """

    def __init__(self, charts=25, latent=128, widths=(128, 64)):
        super().__init__()
        self.shape = dict(charts=charts, latent=latent, widths=list(widths))
        self.charts = charts
        self.encoder = torch.nn.Sequential(pointwise((64, 128)), torch.nn.Linear(128, latent))
        self.code = torch.nn.Linear(latent, latent)
        sizes = [latent + 2, *widths, 3]
        layers = list(itertools.pairwise(sizes))
        self.weights = torch.nn.ParameterList(
            torch.randn(charts, i, o) * ((1 if o == 3 else 2) / i) ** 0.5 for i, o in layers
        )
        self.biases = torch.nn.ParameterList(torch.zeros(charts, 1, o) for o in sizes[1:])

    def encode(self, points):
        """Codes (B, latent) of surfaces given by points (B, P, 3)."""
        return self.code(torch.relu(self.encoder(points).amax(1)))

    def decode(self, code, uv):
        """Points (B, charts, Q, 3) of the codes (B, latent) at ``uv`` (charts, Q, 2) of every
        chart.
        """
        # the first layer is linear in the code and in uv: the code's part is the same for all of a
        # chart's points
        first, latent = self.weights[0], code.shape[-1]
        x = torch.einsum("bl,klw->bkw", code, first[:, :latent])[:, :, None] + (
            uv @ first[:, latent:] + self.biases[0]
        )
        for weight, bias in zip(list(self.weights)[1:], list(self.biases)[1:]):
            x = torch.relu(x) @ weight + bias
        return x

    def forward(self, points, per_chart, generator=None):
        """Points (B, charts * per_chart, 3) of the reconstruction of ``points`` (B, P, 3), at
        random places of every chart.
        """
        uv = torch.rand(self.charts, per_chart, 2, generator=generator).to(points)
        return self.decode(self.encode(points), uv).flatten(1, 2)

    def grid(self, code, side):
        """Points (B, charts, side^2, 3) at a regular grid over every chart, borders included."""
        line = torch.linspace(0, 1, side, dtype=code.dtype, device=code.device)
        uv = (
            torch.stack(torch.meshgrid(line, line, indexing="ij"), -1)
            .reshape(1, -1, 2)
            .expand(self.charts, -1, -1)
        )
        return self.decode(code, uv)

    @classmethod
    def load(cls, path):
        """The network with the weights of the file ``path``. Raises InputError where they are no
        such, or of another version.
        """
        weights, about = read_weights(path, "atlasnet", WEIGHTS_VERSION)
        model = cls(**about["network"])
        load_into(model, weights, path)
        return model.eval()

    def save(self, path, **about):
        """Writes the weights to ``path`` (safetensors), with what they are for, and ``about``,
        inside.
        """
        write_weights(
            path,
            self.state_dict(),
            dict(model="atlasnet", version=WEIGHTS_VERSION, network=self.shape, **about),
        )


def normalised(points):
    """(points, centre, scale): points (..., P, 3) in the unit sphere about the centre (..., 1, 3)
    of their bounding box; scale (..., 1, 1).
    """
    if not points.isfinite().all():
        raise InputError("points that are not finite")
    centre = (points.amax(-2, keepdim=True) + points.amin(-2, keepdim=True)) / 2
    scale = (points - centre).norm(dim=-1, keepdim=True).amax(-2, keepdim=True)
    return (points - centre) / scale, centre, scale


def chamfer(a, b):
    """Symmetric Chamfer distance (B,), the sum of both mean squared distances, of points a (B, P,
    3) and b (B, Q, 3); differentiable.
    """
    # which is nearest; the distances are taken again, exactly and with gradients
    with torch.no_grad():
        d = torch.cdist(a, b)
        to_b, to_a = d.argmin(2), d.argmin(1)
    gathered = [y.gather(1, i[..., None].expand(-1, -1, 3)) for y, i in ((b, to_b), (a, to_a))]
    return (a - gathered[0]).square().sum(-1).mean(1) + (b - gathered[1]).square().sum(-1).mean(1)
