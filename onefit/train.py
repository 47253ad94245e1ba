"""Trains OneFit: without any data but garments and motions, by physics (paper, section "OneFit").

    python -m onefit.train [GARMENT ...] -o OUT [--motions FILE ...] [--from WEIGHTS] [--resume]
    torchrun --nproc-per-node 2 -m onefit.train ...

GARMENT are names of the package's templates (tshirt, dress, ...) or meshes (.obj, .ply); without
any, the six templates of the paper. OUT receives

    weights.safetensors     the trained network, for ``onefit.load``, and weights.json: what made it
    log.jsonl               a line every 50 steps: the loss and each of its terms
    cuts/                   with --cuts: what was sewn, a file each
    checkpoint.safetensors  every few minutes and at Ctrl-C; --resume goes on from it and ends
                            where an uninterrupted run would have
"""

import argparse
import json
import math
import os
import shlex
import sys
from dataclasses import asdict, dataclass, field, fields
from functools import partial

from polyfit.errors import InputError, cli, optional_imports

with optional_imports(__name__):
    import torch

    from onefit.network.weights import load, save
    from onefit.objective import Weights
    from polyfit.training import Training, conduct, device_of

STANDARD = ("tshirt", "dress", "trousers", "shorts", "long_sleeve_top", "tank")
CLIP = 1.0  # of the gradient's norm
BAD = 20  # steps in a row without a finite loss, after which a training is given up
HIDDEN = 0.1  # standard deviation of the encoder's memory at the start of a window


@dataclass(frozen=True)
class Settings:
    """What decides the result. ``fps`` and ``motion_up``: of the files of ``motions``, as
    :meth:`onefit.Motion.read` takes them; ``batch``: patches of a step, all frames together
    (the paper's 20,000); ``lr`` for the first ``lr_epochs`` epochs, a tenth of it for the rest; an
    epoch has ``epoch_steps`` steps (0: as many as show each window of the motions once); ``cuts``:
    how many random cuts (:mod:`onefit.garment.sewing.cuts`) are trained on beside the garments.
    """

    garments: tuple = STANDARD
    motions: tuple = ()
    fps: float | None = None
    motion_up: str | None = None
    start: str = ""
    order: int = 4
    batch: int = 20_000
    epochs: int = 30
    lr_epochs: int = 10
    epoch_steps: int = 0
    lr: float = 1e-3
    seeds: int = 4
    shapes: int = 48
    cuts: int = 0
    seed: int = 0
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self):
        for name in ("batch", "epochs", "seeds"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)}: 1 at least")
        for name in ("epoch_steps", "lr_epochs", "shapes", "cuts"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} = {getattr(self, name)}: 0 at least")
        if not 2 <= self.order <= 10:
            raise InputError(f"order = {self.order}; the order of OneFit's jets is 2 to 10")
        if not self.lr > 0:
            raise InputError(f"lr = {self.lr}: more than 0")


class OneFitTraining(Training):
    """Adam on one garment after the other, in windows of motions drawn at random."""

    def __init__(self, settings, data, processes):
        self.given, self.data, self.bad, self.last = settings, data, 0, 0.0
        torch.manual_seed(settings.seed)
        network = load(settings.start).network if settings.start else _network(settings, data)
        plain = json.loads(json.dumps(asdict(settings)))
        network = network.to(processes.device).train()
        windows = min(self._windows(garment, processes) for garment, *_ in data.garments)
        self.epoch_steps = settings.epoch_steps or -(-len(data) // windows)
        super().__init__(
            network,
            torch.optim.Adam(network.parameters(), settings.lr),
            plain,
            processes,
            settings.epochs * self.epoch_steps,
        )

    def write_weights(self, path):
        save(path, self.network, self.data.model, self.given.garments)

    def _windows(self, garment, processes):
        """Windows of a step, so that it has about ``batch`` patches, and each process the same
        number of windows.
        """
        count = processes.count
        return max(1, round(self.given.batch / len(garment) / count)) * count

    def loss(self, generator, garment=None):
        """The objective's terms on a batch of the random numbers of ``generator``: this process's
        share of it.
        """
        from onefit.objective import objective
        from onefit.training.data import FPS

        garment, rest, field = self.data.garments[
            self.done % len(self.data.garments) if garment is None else garment
        ]
        windows = self.data.windows(self._windows(garment, self.processes), generator)
        hidden = HIDDEN * torch.randn(
            1, len(windows.number), self.network.body.memory.hidden_size, generator=generator
        )
        mine = slice(self.processes.rank, None, self.processes.count)
        windows = type(windows)(*(getattr(windows, f.name)[mine] for f in fields(windows)))
        hidden = hidden.to(self.processes.device)[:, mine].contiguous()
        Z_T = self.network.patches(*garment.features, self.data.standard.joints)
        Z_B, _ = self.network.body(windows.poses, windows.translation, windows.shape, FPS, hidden)
        scene, before = self.data.scene(windows, rest, field)
        changes = [garment.changes(self.network.decoder(Z_T, Z_B[:, -k])) for k in (2, 3)]
        past = [
            objective.vertices(garment, c, scene.rest, transforms)
            for c, transforms in zip(changes, before)
        ]
        deformation = self.network.decoder(Z_T, Z_B[:, -1])
        epoch = self.done // self.epoch_steps
        return objective.evaluate(
            garment, deformation, scene, self.given.weights, epoch, past, 1 / FPS, generator
        )[0]

    def update(self):
        epoch = self.done // self.epoch_steps
        for group in self.optimiser.param_groups:
            group["lr"] = self.given.lr * (1.0 if epoch < self.given.lr_epochs else 0.1)
        terms = self.loss(self.generator())
        total = sum(terms.values())
        self.optimiser.zero_grad()
        total.backward()
        figures = self.processes.mean(
            {"loss": total.item(), **{name: value.item() for name, value in terms.items()}}
        )
        self.processes.average(self.network)
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP)
        if not (math.isfinite(figures["loss"]) and norm.isfinite()):
            return self._stepped_over(figures)
        self.bad, self.last = 0, figures["loss"]
        self.optimiser.step()
        return figures

    def _stepped_over(self, figures):
        self.bad += 1
        wrong = [
            name for name, value in figures.items() if name != "loss" and not math.isfinite(value)
        ] or ["the gradient"]
        print(f"step {self.done}: {', '.join(wrong)} not finite, stepped over", file=sys.stderr)
        if self.bad >= BAD:
            raise InputError(f"{self.bad} steps in a row were not finite; a lower --lr may help")
        return dict(loss=self.last, stepped_over=1.0)


