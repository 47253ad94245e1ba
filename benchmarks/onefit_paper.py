"""The paper's tables of OneFit, from networks that its preset trained.

    python benchmarks/onefit_paper.py RUNS --commands                  # every training's command
    python benchmarks/onefit_paper.py RUNS --train tank dress          # makes those that RUNS lacks
    python benchmarks/onefit_paper.py RUNS --train tank --short 60     # minutes, not hours
    python benchmarks/onefit_paper.py RUNS -o docs                     # the tables of what is there

A training that was cut short goes on from its checkpoint. ``--short N`` has twelve epochs of N
steps, of 2,000 patches each. Those of ``docs`` are by 60; by 240 for ``tank-longer`` and the other
tanks of that name; and by 600 for ``dress-longer``.
``package`` is the network ``paper`` of the package, ``--train six --short 600``; it needs no RUNS.
Everything is measured on motions and bodies that no network was trained on (as by
``onefit_accuracy.py``), and is what the network alone makes: without ease and post-processing.
*ε_c*: % of the vertices inside the body; *ε_e*, *ε_a*: mean % by which edges and faces change.

Writes ``onefit_paper.json``; rows whose networks RUNS lacks stay in it as they are. The poses are
shown in ``paper_poses.jpg``, each in the frame that is farthest from the first.
"""

import argparse
import json
import shlex
import time
from pathlib import Path

import onefit_accuracy as accuracy

import onefit
from onefit import train
from onefit.draping.output import BODY_COLOUR, GARMENT_COLOURS
from onefit.garment import Garment, standard_body
from onefit.garment.fitting import pushed_out
from onefit.garment.sewing.block import Block
from onefit.garment.sewing.sew import sewn
from onefit.network import EXTRAS, weights
from onefit.training import STANDARD
from polyfit.errors import cli
from polyfit.files import aside

# arguments of python -m onefit.train, beside -o and --preset paper
TRAININGS = {
    "six": [],
    "dress": ["dress"],
    "tank": ["tank"],
    "tank-no-mesh-inext": ["tank", "--k-mi", "0"],
    "tank-no-inext": ["tank", "--k-i", "0"],
    "tank-no-col": ["tank", "--k-c", "0"],
    "tank-pca": ["tank", "--frames", "pca"],
    "tank-no-boundary": ["tank", "--k-b", "0", "--k-bn", "0"],
    "tank-ours": ["tank", "--extras", *EXTRAS, "--frames", "pca", "--no-acvd"],
    "jumpsuit": ["jumpsuit"],
    "jumpsuit-tuned": ["jumpsuit", "--from", "RUNS/six/weights.safetensors", "--epochs", "12"],
}
LOSSES = {
    "all losses": "tank",
    "no mesh inextensibility": "tank-no-mesh-inext",
    "no inextensibility": "tank-no-inext",
    "no collision": "tank-no-col",
    "no boundary": "tank-no-boundary",
    "frames by PCA alone": "tank-pca",
    "with our inputs and patches": "tank-ours",
}
LONGER = "-longer"  # the same training of more steps
TRAININGS |= {name + LONGER: TRAININGS[name] for name in ("dress", *LOSSES.values())}
PACKAGE = "package"  # the package's network by the preset
SHORT = ["--epochs", "12", "--batch", "2000"]
STYLES = {  # of the tank top: measures of its pattern [m]
    "as trained": {},
    "cropped": dict(hem=0.12),
    "long": dict(hem=-0.10),
    "low neck": dict(front=0.37, back=0.44, narrow=4),
    "loose": dict(ease=0.015, waist_ease=0.03),
}
POSES = (("dress", "kick"), ("tank", "bend"), ("trousers", "lunge"), ("tshirt", "arms_up"))
COUNTS = (1000, 4000, 16_000, 63_000)  # vertices
PICTURE = (480, 320)  # of a pose: height and width [pixels]


def arguments(name, runs, short=None):
    """Those of ``python -m onefit.train`` for the training ``name``; ``short``: steps an epoch."""
    flags = [flag.replace("RUNS", str(runs)) for flag in TRAININGS[name]]
    fewer = [*SHORT, "--epoch-steps", str(short)] if short else []
    return [*flags, "-o", str(Path(runs) / name), "--preset", "paper", *fewer]


def make(name, runs, short):
    """Train what RUNS lacks, and what this one starts from first."""
    folder = Path(runs) / name
    if (folder / "weights.safetensors").exists():
        return
    flags = arguments(name, runs, short)
    if "--from" in flags:
        make(Path(flags[flags.index("--from") + 1]).parent.name, runs, short)
    print(f"training {name}", flush=True)
    train.main(flags + ["--resume"] * (folder / "checkpoint.safetensors").exists())


