"""``python -m polysft_mi.evaluate OUT TRUTH``: the figures of a run against ground truth, as a
table or as JSON.
"""

from polyfit.files import json_text

from . import commands
from .errors import cli
from .results.evaluation import LABELS, evaluate

_EXAMPLES = [
    ("out/demo scenes/demo", "a run against the truth in its sequence's folder"),
    ("out/flag/surface.npz /data/flag/gt.npz --json", "files alone; one JSON object on stdout"),
]


def parser():
    p = commands.parser("evaluate", "Figures of a reconstruction against ground truth.", _EXAMPLES)
    p.add_argument("out", metavar="OUT", help="folder of a run, or a surface.npz")
    p.add_argument(
        "truth",
        metavar="TRUTH",
        help="gt.npz, an .npz of depth points, a folder of cloud_*.npz, or a sequence's folder",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    figures = evaluate(options.out, options.truth)
    if options.json:
        print(json_text(figures))
    else:
        commands.print_table(figures, LABELS, title=options.out)
    return 0


if __name__ == "__main__":
    cli(main)
