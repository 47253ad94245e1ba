"""``polysft``, or ``python -m polysft_mi``: every command of the package under one name."""

import difflib
import importlib
import sys

from polyfit.backend import llvm_line

from . import __version__
from .commands import COMMANDS
from .errors import InputError, cli

_HELP = """\
usage: polysft COMMAND ...

The surface of a textured template in every frame of a video.

commands:
{commands}

examples:
  polysft demo                          reconstruct a poster; then open out/demo/report.html
  polysft prepare clip.mp4 --texture photo.jpg --size A4 --fov 65 -o OUT
  polysft run OUT/scene.xml -o RESULT   reconstruct the sheet in your own video
  polysft export RESULT --format glb    for browsers and Blender
  polysft view RESULT                   look at it in the browser, also while it is at work
  polysft COMMAND --help                the options of a command, with examples

Each command is also a module: python -m polysft_mi.run ...
Exit status: 0 for success, 2 for a bad input (one line on stderr names it), 130 for Ctrl-C, 1 where
a scene of a batch failed.
Colours only on a terminal, and not where NO_COLOR is set.
"""


def main(arguments=None):
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        width = max(map(len, COMMANDS))
        print(
            _HELP.format(
                commands="\n".join(f"  {name:{width}s}  {what}" for name, what in COMMANDS.items())
            ),
            end="",
        )
        return 0 if arguments else 2
    if arguments[0] in ("-V", "--version"):
        print(f"polysft {__version__}")
        try:
            print(llvm_line())
        except InputError as error:  # the version is told all the same
            print(error)
        return 0
    name, rest = arguments[0], arguments[1:]
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        raise InputError(
            f"polysft {name}: no such command{f', did you mean {near[0]}?' if near else ';'} there"
            f" are {', '.join(COMMANDS)}"
        )
    sys.argv = [f"polysft {name}", *rest]  # what the command's help and the record of a run name
    return importlib.import_module(f"{__package__}.{name}").main(rest)


def entry():
    """The installed command."""
    cli(main)


if __name__ == "__main__":
    cli(main)
