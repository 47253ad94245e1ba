"""The networks that ``polyfit_accuracy.py`` compares: those that are trained for it, and two that
learned nothing.
"""

import json
import subprocess
import sys
from pathlib import Path

import torch
from polyfit_held_out import HELD_OUT
from sequences import ROOT

from polyfit import jets
from polyfit.errors import InputError
from polyfit.jets import CanonicalFrame
from polyfit.network import PRETRAINED, PatchFit, SpatialTransformer
from polyfit.training.training_set import axes, rotations_to

TRAINED_ON = [
    f"garments_makehuman/{name}.obj"
    for name in ("f_tshirt", "f_shorts", "f_leggings", "m_sweater", "m_trousers", "m_tshirt_fine")
]
SHORT = ["--steps", "800", "--patches", "15000"]
ATLASNET = ["--model", "atlasnet", "--batch", "8", "--steps", "1000"]
TRAININGS = {  # folder in RUNS: options of python -m polyfit.train, whether on garments
    "main": ([], True),
    "paper": (["--preset", "paper"], True),
    "pointnet": (["--model", "pointnet"], True),
    "dgcnn": (
        ["--model", "dgcnn", "--steps", "600"],
        True,
    ),  # a step takes four times as long: as much time as the others
    "gaussian": (["--families", "gaussian", *SHORT], False),
    "families": (SHORT, False),
    "garments": (SHORT, True),
    "tuned": (
        ["--from", "RUNS/families/weights.safetensors", "--steps", "200", "--patches", "2000"],
        True,
    ),  # after families
    **{
        f"atlasnet{charts}": ([*ATLASNET, "--charts", str(charts)], True) for charts in (5, 25, 125)
    },
}
ORDER = 4


class Tilted(torch.nn.Module):
    """A transformer that has learned nothing: the turns that training starts from."""

    def __init__(self, points=64):
        super().__init__()
        fresh = SpatialTransformer(points=points)
        self.points, self.turns = (
            points,
            torch.nn.functional.normalize(
                fresh.head[-1].bias.detach().unflatten(0, (-1, 4)), dim=-1
            ),
        )

    def forward(self, x, mask=None):
        return torch.cat([torch.tensor([[0.0, 0, 0, 1]]), self.turns]).expand(len(x), -1, -1)


class BestAxis:
    """What an exhaustive search over 65 axes reaches, by the height of the fit: the most that any
    transformer can.
    """

    def __call__(self, points):
        frame = CanonicalFrame.from_points(points)
        x = frame.to_chart(points)
        heights = []
        for turn in rotations_to(axes()):
            y = x @ turn
            heights.append(
                (jets.height(jets.fit(y, ORDER).alpha, y[..., :2]) - y[..., 2]).square().mean(-1)
            )
        R = frame.R @ rotations_to(axes())[torch.stack(heights, 1).argmin(1)]
        frame = CanonicalFrame(frame.s, R, frame.T)
        return PatchFit(frame, jets.fit(frame.to_chart(points), ORDER))


def trained(runs, name, load):
    path = Path(runs) / name / "weights.safetensors"
    if not path.exists():
        return None
    made = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    seen = {Path(m).name for m in made["meshes"]} & {Path(m).name for m in HELD_OUT}
    if seen:
        raise InputError(
            f"{path}: trained on {', '.join(sorted(seen))}, which this benchmark holds out"
        )
    return load(path, ORDER)


def making(runs):
    """What made each of the networks that are there: steps, batch, minutes, machine."""
    found = {}
    for name in TRAININGS:
        path = Path(runs) / name / "weights.json"
        if name == "main" and not path.exists():
            path = PRETRAINED["polyfit"].with_suffix(".json")
        if path.exists():
            about = json.loads(path.read_text(encoding="utf-8"))
            kept = ("command", "steps", "batch", "patches", "minutes", "machine", "date")
            found[name] = {key: about[key] for key in kept}
            found[name]["command"] = about["command"].replace(str(runs), "RUNS")
    return found


def train_missing(data, runs, only=tuple(TRAININGS), say=print):
    """Train those of the networks ``only`` that RUNS lacks."""
    for name, (options, on_garments) in TRAININGS.items():
        if name in only and not (Path(runs) / name / "weights.safetensors").exists():
            meshes = [str(Path(data) / m) for m in TRAINED_ON] if on_garments else []
            options = [option.replace("RUNS", str(runs)) for option in options]
            say(f"training {name}")
            subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "polyfit.train",
                    *meshes,
                    "-o",
                    str(Path(runs) / name),
                    *options,
                ],
                check=True,
                cwd=ROOT,
            )
