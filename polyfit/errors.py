"""The one exception for a user's mistake, and how a command line ends on it."""

import contextlib
import os
import signal
import sys


class InputError(ValueError):
    """A file, flag, scene or value that a user gave and that cannot be used.

    The message is one line: it names the file or property, its value, and what would be accepted.
    """


def cli(main):
    """Run ``main()`` as a process: its return value is the exit status.

    An :class:`InputError` or an ``OSError`` that names a file ends in one line on stderr and exit
    status 2, Ctrl-C in 130.
    """
    try:
        status = main()
    except InputError as error:
        status = _fail(str(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = 130
    except OSError as error:
        if error.filename is None and error.strerror is None:
            raise
        where = f"{error.filename}: " if error.filename is not None else ""
        status = _fail(f"{where}{error.strerror or error}")
    with contextlib.suppress(ValueError):  # which is raised beside the main thread
        signal.signal(
            signal.SIGINT, signal.SIG_DFL
        )  # nothing is left but Python's own end, whose traceback would tell nobody anything
    sys.exit(status)


def _fail(message):
    coloured = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    print(
        ("\033[1;31merror:\033[0m " if coloured else "error: ") + " ".join(message.split()),
        file=sys.stderr,
    )
    return 2
