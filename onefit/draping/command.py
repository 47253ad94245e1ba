"""The commands onefit.drape and onefit.simulate: their arguments, and the way to their files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from onefit.garment import add_mesh_arguments, read_options
from onefit.motion import add_file_arguments
from onefit.network import DEFAULT
from polyfit.errors import InputError, Parser, require

if TYPE_CHECKING:
    from onefit.garment import Garment
    from onefit.motion import Motion

SECONDS, SEED = 3.0, 0  # of a generated motion


def parser(name: str, text: str) -> Parser:
    """What both commands take; ``name``: the command's module, ``text``: what it is for."""
    p = Parser(
        prog=f"python -m {name}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "garment",
        nargs="+",
        metavar="GARMENT",
        help="a template's name, a mesh (.obj, .ply, .glb) around the standard body, or a sewing"
        " pattern (GarmentCode's *_specification.json); several are worn one over the other, in"
        " the order in which they are put on",
    )
    p.add_argument(
        "motion",
        metavar="MOTION",
        help="a file (AMASS or NCS .npz, .bvh), or a generated kind: walk, run, dance, ...; of a"
        " file at any rate 30 frames a second are made",
    )
    p.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT",
        help="folder of the results; must be empty or new, or --overwrite",
    )
    p.add_argument(
        "--weights",
        default=DEFAULT,
        help=f"a network of the package, or a file (default: {DEFAULT})",
    )
    p.add_argument(
        "--body",
        default="anny",
        help="anny, or a file: SMPL (.npz, .pkl) or plain (body.npz) (default: anny)",
    )
    p.add_argument(
        "--shape",
        nargs="*",
        default=[],
        metavar="NAME=VALUE",
        help="the body's shape, e.g. weight=0.7; the rest is standard",
    )
    add_garment_arguments(p)
    add_motion_arguments(p, SECONDS, SEED)
    p.add_argument(
        "--skip", nargs="*", default=[], choices=("usd", "render"), help="results to leave out"
    )
    p.add_argument("--meshes", choices=("obj", "ply"), help="also one mesh a frame")
    p.add_argument(
        "--size",
        nargs=2,
        type=int,
        default=(480, 360),
        metavar=("HEIGHT", "WIDTH"),
        help="size of the rendering [pixels] (default: 480 360)",
    )
    p.add_argument("--spp", type=int, default=16, help="samples a pixel (default: 16)")
    p.add_argument("--device", default="cpu", help="cpu or cuda, for the network (default: cpu)")
    p.add_argument("--overwrite", action="store_true", help="replace an earlier drape in OUT")
    return p


def add_garment_arguments(p: Parser) -> None:
    """What :func:`garments_of` needs."""
    add_mesh_arguments(p).add_argument(
        "--vertices",
        type=int,
        metavar="N",
        help="about N vertices of cloth, which carry the file's mesh (default: its own; of a sewing"
        " pattern 4000)",
    )


def add_motion_arguments(p: Parser, seconds: float, seed: int) -> None:
    """What :func:`motions_of` needs, which is to be given the same ``seconds`` and ``seed``."""
    add_file_arguments(p)
    p.add_argument(
        "--seconds",
        type=float,
        help=f"length of a generated motion (default: {seconds:g}); a file is cut to its first ones"
        " (default: all)",
    )
    p.add_argument("--seed", type=int, help=f"seed of a generated motion (default: {seed})")


def garments_of(names: Sequence[str], args: argparse.Namespace) -> list[Garment]:
    """The garments called ``names``, by the flags of :func:`add_garment_arguments`. Raises
    InputError, also where none of them is a file, which such a flag speaks of.
    """
    from onefit.garment import Garment

    if args.vertices is not None and args.vertices < 100:
        raise InputError(f"--vertices {args.vertices}: at least 100 are needed")
    how = read_options(names, args)
    return Garment.all_named(names, args.vertices, **how)


def motions_of(
    names: Sequence[str], args: argparse.Namespace, seconds: float, seed: int
) -> list[Motion]:
    """The motions called ``names``, by the flags of :func:`add_motion_arguments`. Raises
    InputError, also for flags that speak of none of them. What will be resampled is said on stderr.
    """
    from onefit.motion import KINDS

    from .draper import FPS
    from .inputs import motion_of

    files = [name for name in names if name not in KINDS]
    for flag, value in (("--fps", args.fps), ("--motion-up", args.motion_up)):
        if value is not None and not files:
            raise InputError(f"{flag}: for a motion file; {names[0]} is generated")
    if args.seed is not None and len(files) == len(names):
        raise InputError(f"--seed: for a generated motion; {names[0]} is a file")
    if files and args.seconds is not None and not args.seconds > 0:
        raise InputError(f"--seconds {args.seconds:g}: more than 0 are needed")
    made = []
    for name in names:
        motion = motion_of(
            name,
            seconds=seconds if args.seconds is None else args.seconds,
            seed=seed if args.seed is None else args.seed,
            fps=args.fps,
            up=args.motion_up,
        )
        if name in files and args.seconds is not None:
            motion = motion[: max(1, round(min(args.seconds * motion.fps, len(motion))))]
        if motion.fps != FPS:
            note = f"{name}: {motion.fps:g} frames a second, resampled to {FPS:g}"
            print(note, file=sys.stderr)
        made.append(motion)
    return made


def refuse(p: Parser, flag: str, why: str) -> None:
    """``flag``, with or without a value, is refused in one line, and not listed."""
    p.add_argument(flag, nargs="?", action=_Refused, const=why, help=argparse.SUPPRESS)


class _Refused(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        raise InputError(f"{option_string}: {self.const}")


def run(verb: str, args: argparse.Namespace, **how) -> None:
    """The command, of arguments of :func:`parser`: ``verb`` is "drape" or "simulate", the method of
    :class:`onefit.Draper` that is called, ``how`` what only that takes.
    """
    if min(args.size) < 1 or args.spp < 1:
        raise InputError(
            f"--size {args.size[0]} {args.size[1]} --spp {args.spp}: each must be at least 1"
        )
    require("torch", "anny", *(["pxr"] if "usd" not in args.skip else []))

    from . import inputs, load, outfit, output
    from .draper import FPS

    output.check_folder(args.output, args.overwrite)
    model = inputs.body_model(args.body)
    draper = load(args.weights, model=model, device=args.device)
    garments = garments_of(outfit.several(args.garment), args)
    (motion,) = motions_of([args.motion], args, SECONDS, SEED)
    shape = inputs.shape_of(model, args.shape)
    for name, garment in zip(args.garment, garments):
        for repair in garment.repairs:
            print(f"{name}: {repair}", file=sys.stderr)
    # garments are put on, cut and tried, and kernels compiled, once for all motions: that does not
    # count
    draper.drape(garments, motion[:2], shape, **(how if verb == "drape" else {}))
    outcome = output.drape_into(
        args.output,
        partial(getattr(draper, verb), garments, motion, shape, **how),
        verb,
        len(motion.resampled(FPS)),
        about=dict(
            garment=args.garment[0] if len(garments) == 1 else args.garment,
            motion=motion.name,
            weights=args.weights,
            shape=(model.standard_shape if shape is None else shape).tolist(),
            **how,
        ),
        names=args.garment,
        skip=args.skip,
        meshes=args.meshes,
        size=args.size,
        spp=args.spp,
    )
    print(outcome.as_text(), end="", file=sys.stderr)
    print(outcome.folder)
    print(f"next: {outcome.next_step()}")