def _network(settings, data):
    from onefit.network import OneFit

    return OneFit(settings.order, len(data.standard.joints), data.shapes.shape[1])


def _data(settings, folder, progress):
    from onefit.garment import TEMPLATES, Garment
    from onefit.garment.sewing.cuts import cuts
    from onefit.motion import Motion
    from onefit.training import TrainingData

    garments = [
        Garment.template(name) if name in TEMPLATES else Garment.read(name)
        for name in settings.garments
    ]
    if settings.cuts:
        task = progress.add_task("cuts sewn", total=settings.cuts)
        garments += cuts(
            settings.cuts,
            os.path.join(folder, "cuts"),
            settings.seed,
            partial(progress.advance, task),
        )
    task = progress.add_task("garments", total=len(garments))
    motions = [
        Motion.read(path, settings.fps, settings.motion_up) for path in settings.motions
    ] or None
    return TrainingData(
        garments, motions=motions, seeds=settings.seeds, shapes=settings.shapes,
        order=settings.order, seed=settings.seed, advance=partial(progress.advance, task),
    )  # fmt: skip


def train(settings, folder, *, device="cpu", resume=False, until=None, every=120.0, command=None):
    """Trains and leaves weights in ``folder``; returns their path. ``until`` (steps) ends early,
    with a checkpoint and no weights (None); ``every`` [s] checkpoints.
    """

    def make(folder, processes, progress):
        return OneFitTraining(
            settings, _data(settings, folder, progress).to(processes.device), processes
        )

    return conduct(
        make, folder, device=device, resume=resume, until=until, every=every, command=command
    )


def parser():
    p = argparse.ArgumentParser(prog="python -m onefit.train", description=__doc__.splitlines()[0])
    default = Settings()
    p.add_argument(
        "garments",
        nargs="*",
        metavar="GARMENT",
        help="templates or meshes (default: the paper's six templates)",
    )
    p.add_argument("-o", "--output", required=True, metavar="OUT", help="folder of the results")
    p.add_argument(
        "--motions",
        nargs="+",
        default=[],
        metavar="FILE",
        help="AMASS, NCS or BVH files (default: generated ones)",
    )
    p.add_argument(
        "--fps", type=float, help="frames a second of the motion files, in place of what they say"
    )
    p.add_argument(
        "--motion-up",
        choices=("y", "z"),
        help="the axis that points up in the motion files, in place of what their kind has",
    )
    p.add_argument(
        "--from",
        dest="start",
        default="",
        metavar="WEIGHTS",
        help="weights to fine-tune, a file or a name of the package's",
    )
    for name, text in {
        "order": "of the jets", "batch": "patches of a step, all frames together", "epochs": "",
        "lr-epochs": "epochs with the full rate, a tenth of it after",
        "epoch-steps": "steps of an epoch, 0: each window of the motions once",
        "seeds": "generated motions of each kind",
        "shapes": "random bodies beside the standard one",
        "cuts": "random cuts of the templates' patterns to train on beside the garments",
        "seed": "",
    }.items():  # fmt: skip
        value = getattr(default, name.replace("-", "_"))
        p.add_argument(
            f"--{name}", type=int, default=value, help=f"{text} (default: {value})".strip()
        )
    p.add_argument("--lr", type=float, default=default.lr, help=f"of Adam (default: {default.lr})")
    group = p.add_argument_group("the losses' weights (0 switches one off)")
    for f in fields(Weights):
        group.add_argument(
            f"--{f.name.replace('_', '-')}",
            type=float,
            default=f.default,
            help=f"(default: {f.default})",
        )
    p.add_argument("--checkpoint-every", type=float, default=120.0, metavar="SECONDS")
    p.add_argument("--resume", action="store_true", help="go on from OUT/checkpoint.safetensors")
    p.add_argument(
        "--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu or cuda"
    )
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    weights = Weights(**{f.name: getattr(args, f.name) for f in fields(Weights)})
    values = {f.name: getattr(args, f.name) for f in fields(Settings) if f.name != "weights"}
    values |= dict(garments=tuple(args.garments) or STANDARD, motions=tuple(args.motions))
    command = "python -m onefit.train " + shlex.join(sys.argv[1:] if argv is None else argv)
    settings = Settings(**values, weights=weights)
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
