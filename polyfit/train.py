"""Train PolyFit's spatial transformer, or a network that it is compared with.

    python -m polyfit.train [MESH ...] -o OUT [--model polyfit] [--steps 2500] [--resume]
                            [--families jet trigonometric gaussian bessel]
    python -m polyfit.train MESH ... -o OUT --preset paper    # as the paper trains
    python -m polyfit.train MESH ... -o OUT --from polyfit    # fine-tuning
    torchrun --nproc-per-node 2 -m polyfit.train ...

Each MESH is a garment (.obj, .ply, .glb). It is cut into patches, which are deformed at random; by
the paper's preset they stay as they are.
Without any, the training sees the analytic families alone. OUT receives

    weights.safetensors     the trained network, for ``PolyFit.load``
    weights.json            what made it
    log.jsonl               a line every so many steps
    checkpoint.safetensors  every few minutes and at Ctrl-C; --resume goes on from it and ends
                            where an uninterrupted run would have
    set.safetensors         the patches (polyfit.training.training_set), for --resume
"""

import argparse
import os
import shlex
import sys
from dataclasses import fields

from .errors import Parser, cli, optional_imports

with optional_imports(__name__):
    from .training import LOSSES, MODELS, PRESETS, Settings, add_run_arguments, run, train


def parser():
    p = Parser(prog="python -m polyfit.train", description=__doc__.splitlines()[0])
    default = Settings()
    p.add_argument(
        "meshes", nargs="*", metavar="MESH", help="garments (.obj, .ply, .glb) to cut and deform"
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
        type=_cut,
        default=list(default.cuts),
        metavar="N",
        help="numbers of patches, or paper, its number by the area; each mesh is cut into each",
    )
    p.add_argument(
        "--from",
        dest="start",
        default="",
        metavar="WEIGHTS",
        help="weights to fine-tune: a file, or polyfit or paper, those of the package",
    )
    p.add_argument(
        "--loss",
        choices=LOSSES,
        default=default.loss,
        help="axes: a table of heights and normals; height: the paper's (default: axes)",
    )
    p.add_argument(
        "--subdivided", type=int, metavar="N", help="subdivide meshes N times before they are cut"
    )
    for name, text in {
        "order": "of the jets", "patches": "of the training set", "points": "kept of each patch",
        "reads": "points that the network reads", "steps": "of the optimiser",
        "batch": "patches a step", "turns": "quaternions that the network answers with",
        "charts": "of AtlasNet", "seed": "of all random numbers",
    }.items():  # fmt: skip
        value = getattr(default, name)
        p.add_argument(f"--{name}", type=int, default=value, help=f"{text} (default: {value})")
    for name, text in {"lr": "Adam's rate", "garment-share": "of the patches"}.items():
        value = getattr(default, name.replace("-", "_"))
        p.add_argument(f"--{name}", type=float, default=value, help=f"{text} (default: {value})")
    for name, text in {
        "pca": "PCA's frame is one of the network's answers",
        "acvd": "cut by plain ACVD",
        "deformed": "garments' patches go through random maps",
        "decay": "the rate falls to a hundredth as a cosine",
    }.items():
        p.add_argument(
            f"--{name}",
            action=argparse.BooleanOptionalAction,
            default=getattr(default, name),
            help=text,
        )
    p.add_presets(PRESETS)
    add_run_arguments(p)
    return p


def _cut(text):
    if text != "paper" and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: numbers of patches, or paper, are needed")
    return text if text == "paper" else int(text)


def main(argv=None):
    args = parser().parse_args(argv)
    values = {f.name: getattr(args, f.name) for f in fields(Settings)}
    settings = Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    names = [
        os.path.basename(a) if a in args.meshes else a
        for a in (sys.argv[1:] if argv is None else argv)
    ]
    command = "python -m polyfit.train " + shlex.join(names)
    run(train, settings, args, command)


if __name__ == "__main__":
    cli(main)
