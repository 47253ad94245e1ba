"""``python -m polysft_mi.compare A B``: a run against another run, or against ground truth:
figures, and pictures of where they differ.
"""

import math
import os

from polyfit.files import json_text

from . import commands
from .errors import InputError, cli
from .results.comparison import LABELS, OWN_LABELS, compare

_EXAMPLES = [
    ("out/a out/b", "two runs: their figures"),
    (
        "out/demo scenes/demo -o out/demo_errors",
        "a run and its ground truth; pictures of the errors",
    ),
    ("out/a out/b -o out/a_b --scale 5", "false colours up to 5 mm"),
    ("out/a out/b --json", "one JSON object on stdout"),
]


def parser():
    p = commands.parser(
        "compare",
        "Compare a run with another run, or with ground truth. Differences are A minus B.",
        _EXAMPLES,
    )
    p.add_argument("a", metavar="A", help="folder of a run")
    p.add_argument(
        "b", metavar="B", help="folder of another run, or ground truth as evaluate takes it"
    )
    p.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help=(
            "folder for compare.json, figures.png, and a PNG and an EXR a frame with the"
            " differences in false colours"
        ),
    )
    p.add_argument(
        "--frames",
        type=int,
        default=20,
        metavar="N",
        help="pictures of at most N frames, spread evenly (default: 20)",
    )
    p.add_argument(
        "--scale",
        type=float,
        metavar="MM",
        help=(
            "difference at which the false colours end (default: the one that 98 %% of the pixels"
            " stay below)"
        ),
    )
    p.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    p.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if options.frames < 1:
        raise InputError(f"--frames {options.frames}: at least one is needed")
    scale = 1.0 if options.scale is None else options.scale
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f"--scale {scale:g}: a positive number of millimetres is needed")
    if options.output is not None:
        folder = os.path.dirname(os.path.abspath(options.output))
        if not os.path.isdir(folder):
            raise InputError(f"-o {options.output}: no such folder: {folder}")
    comparison = compare(options.a, options.b)
    figures = comparison.figures
    if options.output is not None:
        from .pictures import write_comparison

        write_comparison(comparison, options.output, count=options.frames, scale=options.scale)
    if options.json:
        print(json_text(figures))
    elif not options.quiet:
        rows = {"frames": figures["frames"], **figures["difference"]}
        commands.print_table(rows, LABELS, title=f"{options.a} against {options.b}")
        for name, (one, two) in figures["own"].items():
            print(f"{OWN_LABELS[name]}: {one:.4g} (A), {two:.4g} (B)")
        if options.output is not None:
            print(f"written: {options.output}")
    return 0


if __name__ == "__main__":
    cli(main)
