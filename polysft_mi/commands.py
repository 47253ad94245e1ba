"""What the commands have in common: their names, and parsers that teach by examples."""

import argparse
import sys

from polyfit.errors import InputError, Parser

# name: what it is for, in a line of `polysft --help`
COMMANDS = {
    "demo": "reconstruct the poster that the package brings",
    "prepare": "make a scene from a video or from a sequence's folder",
    "run": "reconstruct the surface in every frame",
    "evaluate": "figures against ground truth",
    "report": "one page that shows a run: video, errors, surface in 3D, figures",
    "export": "the moving surface as USD, glTF, OBJ, PLY or arrays",
    "compare": "two runs, or a run and its ground truth: figures and pictures",
    "batch": "reconstruct many scenes, several at a time, with one table",
    "view": "look at a run in the browser, also while it is at work",
}


def parser(name, description, examples):
    """The parser of the command ``name``, called as the user called it; ``examples`` are pairs of
    its arguments and what they do.
    """
    prog = sys.argv[0] if sys.argv[0] == f"polysft {name}" else f"python -m polysft_mi.{name}"
    lines = [f"  {prog} {arguments}\n      {what}" for arguments, what in examples]
    return Parser(
        prog=prog,
        description=description,
        epilog="examples:\n" + "\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_define_argument(parser):
    """Add ``-D NAME=VALUE``, which may be repeated; :func:`definitions` reads what it takes."""
    parser.add_argument(
        "-D",
        dest="define",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="override a <default> of the scene; may be repeated",
    )


def definitions(texts):
    """Names to values of the texts of ``-D``. Raises InputError for one that is no NAME=VALUE."""
    for text in texts:
        if text.find("=") < 1:
            raise InputError(f"-D {text}: NAME=VALUE is needed")
    return dict(text.split("=", 1) for text in texts)


def print_table(figures, labels, title):
    """Print ``figures`` (name to number) as a table: by rich on a terminal, as aligned plain text
    elsewhere. ``labels``: name to what it is called.
    """
    shown = {k: v for k, v in figures.items() if not isinstance(v, dict)}
    rows = [(labels.get(k, k), _format(v)) for k, v in shown.items()]
    if not sys.stdout.isatty():
        width = max(len(label) for label, _ in rows)
        for label, value in rows:
            print(f"{label:{width}s}  {value}")
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title))  # as Text, because rich takes "[mm]" in a str for markup
    table.add_column("figure")
    table.add_column("value", justify="right")
    for row in rows:
        table.add_row(*map(Text, row))
    Console().print(table)


def _format(value):
    return str(value) if isinstance(value, int) else f"{value:.5g}"
