"""Processes of their own, for tests of how a command or an import starts and ends."""

import subprocess
import sys

from places import ROOT


def python(*arguments, **options):
    """A Python in the repository's folder, done: its ``returncode``, ``stdout`` and ``stderr``."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        **options,
    )


def refusal(done):
    """The one line of a process that refused: exit status 2, and nothing else said."""
    assert done.returncode == 2 and done.stdout == "", done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1, done.stderr
    return done.stderr
