"""The training of PolyFit's network, or of one that it is compared with: what it is shown, and the
loss that it lowers.
"""

import json
import math
import os
from dataclasses import asdict, fields

import numpy as np
import torch

from polyfit import jets
from polyfit.baselines import chamfer, normalised
from polyfit.jets import rotation_matrix
from polyfit.mesh import centred, read_mesh
from polyfit.network import read_weights, write_weights

from . import deformations, garments, training_set
from .loop import Training, conduct
from .losses import discrepancy
from .settings import POINTS_PER_PATCH

_TRAINING_SET_VERSION = 1  # of the files that keep one
# height [s] by which one turn must be better than another to be chosen e times as likely, in
# training
_CHOICE_HEIGHT = 0.01
# of the smoothing of the table over directions, at the start and at the end; no unit
_AXIS_SHARPNESS = (15.0, 80.0)
CLOUD_POINTS = 1000  # points of a garment, and of its reconstruction
_DECIDE_THE_SET = (
    "order", "families", "meshes", "cuts", "subdivided", "acvd", "patches", "garment_share",
    "deformed", "points", "loss", "seed",
)  # fmt: skip


class PolyFitTraining(Training):
    """Adam, with a rate that falls as a cosine or stays, on the batches of ``data``."""

    def __init__(self, settings, data, processes):
        self.given, self.data = settings, data
        torch.manual_seed(settings.seed)
        network = settings.network().to(processes.device)
        super().__init__(
            network,
            torch.optim.Adam(network.parameters(), settings.lr),
            _plain(settings),
            processes,
            settings.steps,
        )

    def write_weights(self, path):
        self.network.save(path)

    def update(self):
        s, share = self.given, self.done / self.given.steps
        for group in self.optimiser.param_groups:
            group["lr"] = s.lr * _falling(share) if s.decay else s.lr
        loss = self.data.loss(self.network, s, share, self.generator(), self.processes)
        self.optimiser.zero_grad()
        loss.backward()
        self.processes.average(self.network)
        self.optimiser.step()
        return self.processes.mean(dict(loss=loss.item()))


def _falling(share):
    """Of the rate after ``share`` of all steps: a cosine, from 1 to a hundredth."""
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * share))


class PatchBatches:
    """Batches of a :class:`training_set.TrainingSet`, and the losses of the networks that see
    patches.
    """

    def __init__(self, patches):
        self.patches = patches
        self.likely = None
        if patches.loss.shape[1]:
            gain = (patches.loss[:, 0] - patches.loss.amin(1)).cpu().to(torch.float64)
            self.likely = gain / gain.sum() + 1 / len(gain)

    def loss(self, network, settings, share, generator, processes):
        if settings.model != "polyfit" or settings.loss == "height":
            index = torch.randint(len(self.patches), (settings.batch,), generator=generator)
            index = index[processes.rank :: processes.count].to(processes.device)
            if settings.model != "polyfit":
                return self._of_regressor(network, index, settings)
            read = torch.randperm(settings.points, generator=generator)[: settings.reads]
            return self._of_heights(network, index, read.to(processes.device))
        # half of the batch in proportion to what another axis than PCA's would gain: few patches
        # are folded, and they have the most to teach
        index = torch.multinomial(
            self.likely, settings.batch, replacement=True, generator=generator
        )
        index = index[processes.rank :: processes.count].to(processes.device)
        read = torch.randperm(settings.points, generator=generator)[: settings.reads].to(
            processes.device
        )
        quaternion = network.stn(self.patches.points[index][:, read])
        height, loss = self.patches.at(
            index,
            _z_axis(quaternion),
            _AXIS_SHARPNESS[0] + (_AXIS_SHARPNESS[1] - _AXIS_SHARPNESS[0]) * min(1, 1.2 * share),
        )
        # the turn of least height is kept; here softly, so that all of them learn which patches are
        # theirs
        return (torch.softmax(-height / _CHOICE_HEIGHT, 1) * loss).sum(1).mean()

    def _of_heights(self, network, index, read):
        """The paper's: RMS of height of the jets in the frames that the network answers with; of
        several, the lower ones count most.
        """
        x = self.patches.points[index]
        y = x[:, None] @ rotation_matrix(network.stn(x[:, read]))
        residual = jets.height(jets.fit(y, network.order).alpha, y[..., :2]) - y[..., 2]
        height = (residual.square().mean(-1) + 1e-12).sqrt()
        return (torch.softmax(-height.detach() / _CHOICE_HEIGHT, 1) * height).sum(1).mean()

    def _of_regressor(self, network, index, settings):
        x = self.patches.points[index]
        d = discrepancy(network.alpha(x), x, self.patches.normals[index])
        weight = training_set.NORMAL_WEIGHT if settings.loss == "axes" else 0.0
        return (d.height + weight * (1 - d.cosine)).mean()


