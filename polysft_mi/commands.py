"""What the commands have in common: their names, and parsers that teach by examples."""

import argparse
import sys

# name: what it is for, in a line of `polysft --help`
COMMANDS = {
    "prepare": "make a scene of a video or of a sequence's folder",
    "run": "reconstruct the surface in every frame",
    "evaluate": "figures against ground truth",
    "report": "one page that shows a run: video, errors, surface in 3D, figures",
    "export": "the moving surface as USD, glTF, OBJ, PLY or arrays",
    "compare": "two runs, or a run and its ground truth: figures and pictures",
    "view": "look at a run in an interactive viewer",
}


def parser(name, description, examples):
    """An ``argparse`` parser of the command ``name``, called as the user called it; ``examples`` is a list of its arguments with what they do."""
    prog = sys.argv[0] if sys.argv[0] == f"polysft {name}" else f"python -m polysft_mi.{name}"
    width = max(len(e) for e, _ in examples)
    lines = [f"  {prog} {arguments:{width}s}  {what}".rstrip() for arguments, what in examples]
    return argparse.ArgumentParser(
        prog=prog, description=description, epilog="examples:\n" + "\n".join(lines), formatter_class=argparse.RawDescriptionHelpFormatter
    )
