"""Trains PolyFit's spatial transformer, or a network that it is held against.

    python -m polyfit.train [MESH ...] -o OUT [--model polyfit] [--families jet trigonometric
    gaussian bessel] [--steps 2500] [--resume] torchrun --nproc-per-node 2 -m polyfit.train ...

MESH are garments (.obj, .ply), cut into patches and deformed at random; without any, the analytic
families are all there is. OUT receives

    weights.safetensors     the trained network, for ``PolyFit.load``
    weights.json            what made it
    log.jsonl               a line every so many steps
    checkpoint.safetensors  every few minutes and at Ctrl-C; --resume goes on from it and ends
                            where an uninterrupted run would have
    set.safetensors         the patches (polyfit.training_set), for --resume
"""

import argparse
import json
import math
import os
import shlex
import sys
from dataclasses import asdict, dataclass, fields

from .errors import InputError, cli, optional_imports
from .meshio import read_mesh

with optional_imports(__name__):
    import torch

    from . import families, garments, training_set
    from .baselines.atlasnet import AtlasNet, chamfer, normalised
    from .baselines.regressors import DGCNN, PointNet
    from .losses import discrepancy
    from .stn import PolyFit, SpatialTransformer
    from .training import Training, conduct, device_of
    from .weights import read_weights, write_weights

VERSION = 1  # of the training sets
MODELS = ("polyfit", "pointnet", "dgcnn", "atlasnet")
SAMPLES = 256  # points that are made of each patch
# height [s] by which one turn must be better than another to be chosen e times as likely, in
# training
CHOICE = 0.01
SHARPNESS = (15.0, 80.0)  # of the table's smoothing over directions, at the start and at the end
ATLAS_POINTS = 1000  # of a garment, and of its reconstruction


@dataclass(frozen=True)
class Settings:
    """What decides the result. ``cuts``: the numbers of patches that each mesh is cut into;
    ``points`` are kept of each patch and ``reads`` of them read in a step.
    """

    model: str = "polyfit"
    order: int = 4
    families: tuple = families.FAMILIES
    meshes: tuple = ()
    cuts: tuple = (6, 10, 16, 25, 40, 60, 100)
    patches: int = 30_000
    points: int = 128
    reads: int = 64
    steps: int = 2500
    batch: int = 512
    lr: float = 1e-3
    charts: int = 25
    seed: int = 0

    def __post_init__(self):
        if self.model not in MODELS:
            raise InputError(f"model {self.model}: choose among {', '.join(MODELS)}")
        unknown = sorted(set(self.families) - set(families.FAMILIES))
        if unknown:
            raise InputError(
                f"families {', '.join(unknown)}: choose among {', '.join(families.FAMILIES)}"
            )
        for name in ("patches", "points", "reads", "steps", "batch", "charts"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)}: 1 at least")
        if not 1 <= self.order <= 10:
            raise InputError(f"order = {self.order}; the order of a jet is 1 to 10")
        if not self.lr > 0:
            raise InputError(f"lr = {self.lr}: more than 0")
        if self.points > SAMPLES or self.reads > self.points:
            raise InputError(
                f"reads {self.reads}, points {self.points}: at most points, at most {SAMPLES}"
            )
        if not self.meshes and (not self.families or self.model == "atlasnet"):
            raise InputError(
                "nothing to train on: give meshes"
                + ("" if self.model == "atlasnet" else ", or families")
            )

    def network(self):
        if self.model == "polyfit":
            return PolyFit(self.order, SpatialTransformer(points=self.reads))
        return (
            {"pointnet": PointNet, "dgcnn": DGCNN}[self.model](self.order)
            if self.model != "atlasnet"
            else AtlasNet(self.charts)
        )


class PolyFitTraining(Training):
    """Adam with a rate that falls as a cosine, on the batches of ``data``."""

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
            group["lr"] = s.lr * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * share)))
        loss = self.data.loss(self.network, s, share, self.generator(), self.processes)
        self.optimiser.zero_grad()
        loss.backward()
        self.processes.average(self.network)
        self.optimiser.step()
        return self.processes.mean(dict(loss=loss.item()))


class _Patches:
    """Batches of a :class:`training_set.TrainingSet`, and the losses of the networks that see
    patches.
    """

    def __init__(self, patches):
        self.patches = patches
        gain = (patches.loss[:, 0] - patches.loss.amin(1)).cpu().to(torch.float64)
        self.likely = gain / gain.sum() + 1 / len(gain)

    def loss(self, network, settings, share, generator, processes):
        if settings.model != "polyfit":
            index = torch.randint(len(self.patches), (settings.batch,), generator=generator)
            return self._of_regressor(
                network, index[processes.rank :: processes.count].to(processes.device)
            )
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
            SHARPNESS[0] + (SHARPNESS[1] - SHARPNESS[0]) * min(1, 1.2 * share),
        )
        # the turn of least height is kept; here softly, so that all of them learn which patches are
        # theirs
        return (torch.softmax(-height / CHOICE, 1) * loss).sum(1).mean()

    def _of_regressor(self, network, index):
        x = self.patches.points[index]
        d = discrepancy(network.alpha(x), x, self.patches.normals[index])
        return (d.height + training_set.NORMALS * (1 - d.cosine)).mean()


