"""Processes of their own, for tests of how a command or an import starts and ends."""

import os
import socket
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


def two_ranks(*arguments):
    """Two Pythons that find each other as torchrun's would, by their environment, one thread each;
    both must end well.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    where = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
    started = [
        subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            cwd=ROOT,
            env=os.environ | where | {"WORLD_SIZE": "2", "RANK": rank, "LOCAL_RANK": rank},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in "01"
    ]
    for process, (_, said) in [(p, p.communicate()) for p in started]:
        assert process.returncode == 0, said[-2000:]
