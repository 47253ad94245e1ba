"""Trains OneFit: without any data but garments and motions, by physics (paper, section "OneFit").

    python -m onefit.train [GARMENT ...] -o OUT [--motions FILE ...] [--from WEIGHTS] [--resume]
    python -m onefit.train -o OUT --preset paper     # the paper's network, losses and schedule
    torchrun --nproc-per-node 2 -m onefit.train ...

With --teacher LESSONS the network learns simulated drapes by regression; physics alone goes on from
there with --from OUT/weights.safetensors.

GARMENT are names of the package's templates (tshirt, dress, ...) or meshes (.obj, .ply, .glb);
without any, the six templates of the paper. OUT receives

    weights.safetensors     the trained network, for ``onefit.load``, and weights.json: what made it
    log.jsonl               a line every 50 steps: the loss and each of its terms
    cuts/                   with --cuts: what was sewn, a file each
    checkpoint.safetensors  every few minutes and at Ctrl-C; --resume goes on from it and ends
                            where an uninterrupted run would have
"""

import argparse
import shlex
import sys
from dataclasses import fields

from polyfit.errors import Parser, cli, optional_imports

with optional_imports(__name__):
    from polyfit.training import add_run_arguments, run

    from .garment import FRAMES, add_mesh_arguments, read_options
    from .motion import add_file_arguments
    from .network import EXTRAS
    from .objective import Weights
    from .training import OBJECTIVES, PRESETS, Settings, train


def parser():
    p = Parser(prog="python -m onefit.train", description=__doc__.splitlines()[0])
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
    add_file_arguments(p)
    add_mesh_arguments(p)
    p.add_argument(
        "--from",
        dest="start",
        default="",
        metavar="WEIGHTS",
        help="weights to fine-tune: a file, or a name of the package's weights",
    )
    p.add_argument(
        "--teacher",
        default="",
        metavar="LESSONS",
        help="learn these lessons of onefit.teach by regression, beside the objective",
    )
    p.add_argument(
        "--objective",
        choices=OBJECTIVES,
        default="",
        help="(default: material with --teacher, else paper)",
    )
    p.add_argument(
        "--material", default=default.material, help="of the objective material (default: cotton)"
    )
    for name, text in {
        "order": "order of the jets", "epochs": "",
        "batch": "patches of a step, all frames together",
        "lr-epochs": "epochs at the full rate; later ones have a tenth of it",
        "epoch-steps": "steps of an epoch; 0: each window of the motions once",
        "seeds": "generated motions of each kind",
        "shapes": "random bodies beside the standard one",
        "cuts": "random cuts of the templates' patterns, trained on beside the garments",
        "seed": "",
    }.items():  # fmt: skip
        value = getattr(default, name.replace("-", "_"))
        p.add_argument(
            f"--{name}", type=int, default=value, help=f"{text} (default: {value})".strip()
        )
    p.add_argument(
        "--lr", type=float, default=default.lr, help=f"Adam's rate (default: {default.lr})"
    )
    group = p.add_argument_group("the network and its patches (those of --from's weights with it)")
    group.add_argument(
        "--extras",
        nargs="*",
        choices=EXTRAS,
        default=list(EXTRAS),
        help=f"what it has beyond the paper's: {', '.join(EXTRAS)} (default: all)",
    )
    group.add_argument(
        "--frames", choices=FRAMES, default=default.frames, help="of the patches (default: pca)"
    )
    group.add_argument(
        "--acvd",
        action=argparse.BooleanOptionalAction,
        default=default.acvd,
        help="garments are cut by plain ACVD",
    )
    group = p.add_argument_group("the losses' weights (0 switches one off)")
    for f in fields(Weights):
        group.add_argument(
            f"--{f.name.replace('_', '-')}",
            type=float,
            default=f.default,
            help=f"(default: {f.default})",
        )
    p.add_presets(PRESETS)
    add_run_arguments(p)
    return p


def settings_of(args):
    """The :class:`onefit.training.Settings` of parsed arguments. Raises InputError."""
    weights = Weights(**{f.name: getattr(args, f.name) for f in fields(Weights)})
    own = ("weights", "read")
    values = {f.name: getattr(args, f.name) for f in fields(Settings) if f.name not in own}
    values |= {name: tuple(getattr(args, name)) for name in ("garments", "motions", "extras")}
    return Settings(**values, weights=weights, read=read_options(args.garments, args))


def main(argv=None):
    args = parser().parse_args(argv)
    command = "python -m onefit.train " + shlex.join(sys.argv[1:] if argv is None else argv)
    run(train, settings_of(args), args, command)


if __name__ == "__main__":
    cli(main)