class _Garments:
    """Whole garments, deformed at random, for AtlasNet: points (M, Q, 3) of each."""

    def __init__(self, points):
        self.points = points

    def loss(self, network, settings, share, generator, processes):
        from . import deformations

        index = torch.randint(len(self.points), (settings.batch,), generator=generator)
        maps = deformations.random(
            settings.batch, generator, bend=1.0, waves=2, frequency=(1.0, 3.0)
        )
        read = torch.randint(
            self.points.shape[1], (settings.batch, ATLAS_POINTS), generator=generator
        )
        x = normalised(maps(self.points[index].gather(1, read[..., None].expand(-1, -1, 3))))[0]
        x = x[processes.rank :: processes.count].to(processes.device)
        return chamfer(network(x, math.ceil(ATLAS_POINTS / settings.charts), generator), x).mean()


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
        import numpy as np

        generator, points = np.random.default_rng(settings.seed), []
        for path in settings.meshes:
            vertices, faces = read_mesh(path)[:2]
            points.append(
                garments.GarmentPatches.cut(
                    vertices, faces, None, 64, generator, str(path)
                ).points.flatten(0, 1)
            )
        least = min(len(p) for p in points)
        return _Garments(
            normalised(
                torch.stack([p[torch.linspace(0, len(p) - 1, least).long()] for p in points])
            )[0]
        )
    path = folder / "set.safetensors"
    names = [f.name for f in fields(training_set.TrainingSet)]
    wanted = {
        k: v
        for k, v in _plain(settings).items()
        if k in ("order", "families", "meshes", "cuts", "patches", "points", "seed")
    }
    if processes.rank == 0 and not (
        path.exists() and read_weights(path, "training set", VERSION)[1]["settings"] == wanted
    ):
        cut = (
            garments.cut_meshes(settings.meshes, settings.cuts, SAMPLES, settings.seed)
            if settings.meshes
            else None
        )
        task = progress.add_task("patches", total=settings.patches)
        made = training_set.build(
            settings.patches, settings.points, settings.order, settings.seed, garments=cut,
            names=settings.families, device=processes.device,
            advance=lambda done: progress.update(task, completed=done),
        )  # fmt: skip
        write_weights(
            path,
            {name: getattr(made, name) for name in names},
            dict(model="training set", version=VERSION, settings=wanted),
        )
    processes.wait()
    tensors, _ = read_weights(path, "training set", VERSION)
    return _Patches(
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


def parser():
    p = argparse.ArgumentParser(prog="python -m polyfit.train", description=__doc__.splitlines()[0])
    default = Settings()
    p.add_argument(
        "meshes", nargs="*", metavar="MESH", help="garments (.obj, .ply) to cut and deform"
    )
    p.add_argument("-o", "--output", required=True, metavar="OUT", help="folder of the results")
    p.add_argument(
        "--model", default=default.model, help=f"{', '.join(MODELS)} (default: {default.model})"
    )
    p.add_argument(
        "--families",
        nargs="*",
        default=list(default.families),
        help="analytic functions that are summed (default: all four)",
    )
    p.add_argument(
        "--cuts",
        nargs="+",
        type=int,
        default=list(default.cuts),
        help="numbers of patches that each mesh is cut into",
    )
    for name in ("order", "patches", "points", "reads", "steps", "batch", "charts", "seed"):
        p.add_argument(
            f"--{name}",
            type=int,
            default=getattr(default, name),
            help=f"(default: {getattr(default, name)})",
        )
    p.add_argument(
        "--lr",
        type=float,
        default=default.lr,
        help=f"of Adam, falling to a hundredth as a cosine (default: {default.lr})",
    )
    p.add_argument("--checkpoint-every", type=float, default=120.0, metavar="SECONDS")
    p.add_argument("--resume", action="store_true", help="go on from OUT/checkpoint.safetensors")
    p.add_argument(
        "--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu or cuda"
    )
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    values = {f.name: getattr(args, f.name) for f in fields(Settings)}
    settings = Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    names = [
        os.path.basename(a) if a in args.meshes else a
        for a in (sys.argv[1:] if argv is None else argv)
    ]
    command = "python -m polyfit.train " + shlex.join(names)
    path = train(
        settings,
        args.output,
        device=device_of(args.device),
        resume=args.resume,
        every=args.checkpoint_every,
        command=command,
    )
    if path and int(os.environ.get("RANK", 0)) == 0:
        print(path)


if __name__ == "__main__":
    cli(main)
