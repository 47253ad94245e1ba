"""``python -m polysft_mi.report OUT``: one page, in one file, that shows a run in any browser and
without a network.
"""

import os

from . import commands
from .errors import InputError, cli
from .pictures import write_report

_EXAMPLES = [
    ("out/demo", "out/demo/report.html again (a run writes it at its end)"),
    (
        "out/demo --truth scenes/demo",
        "with figures and colours of the distance to the true surface",
    ),
    (
        "out/demo -o page.html --frames 50",
        "another file, and a smaller one: 50 frames spread over the video",
    ),
]


def parser():
    p = commands.parser(
        "report",
        "Write the report of a run: one HTML file for any browser, without a network.",
        _EXAMPLES,
    )
    p.add_argument("out", metavar="OUT", help="folder of a run")
    p.add_argument(
        "-o", "--output", metavar="FILE", help="file to write (default: report.html in OUT)"
    )
    p.add_argument("--truth", metavar="TRUTH", help="ground truth, as evaluate takes it")
    p.add_argument(
        "--frames",
        type=int,
        default=200,
        metavar="N",
        help="show at most N frames, spread over the video (default: 200)",
    )
    p.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if options.frames < 1:
        raise InputError(f"--frames {options.frames}; at least 1 is needed")
    path = write_report(options.out, options.output, truth=options.truth, frames=options.frames)
    if not options.quiet:
        print(f"written: {path}, {os.path.getsize(path) / 1e6:.1f} MB; open it in a browser")
    return 0


if __name__ == "__main__":
    cli(main)
