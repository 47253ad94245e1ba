"""Train PolyFit's spatial transformer, or a network that it is compared with.

    python -m polyfit.train [MESH ...] -o OUT [--model polyfit] [--steps 2500] [--resume]
                            [--families jet trigonometric gaussian bessel]
    torchrun --nproc-per-node 2 -m polyfit.train ...

Each MESH is a garment (.obj, .ply, .glb). It is cut into patches, which are deformed at random.
Without any, the training sees the analytic families alone. OUT receives

    weights.safetensors     the trained network, for ``PolyFit.load``
    weights.json            what made it
    log.jsonl               a line every so many steps
    checkpoint.safetensors  every few minutes and at Ctrl-C; --resume goes on from it and ends
                            where an uninterrupted run would have
    set.safetensors         the patches (polyfit.training.training_set), for --resume
"""

import os
import shlex
import sys
from dataclasses import fields

from .errors import Parser, cli, optional_imports

with optional_imports(__name__):
    from .training import MODELS, Settings, add_run_arguments, run, train


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
        type=int,
        default=list(default.cuts),
        help="numbers of patches; each mesh is cut into each",
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
        help=f"Adam's rate, which falls to a hundredth as a cosine (default: {default.lr})",
    )
    add_run_arguments(p)
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
    run(train, settings, args, command)


if __name__ == "__main__":
    cli(main)
