"""``python -m polysft_mi.view OUT``: a run in polyscope's window, to turn, play and colour."""

from . import commands
from .errors import cli
from .pictures import show
from .results import Run

_EXAMPLES = [
    ("out/demo", "opens a window"),
    (
        "out/demo --frame 40 --screenshot view.png",
        "writes a picture instead (needs a display too, or EGL)",
    ),
]


def parser():
    p = commands.parser(
        "view",
        "Look at a run in an interactive viewer (polyscope, of the optional extra 'view').",
        _EXAMPLES,
    )
    p.add_argument("out", metavar="OUT", help="folder of a run")
    p.add_argument(
        "--frame",
        type=int,
        metavar="K",
        help="frame to begin with, by its index (default: the first)",
    )
    p.add_argument(
        "--screenshot",
        metavar="FILE",
        help="write a .png of that frame instead of opening a window",
    )
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    show(Run.open(options.out), options.frame, options.screenshot)
    if options.screenshot is not None:
        print(f"written: {options.screenshot}")
    return 0


if __name__ == "__main__":
    cli(main)
