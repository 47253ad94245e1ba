"""Training by physics: Adam on the objective of drapes in windows of motions."""

import json
import math
import os
import sys
from dataclasses import asdict, fields
from functools import partial
from hashlib import sha256

import torch

from onefit.garment import Garment
from onefit.garment.sewing.cuts import cuts
from onefit.motion import Motion
from onefit.network import OneFit
from onefit.network.weights import load, save
from onefit.objective import material, objective
from polyfit.errors import InputError
from polyfit.training import Training, conduct

from .data import FPS, LESSON_FRAMES, TrainingData
from .settings import STANDARD
from .teacher import garment_of, lessons, taught

_GRADIENT_NORM = 1.0  # gradients are clipped to it
BAD_STEPS = 20  # in a row without a finite loss, after which a training is given up
_LESSON_UNIT = 0.01  # [m] of a vertex from where its lesson has it, that a loss of 1 stands for
_HIDDEN_NOISE = 0.1  # standard deviation of the encoder's memory at the start of a window


class OneFitTraining(Training):
    """Adam on one garment after the other, in windows of motions drawn at random."""

    def __init__(self, settings, data, processes):
        self.given, self.data, self.bad, self.last = settings, data, 0, 0.0
        torch.manual_seed(settings.seed)
        network = (
            load(settings.start).network
            if settings.start
            else _network(settings, len(data.standard.joints), data.shapes.shape[1])
        )
        plain = json.loads(json.dumps(asdict(settings) | dict(objective=settings.lowered)))
        plain["meshes"] = [f"{one.name} {_digest(one)}" for one in self._own()]
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
        save(path, self.network, self.data.model, [one.name for one in self._own()])

    def _own(self):
        """The garments that were given: those before the cuts."""
        count = len(self.data.garments) - self.given.cuts
        return [patched.garment for patched, *_ in self.data.garments[:count]]

    def _windows(self, garment, processes):
        """Windows of a step, so that it has about ``batch`` patches, and each process the same
        number of windows.
        """
        count, frames = processes.count, LESSON_FRAMES if self.given.teacher else 1
        return max(1, round(self.given.batch / len(garment) / frames / count)) * count

    def loss(self, generator, garment=None):
        """The objective's terms on a batch of the random numbers of ``generator``: this process's
        share of it.
        """
        if self.given.teacher:
            return self._of_lessons(generator, garment)
        number = self.done % len(self.data.garments) if garment is None else garment
        garment, rest, _ = self.data.garments[number]
        windows = self.data.windows(self._windows(garment, self.processes), generator)
        windows, Z_T, Z_B, _ = self._encoded(garment, windows, generator)
        frame = lambda k: (windows.poses[:, -k], windows.translation[:, -k], windows.number)
        past = [
            objective.vertices(
                garment,
                garment.changes(self.network.decoder(Z_T, Z_B[:, -k])),
                rest[:, windows.number],
                self.data.transforms(*frame(k)),
            )
            for k in (2, 3)
        ]
        deformation = self.network.decoder(Z_T, Z_B[:, -1])
        return self._terms(number, deformation, frame(1), past, generator)[0]

    def _of_lessons(self, generator, number):
        """The same of lessons: the objective without inertia, which they have, and how far the
        vertices are from where they have them. Garments are drawn by the frames of their lessons.
        """
        if number is None:
            number = int(torch.multinomial(self.data.lesson_frames, 1, generator=generator))
        garment, rest, _ = self.data.garments[number]
        count = self._windows(garment, self.processes)
        windows, asked, wanted = self.data.lesson_windows(number, count, generator)
        windows, Z_T, Z_B, mine = self._encoded(garment, windows, generator)
        asked = asked[mine].to(Z_B.device)
        wanted = wanted.unflatten(1, (count, -1))[:, mine].flatten(1, 2).to(Z_B)
        chosen = lambda x: x[torch.arange(len(asked))[:, None], asked].flatten(0, 1)
        frame = (
            chosen(windows.poses),
            chosen(windows.translation),
            windows.number.repeat_interleave(asked.shape[1]),
        )
        deformation = self.network.decoder(Z_T, chosen(Z_B))
        terms, x = self._terms(number, deformation, frame, None, generator)
        there = objective.posed(
            rest[:, frame[2]] + wanted, garment.garment.blend_weights, self.data.transforms(*frame)
        )
        away = (x - there).square().sum(-1).mean() / _LESSON_UNIT**2
        return terms | {"regression": self.given.weights.k_t * away}

    def _encoded(self, garment, windows, generator):
        """This process's share of the windows, Z_T, Z_B, and which windows are its own."""
        hidden = _HIDDEN_NOISE * torch.randn(
            1, len(windows.number), self.network.body.memory.hidden_size, generator=generator
        )
        mine = slice(self.processes.rank, None, self.processes.count)
        windows = type(windows)(*(getattr(windows, f.name)[mine] for f in fields(windows)))
        hidden = hidden.to(self.processes.device)[:, mine].contiguous()
        Z_T = self.network.patches(*garment.features, self.data.standard.joints)
        Z_B, _ = self.network.body(windows.poses, windows.translation, windows.shape, FPS, hidden)
        return windows, Z_T, Z_B, mine

    def _terms(self, number, deformation, frame, past, generator):
        """The terms of the objective that is asked for, and the vertices (N, T, 3) [m], in frames
        of (poses, translation, number of the shape).
        """
        garment, scene = self.data.garments[number][0], self.data.scene(number, *frame)
        if self.given.lowered == "material":
            sheets = self.data.sheets(number, frame[2])
            return material.evaluate(
                garment, deformation, scene, sheets, self.given.weights, past, 1 / FPS, generator
            )
        epoch = self.done // self.epoch_steps
        return objective.evaluate(
            garment, deformation, scene, self.given.weights, epoch, past, 1 / FPS, generator
        )

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
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), _GRADIENT_NORM)
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


def _digest(garment):
    """A few digits that tell a garment's mesh from another one of the same name."""
    arrays = (x.cpu().numpy().tobytes() for x in (garment.vertices, garment.faces))
    return sha256(b"".join(arrays)).hexdigest()[:12]


def _network(settings, joints, shape):
    s = settings
    return OneFit(s.order, joints, shape, s.extras, s.frames, s.acvd)


def data_of(settings, folder, progress):
    """The :class:`TrainingData` of ``settings``; what is sewn goes into ``folder``."""
    # what can be wrong first, then what takes long
    if settings.teacher:
        named = settings.garments or taught(settings.teacher)
        garments = [garment_of(settings.teacher, name) for name in named]
    else:
        garments = Garment.all_named(settings.garments or STANDARD, **settings.read)
    learned = [lessons(settings.teacher, g) for g in garments] if settings.teacher else ()
    motions = [
        Motion.read(path, settings.fps, settings.motion_up) for path in settings.motions
    ] or None
    like = load(settings.start).network if settings.start else _network(settings, 24, 1)
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
        patching=like.patching, material=settings.material, lessons=learned, seed=settings.seed,
        advance=partial(progress.advance, task),
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
