"""Makes lessons for networks: simulated drapes of generated motions.

    python -m onefit.teach dress tshirt -o LESSONS --seeds 2     # the training's kinds of motion
    python -m onefit.teach -o LESSONS --cuts 160 --each 2        # random cuts, two kinds for each
    python -m onefit.train --teacher LESSONS -o runs/taught

LESSONS receives one file for each garment, and one for each of its drapes, by kind of motion and
seed; those that are there are kept, so that a run that was cut short goes on, or more are made in
the same way (lessons.json says which). Garments have about --vertices; every second lesson is of
one of --shapes random bodies.
"""

import argparse
import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

from onefit.garment import add_mesh_arguments, read_options
from onefit.physics import MATERIALS, Material
from polyfit.errors import InputError, Parser, cli, require
from polyfit.files import aside, make_folder

_ALIKE = "vertices", "seconds", "shapes", "steps", "material", "weights"  # for all of a folder


def parser():
    p = Parser(
        prog="python -m onefit.teach",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("garments", nargs="*", metavar="GARMENT", help="templates or meshes")
    p.add_argument("-o", "--output", required=True, metavar="LESSONS", help="folder of the files")
    p.add_argument("--cuts", type=int, default=0, help="random cuts, beside the garments")
    p.add_argument("--vertices", type=int, default=2000, help="of a garment (default: 2000)")
    p.add_argument("--kinds", nargs="*", metavar="KIND", help="of motion (default: the training's)")
    p.add_argument("--seeds", type=int, default=1, help="motions of each kind (default: 1)")
    p.add_argument("--each", type=int, help="kinds of a garment, taken in turn (default: all)")
    p.add_argument("--seconds", type=float, default=6.0, help="of a motion (default: 6)")
    p.add_argument("--shapes", type=int, default=12, help="random bodies (default: 12)")
    p.add_argument("--steps", type=int, default=2, help="of cloth, a frame (default: 2)")
    p.add_argument("--material", default="cotton", help=f"one of {', '.join(MATERIALS)}")
    p.add_argument("--weights", default="six-garments", help="what drapes before the simulation")
    add_mesh_arguments(p)
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    require("torch", "anny")
    import numpy as np
    from rich.console import Console
    from rich.progress import Progress

    from .draping import load
    from .garment import Garment
    from .garment.sewing.cuts import cuts
    from .motion import Motion, generate
    from .training import STANDARD, teacher

    Material.named(args.material)
    for name, least in dict(steps=1, seeds=1, vertices=100, shapes=0, cuts=0, each=1).items():
        given = getattr(args, name)
        if given is not None and given < least:
            raise InputError(f"--{name} {given}: {least} or more")
    kinds = args.kinds or generate.TRAINING
    for kind in kinds:
        if kind not in generate.TRAINING:
            raise InputError(f"--kinds {kind}: choose among {', '.join(generate.TRAINING)}")
    draper, folder = load(args.weights), Path(args.output)
    named = args.garments or (() if args.cuts else STANDARD)
    how = read_options(args.garments, args)
    garments = Garment.all_named(named, **how)
    if not 0 < args.seconds < math.inf:
        raise InputError(f"--seconds {args.seconds:g}: more than 0 is needed")
    Motion.generate(kinds[0], seconds=args.seconds)  # which refuses what is too long
    names = [teacher.path_of("", garment.name).stem for garment in garments]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name}: two garments have this name; lessons are kept by it")
    make_folder(folder)
    _check_alike(folder, {name: getattr(args, name) for name in _ALIKE})
    rng = np.random.default_rng(0)
    shapes = [draper.model.standard_shape]
    shapes += [draper.model.random_shape(rng) for _ in range(args.shapes)]
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("cuts sewn", total=args.cuts)
        if args.cuts:
            garments += cuts(args.cuts, folder / "cuts", advance=partial(progress.advance, task))
        garments = [_resized(folder, garment, args.vertices) for garment in garments]
        each = min(args.each or len(kinds), len(kinds))
        work = [
            (garment, kinds[(each * place + turn) % len(kinds)], seed)
            for seed in range(args.seeds)
            for turn in range(each)
            for place, garment in enumerate(garments)
        ]
        task = progress.add_task("lessons", total=len(work))
        for k, (garment, kind, seed) in enumerate(work):
            motion = Motion.generate(kind, seconds=args.seconds, seed=seed)
            path = teacher.path_of(folder, garment.name, motion.name)
            if not path.exists():
                # each garment sees the standard body in turn with the others
                turn = k // len(garments) + k % len(garments)
                shape = shapes[1 + turn // 2 % args.shapes if turn % 2 and args.shapes else 0]
                made = teacher.lesson(
                    draper, garment, motion, shape, steps=args.steps, material=args.material
                )
                teacher.write(path, made)
            progress.advance(task)
    print(args.output)


def _check_alike(folder, how):
    """Keep in ``folder`` ``how`` its lessons are made. Raises InputError where those that are there
    were made otherwise.
    """
    path = folder / "lessons.json"
    if path.exists():
        there = json.loads(path.read_text())
        other = [f"{n} {there.get(n)}" for n in how if there.get(n) != how[n]]
        if other:
            raise InputError(
                f"{folder}: lessons made otherwise ({', '.join(other)}); give the same, or another"
                " -o"
            )
    with aside(path) as temporary:
        Path(temporary).write_text(json.dumps(how, indent=1) + "\n")


def _resized(folder, garment, vertices):
    """The garment at about so many vertices, kept in ``folder``."""
    from .training import teacher

    if not teacher.path_of(folder, garment.name).exists():
        teacher.write_garment(folder, replace(garment.remeshed(vertices), name=garment.name))
    return teacher.garment_of(folder, garment.name)


if __name__ == "__main__":
    cli(main)
