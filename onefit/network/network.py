"""The network: patches and the body's motion in, the patches' deformation out (paper, section
"OneFit", and supplement).

jets, orientations, places of the patches ─► PatchEncoder ─► Z_T ─┐
poses, shape, root velocity ─► BodyEncoder ─────────────────► Z_B ┴─► Decoder ─► Deformation
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import nn

from onefit.body import skeleton
from onefit.garment import Deformation
from polyfit import jets

GRAVITY = (0.0, 0.0, -1.0)  # unit, world
LEAKY_SLOPE = 0.1  # of the leaky ReLUs
_MEMORY = 40.0  # frames that the slowest units of the memory keep, at first: a skirt's swing
# What the network has beyond the paper's:
#   drift: a displacement of each patch that the cloth around it shares
#   looseness, held, blend_weights: inputs of a patch; where "held" is not, there is no waistband
#   whole: the mean over all patches of the garment, added to the code of each
#   free_heading: where the body faces tells nothing
#   memory: the root's velocity as an input of the dynamic encoder, and biases that keep it longer
EXTRAS = ("drift", "looseness", "held", "blend_weights", "whole", "free_heading", "memory")
# Deformations that a unit of the decoder's output stands for: coefficients and translation in units
# of the patch's radius, scale as a logarithm, drift in units of the patch's room.
_OUTPUT_UNIT = {"alpha": 0.2, "translation": 0.3, "scale": 0.05, "drift": 1.0}


def layers(widths, bias=True, last=True):
    """Fully connected layers with LeakyReLU between them, and after the last one if ``last``."""
    out = []
    for i, (a, b) in enumerate(itertools.pairwise(widths)):
        linear = nn.Linear(a, b, bias=bias)
        nn.init.kaiming_normal_(linear.weight, LEAKY_SLOPE, nonlinearity="leaky_relu")
        if bias:
            nn.init.zeros_(linear.bias)
        out.append(linear)
        if last or i + 2 < len(widths):
            out.append(nn.LeakyReLU(LEAKY_SLOPE, inplace=True))
    return nn.Sequential(*out)


def encoded(x, octaves):
    """Positional encoding (Mildenhall et al. 2020) of x (..., D) [m]: x and its sines and cosines
    at wavelengths of 2 m / 2^i, (..., D (1 + 2 octaves))."""
    waves = x[..., None] * (math.pi * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device))
    return torch.cat([x, waves.sin().flatten(-2), waves.cos().flatten(-2)], -1)


class PatchEncoder(nn.Module):
    """Z_T (K, width) of a garment's patches: an MLP, with skip connections, of the jet, the
    orientation, the encoded centre and its encoded offsets from the joints (the paper's), and as
    ``extras`` say of how the patch hangs on the body, and of all patches together: a skirt is no
    trouser leg.
    """

    def __init__(self, order, joints, width=128, hidden=256, octaves=(6, 3), extras=EXTRAS):
        super().__init__()
        self.octaves, self.extras = octaves, extras
        size = (
            jets.size_of(order)
            + 7
            + 3 * (1 + 2 * octaves[0])
            + 3 * joints * (1 + 2 * octaves[1])
            + 3 * ("looseness" in extras)
            + ("held" in extras)
            + joints * ("blend_weights" in extras)
        )
        self.first = layers([size, hidden, hidden])
        self.second = layers([size + hidden, hidden, hidden])
        self.last = layers([size + hidden, width], last=False)
        if "whole" in extras:
            self.whole = layers([hidden, hidden, width], last=False)
            nn.init.zeros_(self.whole[-1].weight)

    def forward(self, alpha, orientation, centre, looseness, held, blend_weights, joints):
        """Of jets (K, A), orientations (K, 7), centres (K, 3) [m], looseness (K, 3), held (K, 1),
        blend weights (K, J), as :attr:`onefit.PatchedGarment.features` has them, and joints
        (J, 3) [m] of the standard body.
        """
        offsets = centre[:, None] - joints
        places = encoded(centre, self.octaves[0]), encoded(offsets, self.octaves[1]).flatten(1)
        more = dict(looseness=looseness, held=held, blend_weights=blend_weights)
        more = [value for name, value in more.items() if name in self.extras]
        x = torch.cat([alpha, orientation, *places, *more], -1)
        y = self.second(torch.cat([x, self.first(x)], -1))
        code = self.last(torch.cat([x, y], -1))
        return code + self.whole(y.mean(0)) if "whole" in self.extras else code


def descriptors(poses):
    """Of poses (..., J, 3) with parents ``skeleton.PARENTS``: each joint's rotation from its parent
    as 6 numbers (Zhou et al. 2019) and gravity's direction in its own frame, (..., J, 9)."""
    local = _matrices(poses)
    everywhere = skeleton.chained(local)
    gravity = everywhere.new_tensor(GRAVITY)
    return torch.cat([local[..., :2].transpose(-1, -2).flatten(-2), gravity @ everywhere], -1)


def _matrices(rotvec):
    """Rotations (..., 3, 3) of axis-angle vectors (..., 3) [rad]."""
    import roma

    return roma.rotvec_to_rotmat(rotvec)


class BodyEncoder(nn.Module):
    """Z_B (..., width) of a moving body: static and dynamic encodings of its poses (Bertiche et al.
    2022), shape and root velocity, and the five layers that join them. Of ``extras``, with "memory"
    the memory sees the root's velocity too: a jump lifts a skirt. With "free_heading" where the
    body faces tells nothing. Where it is never does.
    """

    def __init__(self, joints, shape, width=256, extras=EXTRAS):
        super().__init__()
        self.extras = extras
        self.static = layers([9 * joints, 64, 128, 256, 512])
        self.local = layers([9, 32, 32], bias=False)
        keeps = "memory" in extras
        self.moving = layers([32 * joints + 3 * keeps, 512, 512], bias=False)
        self.memory = nn.GRU(512, 512, batch_first=True, bias=keeps)
        if keeps:
            _keep(self.memory)
        self.join = layers([512 + 512 + shape + 3, 256, 256, 256, 256, width], last=False)

    def forward(self, poses, translation, shape, fps, hidden=None):
        """Of windows of poses (B, L, J, 3), root translations (B, L, 3) [m], shapes (B, S) less the
        standard one, frames a second.

        Returns Z_B (B, L, width) and the memory to go on with. ``hidden``: that memory; None starts
        from rest. In the first frame of a window without memory the body is taken to be at rest.
        """
        x = descriptors(poses)
        velocity = torch.nn.functional.pad(translation.diff(dim=1), (0, 0, 1, 0)) * fps
        change = torch.nn.functional.pad(x.diff(dim=1), (0, 0, 0, 0, 1, 0))
        seen = x
        if "free_heading" in self.extras:
            root = _matrices(poses[..., 0, :])
            velocity = (velocity[..., None, :] @ root)[..., 0, :]
            change, seen = self._seen_from_the_root(change, root), self._without_heading(x)
        moving = self.local(change * fps).flatten(-2)
        if "memory" in self.extras:
            moving = torch.cat([moving, velocity], -1)
        moving, memory = self.memory(self.moving(moving), hidden)
        shape = shape[:, None].expand(*x.shape[:2], -1)
        still = self.static(seen.flatten(-2))
        return self.join(torch.cat([still, moving, shape, velocity], -1)), memory

    @staticmethod
    def _without_heading(x):
        """Descriptors (B, L, J, 9) with the root's rotation left out; gravity tells its tilt."""
        kept = torch.ones_like(x[0, 0])
        kept[0, :6] = 0
        return x * kept

    @staticmethod
    def _seen_from_the_root(steps, root):
        """Differences in time (B, L, J, 9) of descriptors, with that of the root's rotations
        (B, L, 3, 3) as it is seen from the root.
        """
        turn = root[:, :-1].mT @ root[:, 1:] - torch.eye(3, device=root.device)
        turn = torch.nn.functional.pad(turn[..., :2].mT.flatten(-2), (0, 0, 1, 0))
        first = torch.cat([turn, steps[:, :, 0, 6:]], -1)
        return torch.cat([first[:, :, None], steps[:, :, 1:]], 2)


def _keep(gru):
    """Biases of a GRU whose units keep 1 to _MEMORY frames (Tallec and Ollivier 2018). Without any,
    all of them forget half in a frame, and nothing can swing.
    """
    for bias in (gru.bias_ih_l0, gru.bias_hh_l0):
        nn.init.zeros_(bias)
    _, update, _ = gru.bias_ih_l0.data.chunk(3)
    update.copy_(torch.linspace(1, _MEMORY, len(update) + 1)[1:].sub(1).log().clamp(min=0))


class Decoder(nn.Module):
    """Z_T and Z_B to a :class:`Deformation`: layers of 512, 512, 512 and 256, and heads (128, 64).
    Without "drift" among ``extras``, as in the paper, each patch moves for itself.
    """

    def __init__(self, order, patch=128, body=256, extras=EXTRAS):
        super().__init__()
        self.of_patch, self.of_body = nn.Linear(patch, 512), nn.Linear(body, 512, bias=False)
        self.trunk = layers([512, 512, 512, 256])
        sizes = {"alpha": jets.size_of(order), "translation": 3, "scale": 1}
        if "drift" in extras:
            sizes["drift"] = 3
        self.heads = nn.ModuleDict(
            {name: layers([256, 128, 64, size], last=False) for name, size in sizes.items()}
        )
        for head in self.heads.values():  # an untrained network is plain skinning
            nn.init.zeros_(head[-1].weight)

    def forward(self, Z_T, Z_B):
        """Of patches Z_T (K, patch) and frames Z_B (T, body)."""
        # the first layer is linear in both: no concatenation of each patch with each frame is
        # needed
        x = nn.functional.leaky_relu(self.of_patch(Z_T) + self.of_body(Z_B)[:, None], LEAKY_SLOPE)
        x = self.trunk(x)
        out = {name: head(x) * _OUTPUT_UNIT[name] for name, head in self.heads.items()}
        drift = out.get("drift", torch.zeros_like(out["translation"]))
        return Deformation(out["alpha"], out["translation"], out["scale"][..., 0], drift)


class OneFit(nn.Module):
    """One network for any garment: ``patches``, ``body`` and ``decoder``. ``order`` of the jets,
    ``joints`` and ``shape``: how many of both the body has. ``extras``: which of :data:`EXTRAS` it
    has; () is the paper's network. ``frames``, ``acvd``: of the patches that it knows, as in
    :class:`onefit.PatchedGarment`.
    """

    def __init__(
        self,
        order: int = 4,
        joints: int = 24,
        shape: int = 6,
        extras: Sequence[str] = EXTRAS,
        frames: str = "pca",
        acvd: bool = False,
    ) -> None:
        super().__init__()
        extras = tuple(extras)
        self.shape = dict(
            order=order, joints=joints, shape=shape, extras=list(extras), frames=frames, acvd=acvd
        )
        self.order = order
        #: how a garment is cut for it: arguments of :class:`onefit.PatchedGarment`
        self.patching = dict(order=order, frames=frames, acvd=acvd, waistband="held" in extras)
        self.patches = PatchEncoder(order, joints, extras=extras)
        self.body = BodyEncoder(joints, shape, extras=extras)
        self.decoder = Decoder(order, extras=extras)
