"""``polysft demo``: reconstructs the scene that the package brings, a poster that bends.

It shows what a run does, and whether an installation works: no file is needed.
"""

import os

from . import commands, run
from .errors import cli

# Frames, masks, template, camera and true surface of a simulated video lie beside it, in demo/
SCENE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "data", "demo.xml")

_EXAMPLES = [
    ("", "the first 12 frames, into out/demo"),
    ("-o poster -D last=-1", "all 45 frames, into the folder poster"),
    ("--overwrite -q --json", "again; for scripts, one JSON object on stdout"),
]


def parser():
    p = commands.parser(
        "demo",
        "Reconstruct a bending poster, whose video is part of the package.",
        _EXAMPLES,
    )
    p.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        default=os.path.join("out", "demo"),
        help="folder for the results (default: out/demo)",
    )
    run.add_options(p)
    return p


def main(arguments=None):
    return run.execute("demo", SCENE, parser().parse_args(arguments))


if __name__ == "__main__":
    cli(main)
