"""Drapes a garment on a moving body, and writes the arrays, an animation and a rendering of it.

    python -m onefit.drape dress walk -o OUT                   # a template, a generated motion
    python -m onefit.drape shirt.obj motion.npz -o OUT         # a mesh, a motion (AMASS, NCS, BVH)
    python -m onefit.drape tshirt dance -o OUT --shape weight=0.7 height=0.6 --skip render

OUT receives

    drape.npz               vertices (T, N, 3) [m, z up], faces, rest, the body's vertices and
                            faces, fps
    figures.json            what was measured
    garment.usd, body.usd   animations that Blender and usdview open; of a mesh file its own
                            vertices, faces and texture coordinates
    frames/NNN.png          rendered by Mitsuba; drape.mp4 is their video
    meshes/NNN.obj          one mesh a frame, with --meshes obj (or ply)
"""

import argparse
import sys

from onefit.network import DEFAULT
from onefit.physics import MATERIALS, Material
from polyfit.errors import InputError, Parser, cli, require

# The paper: what the network alone makes; --post beside it pushes cloth out of the body
PRESETS = {"paper": dict(finish=0, post=False, ease=False)}


def parser():
    p = Parser(
        prog="python -m onefit.drape",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "garment",
        metavar="GARMENT",
        help="a template's name, or a mesh (.obj, .ply, .glb) around the standard body",
    )
    p.add_argument(
        "motion",
        metavar="MOTION",
        help="a file (AMASS or NCS .npz, .bvh), or a generated kind: walk, run, dance, ...",
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
    group = p.add_argument_group("a garment's mesh that is not in metres around the standard body")
    group.add_argument(
        "--scale",
        type=float,
        default=1.0,
        help="factor to metres: 0.01 for centimetres (default: 1)",
    )
    group.add_argument(
        "--up", default="z", choices=("z", "y"), help="the axis that points up (default: z)"
    )
    group.add_argument(
        "--turn", type=float, default=0.0, help="rotation about the vertical [degrees] (default: 0)"
    )
    group.add_argument(
        "--offset",
        nargs=3,
        type=float,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"),
        help="translation [m]",
    )
    group.add_argument(
        "--made-for",
        choices=("T-pose",),
        help="T-pose: the standard body with its arms stretched out",
    )
    group.add_argument(
        "--vertices",
        type=int,
        metavar="N",
        help="drape about N vertices of cloth, which carry the file's mesh (default: its own)",
    )
    group.add_argument(
        "--loose", action="store_true", help="a skirt or dress: the legs' pose is not followed"
    )
    p.add_argument(
        "--fps", type=float, help="frames a second of a motion file (default: as the file says)"
    )
    p.add_argument(
        "--motion-up",
        choices=("y", "z"),
        help="the axis that points up in a motion file (default: that of its format)",
    )
    p.add_argument(
        "--seconds", type=float, default=3.0, help="length of a generated motion (default: 3)"
    )
    p.add_argument("--seed", type=int, default=0, help="seed of a generated motion (default: 0)")
    p.add_argument(
        "--post",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="post-processing, where there is no finish (default: on)",
    )
    p.add_argument(
        "--ease",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="the garment is tried on first (default: on)",
    )
    p.add_argument(
        "--finish",
        type=int,
        default=2,
        metavar="N",
        help="implicit steps of cloth a frame, after the network; 0: none (default: 2)",
    )
    p.add_argument(
        "--material",
        default="cotton",
        help=f"of the finish: {', '.join(MATERIALS)} (default: cotton)",
    )
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
    p.add_presets(PRESETS)
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    if min(args.size) < 1 or args.spp < 1:
        raise InputError(
            f"--size {args.size[0]} {args.size[1]} --spp {args.spp}: each must be at least 1"
        )
    require("torch", "anny", *(["pxr"] if "usd" not in args.skip else []))

    from polyfit.training import device_of

    from .draping import inputs, load, output
    from .garment import Garment

    output.check_folder(args.output, args.overwrite)
    Material.named(args.material)
    if args.finish < 0:
        raise InputError(f"--finish {args.finish}: steps a frame, 0 or more")
    if args.vertices is not None and args.vertices < 100:
        raise InputError(f"--vertices {args.vertices}: at least 100 are needed")
    model = inputs.body_model(args.body)
    draper = load(args.weights, model=model, device=device_of(args.device))
    garment = Garment.named(
        args.garment,
        made_for=args.made_for,
        loose=args.loose,
        scale=args.scale,
        up=args.up,
        turn=args.turn,
        offset=tuple(args.offset),
    )
    if args.vertices:
        garment = garment.remeshed(args.vertices)
    motion = inputs.motion_of(
        args.motion, seconds=args.seconds, seed=args.seed, fps=args.fps, up=args.motion_up
    )
    shape = inputs.shape_of(model, args.shape)
    for repair in garment.repairs:
        print(f"{args.garment}: {repair}", file=sys.stderr)
    outcome = output.drape_into(
        args.output,
        draper,
        garment,
        motion,
        shape,
        about=dict(garment=args.garment, motion=motion.name, weights=args.weights),
        how=dict(post=args.post, eased=args.ease, finish=args.finish, material=args.material),
        skip=args.skip,
        meshes=args.meshes,
        size=args.size,
        spp=args.spp,
    )
    print(outcome.as_text(), end="", file=sys.stderr)
    print(outcome.folder)


if __name__ == "__main__":
    cli(main)
