"""Jobs, done by ray, each as a process of its own: Dr.Jit does not live on in a fork."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence

from polyfit.errors import require

from .jobs import Job

_STORE = 80_000_000  # bytes, ray's least; nothing is kept in it
_LAST_WORDS = 60  # [s] that a run has after Ctrl-C to write what it has


def work(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, int, float]]:
    """Do the jobs, ``workers`` at a time; yields (job, exit status, seconds) as they end. Ctrl-C
    ends those that are at work, which keep their frames, and is raised again. Raises InputError
    where ray is not installed.
    """
    require("ray")
    for job in jobs:
        with contextlib.suppress(FileNotFoundError):  # of a batch that was killed
            os.remove(_mark(job.log))
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    ray.init(
        address="local",
        num_cpus=workers,
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
        object_store_memory=_STORE,
    )
    try:
        task = ray.remote(num_cpus=1, max_retries=0)(_do)
        waiting = {task.remote(job.command(), str(job.log), os.getcwd()): job for job in jobs}
        try:
            while waiting:
                (ref,), _ = ray.wait(list(waiting), num_returns=1)
                job = waiting.pop(ref)
                try:
                    status, seconds = ray.get(ref)
                except ray.exceptions.RayError:  # its process was killed, out of memory
                    status, seconds = -signal.SIGKILL, 0.0
                yield job, status, seconds
        except (KeyboardInterrupt, GeneratorExit):  # here, or in who takes what is yielded
            for ref in waiting:
                ray.cancel(ref)
            # ray takes a task for ended as soon as it is told to end
            until = time.monotonic() + _LAST_WORDS
            while time.monotonic() < until and any(map(_is_at_work, waiting.values())):
                time.sleep(0.1)
            raise
    finally:
        ray.shutdown()


def _do(command, log, where):
    """In ray's process: run a command, its words in the file ``log``; (exit status, seconds)."""
    began, mark = time.perf_counter(), _mark(log)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # which a process inherits blocked
    with open(log, "w", encoding="utf-8") as file, open(mark, "w", encoding="utf-8"):
        process = subprocess.Popen(
            command, cwd=where, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT
        )
        try:
            while process.poll() is None:  # ray.cancel interrupts Python, but no system call
                time.sleep(0.1)
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            process.wait()
        finally:
            os.remove(mark)
    return process.returncode, time.perf_counter() - began


def _mark(log):
    """The file that is there as long as a job is at work."""
    return f"{log}.at-work"


def _is_at_work(job):
    return os.path.exists(_mark(job.log))
