"""What every training here does: steps that can be interrupted, resumed and shared by several
processes, a log, and what made the weights.
"""

import contextlib
import json
import math
import platform
import time
from pathlib import Path

import torch

from polyfit.errors import InputError
from polyfit.files import aside, folder_for
from polyfit.network import load_into, read_weights, write_weights

from .processes import Processes

_CHECKPOINT_VERSION = 1  # of the form of a checkpoint
_STEPS_PER_LOG_LINE = 50


class Training:
    """One training: its ``network``, its ``optimiser``, how many of its ``steps`` are ``done``.
    ``settings``: all that decides the result, as JSON gives it back. Subclasses have
    :meth:`update`, whose random numbers come from :meth:`generator` alone, and take of each batch
    the share of their process. So a resumed training, and one on several processes, do what one
    process does without interruption.
    """

    def __init__(self, network, optimiser, settings, processes, steps):
        self.network, self.optimiser, self.settings, self.processes = (
            network,
            optimiser,
            settings,
            processes,
        )
        self.steps, self.done, self.seconds = steps, 0, 0.0

    def update(self):
        """One step of the optimiser; what it lowered, as a dict of numbers with the sum as
        ``loss``.
        """
        raise NotImplementedError

    def write_weights(self, path):
        """The trained network as a file."""
        raise NotImplementedError

    def generator(self):
        """The random numbers of this step."""
        return torch.Generator().manual_seed(
            self.settings["seed"] * 1_000_003 + 7919 * self.done + 1
        )

    def step(self):
        start = time.perf_counter()
        figures = self.update()
        self.done += 1
        self.seconds += time.perf_counter() - start
        return figures

    # ---- checkpoints -----------------------------------------------------------------------------

    def save(self, path):
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        for k, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{k}.{name}": value for name, value in state.items()}
        progress = dict(done=self.done, seconds=self.seconds)
        write_weights(
            path,
            tensors,
            dict(
                model="checkpoint", version=_CHECKPOINT_VERSION, settings=self.settings, **progress
            ),
        )

    def restore(self, path):
        """Goes on from a checkpoint. Raises InputError where it was made with other settings."""
        tensors, about = read_weights(path, "checkpoint", _CHECKPOINT_VERSION)
        other = [
            f"{k} {about['settings'].get(k)}"
            for k, v in self.settings.items()
            if about["settings"].get(k) != v
        ]
        if other:
            raise InputError(
                f"{path}: a checkpoint of other settings ({', '.join(other)}); give the same, or"
                " another -o"
            )
        load_into(
            self.network, {k[8:]: v for k, v in tensors.items() if k.startswith("network.")}, path
        )
        state = {}
        for k, v in tensors.items():
            if k.startswith("adam."):
                _, index, name = k.split(".")
                state.setdefault(int(index), {})[name] = v
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": state})
        self.done, self.seconds = about["done"], about["seconds"]

    # ---- the loop --------------------------------------------------------------------------------

    def run(self, folder, end, every, advance):
        """Steps up to ``end``, with a line of ``folder``/log.jsonl every so many and a
        checkpoint every so many seconds, at the end, and at Ctrl-C. ``advance()`` is called after
        each step. Raises InputError where the loss is not finite.
        """
        checkpoint, first = folder / "checkpoint.safetensors", self.processes.rank == 0
        saved, lines = time.monotonic(), []
        with contextlib.ExitStack() as stack:
            file = (
                stack.enter_context(open(folder / "log.jsonl", "a", encoding="utf-8"))
                if first
                else None
            )
            try:
                while self.done < end:
                    lines.append(self.step())
                    advance()
                    if not math.isfinite(lines[-1]["loss"]):
                        raise InputError(
                            f"the loss is {lines[-1]['loss']} at step {self.done}; a lower --lr may"
                            " help"
                        )
                    if first and (self.done % _STEPS_PER_LOG_LINE == 0 or self.done == end):
                        file.write(json.dumps(self._line(lines)) + "\n")
                        file.flush()
                        lines.clear()
                    if first and time.monotonic() - saved > every:
                        self.save(checkpoint)
                        saved = time.monotonic()
            except KeyboardInterrupt:
                if first:
                    self.save(checkpoint)
                raise
            if first:
                self.save(checkpoint)

    def _line(self, lines):
        names = list(dict.fromkeys(name for line in lines for name in line))
        means = {
            name: sum(found) / len(found)
            for name in names
            if (found := [line[name] for line in lines if name in line])
        }
        return dict(
            step=self.done,
            **means,
            lr=self.optimiser.param_groups[0]["lr"],
            seconds=round(self.seconds, 2),
        )

    def write_about(self, path, command):
        """The JSON file that says what made the weights."""
        device = self.processes.device.type
        about = dict(
            command=command, **{"steps": self.steps} | self.settings,
            processes=self.processes.count, minutes=round(self.seconds / 60, 2),
            machine=f"{platform.machine()}, {device}, {torch.get_num_threads()} threads a process",
            torch=torch.__version__, date=time.strftime("%Y-%m-%d"),
            parameters=sum(p.numel() for p in self.network.parameters()),
        )  # fmt: skip
        with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
            json.dump(about, file, indent=2)
            file.write("\n")


def conduct(make, folder, *, device="cpu", resume=False, until=None, every=120.0, command=None):
    """Trains what ``make(folder, processes, progress)`` gives, a :class:`Training`, and leaves its
    weights in ``folder``; returns their path.

    ``until`` (steps) ends early, with a checkpoint and no weights (None); ``every`` [s]
    checkpoints; ``progress`` is a rich.progress.Progress. Raises InputError for a folder that holds
    weights or a checkpoint already, or nothing to ``resume``.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    folder = Path(folder)
    checkpoint, weights = folder / "checkpoint.safetensors", folder / "weights.safetensors"
    if resume and not checkpoint.exists():
        raise InputError(f"{checkpoint}: no such file, nothing to resume")
    for path in (weights, checkpoint):
        if not resume and path.exists():
            raise InputError(f"{path}: exists; give another -o, or --resume")
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    processes = Processes(device)
    try:
        with (
            folder_for(folder),
            Progress(
                *columns, console=Console(stderr=True), disable=processes.rank > 0
            ) as progress,
        ):
            training = make(folder, processes, progress)
            if resume:
                training.restore(checkpoint)
            task = progress.add_task("steps", total=training.steps, completed=training.done)
            end = min(until or training.steps, training.steps)
            training.run(folder, end, every, lambda: progress.update(task, completed=training.done))
        if training.done < training.steps:
            return None
        if processes.rank == 0:
            training.write_weights(weights)
            training.write_about(weights.with_suffix(".json"), command)
        processes.wait()
        return weights
    finally:
        processes.close()
