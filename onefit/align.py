"""Aligns a garment that was made on another body, in another pose, with the standard body in the
T-pose, as the paper preprocesses CLOTH3D: each vertex goes with the nearest vertex of the body.

    python -m onefit.align Tshirt.obj -o tshirt.ply --body SMPL.pkl --shape beta0=1.2 beta1=-0.4
    python -m onefit.align Dress.obj -o dress.ply --body SMPL.pkl --loose
    python -m onefit.drape tshirt.ply walk -o OUT --made-for T-pose

The mesh keeps its vertices and their order. In CLOTH3D's pose the legs stand apart; --pose T-pose
is the T-pose itself.
"""

import argparse
import os

from onefit.garment import add_place_arguments
from polyfit.errors import InputError, Parser, cli, require


def parser():
    p = Parser(
        prog="python -m onefit.align",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("garment", metavar="GARMENT", help="a mesh (.obj, .ply, .glb)")
    p.add_argument("-o", "--output", required=True, metavar="OUT.ply", help="the file to write")
    p.add_argument(
        "--body", default="anny", help="that it was made on: anny, or a file of SMPL's (.npz, .pkl)"
    )
    p.add_argument("--shape", nargs="*", default=[], metavar="NAME=VALUE", help="of that body")
    p.add_argument("--pose", choices=("cloth3d", "T-pose"), default="cloth3d", help="of that body")
    p.add_argument("--loose", action="store_true", help="a dress or skirt: by the shape alone")
    add_place_arguments(p)
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    if not args.output.lower().endswith(".ply"):
        raise InputError(f"{args.output}: a .ply file is needed")
    if os.path.realpath(args.output) == os.path.realpath(args.garment):
        raise InputError(f"{args.output}: is the garment itself; -o needs another name")
    if os.path.dirname(args.output) and not os.path.isdir(os.path.dirname(args.output)):
        raise InputError(f"{os.path.dirname(args.output)}: no such folder")
    require("torch", "anny")
    from polyfit.mesh import read_mesh, write_ply

    from .draping import inputs
    from .garment import Place, aligned, pose_of, up_of

    vertices, faces, _ = read_mesh(args.garment)
    model = inputs.body_model(args.body)
    body = model.body(inputs.shape_of(model, args.shape))
    up = up_of(args.garment, args.up)
    place = Place(args.scale, up, args.turn, tuple(args.offset), up_of(args.garment))
    told = dict(where=args.garment, place=place)
    pose = pose_of(args.pose)
    made = aligned(place.apply(vertices), faces, body, pose, loose=args.loose, **told)
    write_ply(args.output, made, faces)
    print(f"written: {args.output}, around the standard body in the T-pose")


if __name__ == "__main__":
    cli(main)
