"""Makes lessons for networks: finished drapes of generated motions, as deformations of patches.

    python -m onefit.teach dress tshirt -o LESSONS --seeds 2     # the training's kinds of motion
    python -m onefit.train dress tshirt --teacher LESSONS -o runs/taught

LESSONS receives one file for each garment, kind of motion and seed; those that are there are kept,
so that a run that was cut short goes on. Every second lesson is of a random body.
"""

import argparse
from pathlib import Path

from onefit.physics.material import MATERIALS, Material
from polyfit.errors import InputError, Parser, cli, require


def parser():
    p = Parser(
        prog="python -m onefit.teach",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("garments", nargs="*", metavar="GARMENT", help="templates or meshes")
    p.add_argument("-o", "--output", required=True, metavar="LESSONS", help="folder of the files")
    p.add_argument("--kinds", nargs="*", metavar="KIND", help="of motion (default: the training's)")
    p.add_argument("--seeds", type=int, default=1, help="motions of each kind (default: 1)")
    p.add_argument("--seconds", type=float, default=6.0, help="of a motion (default: 6)")
    p.add_argument("--finish", type=int, default=2, help="steps a frame (default: 2)")
    p.add_argument("--material", default="cotton", help=f"one of {', '.join(MATERIALS)}")
    p.add_argument("--weights", default="six-garments", help="what drapes before the finish")
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    require("torch", "anny")
    import numpy as np
    from rich.console import Console
    from rich.progress import Progress

    from .draping import load
    from .motion import Motion, generate
    from .training import STANDARD, teacher

    Material.named(args.material)
    for name in ("finish", "seeds"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name} {getattr(args, name)}: 1 or more")
    kinds = args.kinds or generate.TRAINING
    for kind in kinds:
        if kind not in generate.TRAINING:
            raise InputError(f"--kinds {kind}: choose among {', '.join(generate.TRAINING)}")
    draper = load(args.weights)
    garments = [draper.garment(name) for name in args.garments or STANDARD]
    Path(args.output).mkdir(parents=True, exist_ok=True)
    work = [(g, kind, seed) for seed in range(args.seeds) for kind in kinds for g in garments]
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("lessons", total=len(work))
        for k, (garment, kind, seed) in enumerate(work):
            motion = Motion.generate(kind, seconds=args.seconds, seed=seed)
            path = teacher.path_of(args.output, garment.name, motion.name)
            if not path.exists():
                rng = np.random.default_rng([seed, k])
                model = draper.model
                shape = model.random_shape(rng) if k % 2 else model.standard_shape
                made = teacher.lesson(
                    draper, garment, motion, shape, finish=args.finish, material=args.material
                )
                teacher.write(path, made)
            progress.advance(task)
    print(args.output)


if __name__ == "__main__":
    cli(main)