class Bench:
    """The networks of a folder, and what they make of garments."""

    def __init__(self, runs, seconds, shapes, docs):
        self.runs, self.seconds, self.shapes, self.docs = Path(runs), seconds, shapes, Path(docs)
        self.drapers = {}

    def path(self, name):
        """The weights of the network ``name``, which may not be there."""
        if name == PACKAGE:
            return weights.FOLDER / "paper.safetensors"
        return self.runs / name / "weights.safetensors"

    def has(self, name):
        return self.path(name).exists()

    def draper(self, name):
        if name not in self.drapers:
            self.drapers[name] = onefit.load(self.path(name))
        return self.drapers[name]

    def figures(self, name, garment):
        """ε_c, ε_e and ε_a of the network ``name`` alone."""
        draper = self.draper(name)
        found = accuracy.row(
            draper, draper.garment(garment), self.seconds, self.shapes, post=False, eased=False
        )
        return {key: found[key] for key in ("collision", "edge", "area")}

    def trained(self):
        made = {}
        for name in filter(self.has, (*TRAININGS, PACKAGE)):
            about = json.loads(self.path(name).with_suffix(".json").read_text(encoding="utf-8"))
            kept = ("command", "steps", "batch", "minutes", "machine", "processes", "date")
            made[name] = {key: about[key] for key in kept}
            made[name]["command"] = about["command"].replace(str(self.runs), "RUNS")
        return made

    def collisions(self):
        """Trained on a dress, and on six garments."""
        return {
            name: {garment: self.figures(name, garment)["collision"] for garment in STANDARD}
            for name in ("dress", "dress" + LONGER, "six", PACKAGE)
            if self.has(name)
        }

    def jumpsuit(self):
        names = filter(self.has, ("six", PACKAGE, "jumpsuit-tuned", "jumpsuit"))
        return {name: self.figures(name, "jumpsuit")["collision"] for name in names}

    def losses(self, ending=""):
        of = {row: name + ending for row, name in LOSSES.items()}
        return {row: self.figures(name, "tank") for row, name in of.items() if self.has(name)}

    def losses_longer(self):
        return self.losses(LONGER)

    def styles(self):
        """The tank top's network on tank tops of other cuts."""
        tank = "tank" + LONGER
        if not self.has(tank):
            return {}
        body = standard_body()
        block, found = Block(body.vertices.numpy(), body.faces.numpy()), {}
        for style, measures in STYLES.items():
            V, F = sewn(block, "tank", **measures)[:2]
            garment = Garment.bound(f"tank, {style}", *pushed_out(V, F)[:1], F)
            found[style] = self.figures(tank, garment)
        return found

    def poses(self):
        """Each garment in a demanding motion, of a seed that no training uses."""
        draper, found, drapes = self.draper(PACKAGE), {}, []
        for garment, kind in POSES:
            motion = onefit.Motion.generate(kind, seconds=self.seconds, seed=accuracy.SEED)
            drape = draper.drape(garment, motion, post=False, eased=False)
            found[f"{garment}, {kind}"] = drape.measures().collision
            drapes.append(drape)
        show(drapes, self.docs / "paper_poses.jpg")
        return found

    def resolutions(self):
        """The T-shirt at several resolutions: ε_c, seconds to cut it, and milliseconds a frame of
        the least of five drapes, vertices included.
        """
        draper, rows = self.draper(PACKAGE), []
        motion = onefit.Motion.generate("walk", seconds=self.seconds, seed=accuracy.SEED)
        for count in COUNTS:
            garment, start = draper.garment("tshirt").remeshed(count), time.perf_counter()
            patches, cut = len(draper.patched(garment)), time.perf_counter() - start
            times = []
            for _ in range(5):
                start = time.perf_counter()
                drape = draper.drape(garment, motion, post=False, eased=False)
                times.append(1e3 * (time.perf_counter() - start) / len(drape.vertices))
            rows.append(
                dict(
                    vertices=len(garment),
                    patches=patches,
                    cut_seconds=cut,
                    ms=min(times),
                    collision=drape.measures().collision,
                )
            )
        return rows


def show(drapes, path):
    """A picture of each drape, side by side: the frame whose body is farthest from the first's."""
    from polyfit.backend import set_variant

    set_variant()
    import cv2
    import numpy as np

    from polyfit.pictures import stage

    row, colour = [], GARMENT_COLOURS[0]
    for drape in drapes:
        body = drape.body - drape.root[:, None]
        k = int((body - body[0]).norm(dim=-1).mean(1).argmax())
        shown = (drape.body, drape.body_faces, BODY_COLOUR), (drape.vertices, drape.faces, colour)
        meshes = [(x[k : k + 1].numpy(), faces.numpy(), of) for x, faces, of in shown]
        row += stage.render(meshes, size=PICTURE, spp=64)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
    cv2.imwrite(str(path), np.hstack(row)[..., ::-1], quality)


TABLES = (
    "trained",
    "collisions",
    "jumpsuit",
    "losses",
    "losses_longer",
    "styles",
    "poses",
    "resolutions",
)


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", metavar="RUNS", help="folder of the trainings")
    parser.add_argument("--commands", action="store_true", help="print the trainings' commands")
    parser.add_argument(
        "--train", nargs="+", metavar="NAME", choices=TRAININGS, help="train, measure nothing"
    )
    parser.add_argument(
        "--short", type=int, metavar="N", help="12 epochs of N steps of 2,000 patches: minutes"
    )
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--seconds", type=float, default=2.0, help="of each motion (default: 2)")
    parser.add_argument("--shapes", type=int, default=4, help="random bodies (default: 4)")
    parser.add_argument("-o", "--output", default="out/benchmarks")
    args = parser.parse_args(argv)
    if args.commands:
        for name in TRAININGS:
            flags = arguments(name, args.runs, args.short)
            print("python -m onefit.train " + shlex.join(flags))
        return
    if args.train:
        for name in args.train:
            make(name, args.runs, args.short)
        return
    path = Path(args.output)
    path.mkdir(parents=True, exist_ok=True)
    bench = Bench(args.runs, args.seconds, args.shapes, path)
    path /= "onefit_paper.json"
    report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name in args.tables:
        found = getattr(bench, name)()
        print(f"{name}: {json.dumps(found, indent=1)}" if found else f"{name}: no network for it")
        if isinstance(found, dict):
            found = report.get(name, {}) | found
        if found:
            report[name] = found
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump(report, file, indent=1)
        file.write("\n")
    print(f"written: {path}")


if __name__ == "__main__":
    cli(main)