class GarmentBatches:
    """Whole garments, deformed at random, for AtlasNet: points (M, Q, 3) of each."""

    def __init__(self, points):
        self.points = points

    def loss(self, network, settings, share, generator, processes):
        index = torch.randint(len(self.points), (settings.batch,), generator=generator)
        maps = deformations.random(
            settings.batch, generator, bend=1.0, waves=2, frequency=(1.0, 3.0)
        )
        read = torch.randint(
            self.points.shape[1], (settings.batch, CLOUD_POINTS), generator=generator
        )
        x = normalised(maps(self.points[index].gather(1, read[..., None].expand(-1, -1, 3))))[0]
        x = x[processes.rank :: processes.count].to(processes.device)
        return chamfer(network(x, math.ceil(CLOUD_POINTS / settings.charts), generator), x).mean()


def _z_axis(quaternion):
    """Third columns (..., 3) of the rotations of unit quaternions (..., 4)."""
    x, y, z, w = quaternion.unbind(-1)
    return torch.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], -1)


def _plain(settings):
    """The settings as JSON gives them back; meshes by name, for they may lie elsewhere."""
    return json.loads(
        json.dumps(asdict(settings) | dict(meshes=[os.path.basename(m) for m in settings.meshes]))
    )


def _prepare(settings, folder, processes, progress):
    """The data that ``settings`` ask for; a training set is kept in ``folder``, and one of the same
    settings that lies there is used again.
    """
    if settings.model == "atlasnet":
        generator, points = np.random.default_rng(settings.seed), []
        for path in settings.meshes:
            vertices, faces = read_mesh(path)[:2]
            vertices = centred(vertices)[0]
            points.append(
                garments.GarmentPatches.cut(
                    vertices, faces, None, 64, generator, str(path)
                ).points.flatten(0, 1)
            )
        least = min(len(p) for p in points)
        return GarmentBatches(
            normalised(
                torch.stack([p[torch.linspace(0, len(p) - 1, least).long()] for p in points])
            )[0]
        )
    path = folder / "set.safetensors"
    names = [f.name for f in fields(training_set.TrainingSet)]
    wanted = {k: v for k, v in _plain(settings).items() if k in _DECIDE_THE_SET}
    if processes.rank == 0 and not (
        path.exists()
        and read_weights(path, "training set", _TRAINING_SET_VERSION)[1]["settings"] == wanted
    ):
        cut = None
        if settings.meshes:
            counts = [None if count == "paper" else count for count in settings.cuts]
            how = dict(levels=settings.subdivided, acvd=settings.acvd)
            cut = garments.cut_meshes(
                settings.meshes, counts, POINTS_PER_PATCH, settings.seed, **how
            )
        task = progress.add_task("patches", total=settings.patches)
        made = training_set.build(
            settings.patches, settings.points, settings.order, settings.seed, garments=cut,
            names=settings.families, garment_share=settings.garment_share,
            deformed=settings.deformed, table=settings.loss == "axes", device=processes.device,
            advance=lambda done: progress.update(task, completed=done),
        )  # fmt: skip
        write_weights(
            path,
            {name: getattr(made, name) for name in names},
            dict(model="training set", version=_TRAINING_SET_VERSION, settings=wanted),
        )
    processes.wait()
    tensors, _ = read_weights(path, "training set", _TRAINING_SET_VERSION)
    return PatchBatches(
        training_set.TrainingSet(*(tensors[name] for name in names)).to(processes.device)
    )


def train(settings, folder, *, device="cpu", resume=False, until=None, every=120.0, command=None):
    """Trains and leaves weights in ``folder``; returns their path. ``until`` (steps) ends early,
    with a checkpoint and no weights (None); ``every`` [s] checkpoints.
    """

    def make(folder, processes, progress):
        return PolyFitTraining(settings, _prepare(settings, folder, processes, progress), processes)

    return conduct(
        make, folder, device=device, resume=resume, until=until, every=every, command=command
    )
