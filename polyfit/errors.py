"""The one exception for a user's mistake, how a command line ends on it, and that nothing speaks
there but we.
"""

import argparse
import contextlib
import importlib.util
import logging
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn


class InputError(ValueError):
    """A file, flag, scene or value that a user gave and that cannot be used.

    The message is one line: it names the file or property, its value, and what would be accepted.
    """


def as_number(value: Any) -> float:
    """``value`` as a float; NaN for what is no number, as "1" and None."""
    try:
        return math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return math.nan


def number(
    name: str,
    value: Any,
    least: float | None = None,
    most: float | None = None,
    *,
    above: float | None = None,
    whole: bool = False,
) -> Any:
    """``value`` as a float, or as an int, which ``whole`` asks for: at least ``least``, at most
    ``most``, more than ``above``. Raises InputError, which calls it ``name``, for all others.
    """
    found = as_number(value)
    low, high = -math.inf if least is None else least, math.inf if most is None else most
    good = math.isfinite(found) and low <= found <= high and (above is None or found > above)
    if good and not (whole and found % 1):
        return int(value) if whole else found
    needed = "a whole number" if whole else "a finite number"
    if above is not None:
        needed += f" above {above:,}"
    elif least is not None:
        needed += f", {least:,} or more," if most is None else f", {least:,} to {most:,},"
    given = repr(value) if isinstance(value, str | bytes) else " ".join(str(value).split())
    raise InputError(f"{name} = {given[:60]}; {needed} is needed")


class Notice(RuntimeWarning):
    """A warning of ours, which a user of a command sees."""


class Parser(argparse.ArgumentParser):
    """An ``argparse`` parser whose complaints are an :class:`InputError`, one line as all others
    are.
    """

    _presets: dict[str, dict[str, Any]] | None = None

    _given: Sequence[str] = ()

    def error(self, message: str) -> NoReturn:
        raise InputError(
            f"{message}; {self._swallowed(message)}{self.prog} --help lists the options"
        )

    def _swallowed(self, message: str) -> str:
        """A hint where words may be missing, or too many, because a list's flag took them."""
        missing = message.startswith("the following arguments are required")
        for action in self._actions:
            for flag in action.option_strings:
                wrong = message.startswith(f"argument {flag}: invalid choice")
                if action.nargs in ("*", "+") and flag in self._given and (missing or wrong):
                    return f"{flag} takes all words up to the next flag, give others before it; "
        return ""

    def add_presets(self, presets: dict[str, dict[str, Any]]) -> None:
        """Add ``--preset NAME``: other defaults, by the names of the parsed arguments."""
        self._presets = presets
        about = "other defaults; what is given beside it wins"
        self.add_argument("--preset", choices=sorted(presets), help=about)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> argparse.Namespace:
        self._given = list(sys.argv[1:] if args is None else args)
        found = super().parse_args(args, namespace)
        preset = getattr(found, "preset", None)
        if preset and self._presets:
            self.set_defaults(**self._presets[preset])
            found = super().parse_args(args, namespace)
        return found


# What a plain `pip install polysft-mi` leaves out: module, and the extra that brings it
EXTRAS = {
    "anny": "learn",
    "pyacvd": "learn",
    "pyvista": "learn",
    "roma": "learn",
    "safetensors": "learn",
    "skimage": "learn",
    "torch": "learn",
    "warp": "learn",
    "pxr": "usd",
    "viser": "view",
}


def require(*modules: str) -> None:
    """Raise an :class:`InputError` that names the extra to install, unless all ``modules`` are
    there. For the start of a command that would miss one of them only at its end.
    """
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise InputError(_advice(module))


@contextlib.contextmanager
def optional_imports(name: str) -> Iterator[None]:
    """A block of imports that need an extra, at the head of a module called ``name``: where the
    module is run as a command (``__main__``) and the extra is missing, it ends as :func:`cli` does.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if name != "__main__" or error.name not in EXTRAS:
            raise
        sys.exit(_fail(_advice(error.name)))


def silence_others() -> None:
    """From here on the process shows no warning but a :class:`Notice`, and no line of a log: what
    other packages have to say is no news for a user of a command. ``python -W`` or
    ``PYTHONWARNINGS`` brings it back.
    """
    if not sys.warnoptions:
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", Notice)


def cli(main: Callable[[], int | None]) -> NoReturn:
    """Run ``main()`` as a process: its return value is the exit status.

    An :class:`InputError`, a missing extra (``EXTRAS``) or an ``OSError`` that names a file ends in
    one line on stderr and exit status 2, Ctrl-C in 130, a reader of stdout that has left in 141,
    without a word. Other packages are silenced.
    """
    silence_others()
    try:
        status = main()
        sys.stdout.flush()
    except InputError as error:
        status = _fail(str(error))
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        status = _fail(_advice(error.name))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = 130
    except BrokenPipeError:  # whoever read the output has read enough, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 141
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


def _advice(module: str) -> str:
    return (
        f"{module} is not installed, which this needs: pip install 'polysft-mi[{EXTRAS[module]}]'"
    )


def _fail(message: str) -> int:
    coloured = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    print(
        ("\033[1;31merror:\033[0m " if coloured else "error: ") + " ".join(message.split()),
        file=sys.stderr,
    )
    return 2
