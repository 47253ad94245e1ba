"""Training by physics: Adam on the objective of drapes in windows of motions."""

import json
import math
import os
import sys
from dataclasses import asdict, fields
from functools import partial

import torch

from onefit.garment import Garment
from onefit.garment.sewing.cuts import cuts
from onefit.motion import Motion
from onefit.network import OneFit
from onefit.network.weights import load, save
from onefit.objective import objective
from polyfit.errors import InputError
from polyfit.training import Training, conduct

from .data import FPS, TrainingData
from .teacher import lessons

GRADIENT_NORM = 1.0  # gradients are clipped to it
BAD_STEPS = 20  # in a row without a finite loss, after which a training is given up
LESSON_UNIT = 0.01  # [m] of a vertex from where its lesson has it, that a loss of 1 stands for
HIDDEN_NOISE = 0.1  # standard deviation of the encoder's memory at the start of a window


class OneFitTraining(Training):
    """Adam on one garment after the other, in windows of motions drawn at random."""

    def __init__(self, settings, data, processes):
        self.given, self.data, self.bad, self.last = settings, data, 0, 0.0
        torch.manual_seed(settings.seed)
        network = load(settings.start).network if settings.start else _network(settings, data)
        plain = json.loads(json.dumps(asdict(settings)))
        network = network.to(processes.device).train()
        self.lessons = [
            lessons(settings.teacher, patched) if settings.teacher else ()
            for patched, *_ in data.garments
        ]
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
        number = self.done % len(self.data.garments) if garment is None else garment
        garment, rest, field = self.data.garments[number]
        count = self._windows(garment, self.processes)
        if self.given.teacher:
            windows, wanted = self.data.lesson_windows(self.lessons[number], count, generator)
        else:
            windows = self.data.windows(count, generator)
        hidden = HIDDEN_NOISE * torch.randn(
            1, len(windows.number), self.network.body.memory.hidden_size, generator=generator
        )
        mine = slice(self.processes.rank, None, self.processes.count)
        windows = type(windows)(*(getattr(windows, f.name)[mine] for f in fields(windows)))
        hidden = hidden.to(self.processes.device)[:, mine].contiguous()
        Z_T = self.network.patches(*garment.features, self.data.standard.joints)
        Z_B, _ = self.network.body(windows.poses, windows.translation, windows.shape, FPS, hidden)
        if self.given.teacher:
            found = garment.changes(self.network.decoder(Z_T, Z_B[:, -1]))
            away = garment.displacement(found - wanted[:, :, mine].to(found))
            return {"regression": away.square().sum(-1).mean() / LESSON_UNIT**2}
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
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_NORM)
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
        print(f"step {self.done}: {', '.join(wrong)} not finite, skipped", file=sys.stderr)
        if self.bad >= BAD_STEPS:
            raise InputError(f"{self.bad} steps in a row were not finite; a lower --lr may help")
        return dict(loss=self.last, stepped_over=1.0)


def _network(settings, data):
    return OneFit(settings.order, len(data.standard.joints), data.shapes.shape[1])


def data_of(settings, folder, progress):
    """The :class:`TrainingData` of ``settings``; what is sewn goes into ``folder``."""
    # what can be wrong first, then what takes long
    garments = [Garment.named(name) for name in settings.garments]
    motions = [
        Motion.read(path, settings.fps, settings.motion_up) for path in settings.motions
    ] or None
    if settings.start:
        load(settings.start)
    if settings.cuts:
        task = progress.add_task("cuts sewn", total=settings.cuts)
        garments += cuts(
            settings.cuts,
            os.path.join(folder, "cuts"),
            settings.seed,
            partial(progress.advance, task),
        )
    task = progress.add_task("garments", total=len(garments))
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
            settings, data_of(settings, folder, progress).to(processes.device), processes
        )

    return conduct(
        make, folder, device=device, resume=resume, until=until, every=every, command=command
    )
