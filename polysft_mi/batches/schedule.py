"""Jobs, several at a time, each a process of its own: Dr.Jit does not live on in a fork."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

from .jobs import Job

_LAST_WORDS = 60  # [s] that a run has after Ctrl-C to write what it has


def work(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, int, float]]:
    """Do the jobs, ``workers`` at a time; yields (job, exit status, seconds) as they end, in which
    order they do. Ctrl-C ends those that are at work, which keep their frames, and is raised again.
    """
    at_work = _AtWork()
    with ThreadPoolExecutor(workers) as pool:
        ends = {pool.submit(at_work.do, job): job for job in jobs}
        try:
            for end in as_completed(ends):
                yield ends[end], *end.result()
        finally:  # Ctrl-C here, or whoever takes what is yielded takes no more
            pool.shutdown(wait=False, cancel_futures=True)
            at_work.end()


class _AtWork:
    """The processes that run now."""

    def __init__(self):
        self._lock, self._processes, self._ended = threading.Lock(), set(), False

    def do(self, job):
        """Run a job, its words in its log; (exit status, seconds)."""
        began = time.perf_counter()
        with open(job.log, "w", encoding="utf-8") as file:
            with self._lock:
                if self._ended:
                    return -signal.SIGINT, 0.0
                process = subprocess.Popen(
                    job.command(),
                    stdin=subprocess.DEVNULL,
                    stdout=file,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # a terminal's Ctrl-C reaches it once, from here
                )
                self._processes.add(process)
            process.wait()
        with self._lock:
            self._processes.discard(process)
        return process.returncode, time.perf_counter() - began

    def end(self):
        """End what runs as Ctrl-C does, begin nothing more, and wait, but not for ever."""
        with self._lock:
            self._ended, left = True, list(self._processes)
        until = time.monotonic() + _LAST_WORDS
        try:
            for process in left:
                process.send_signal(signal.SIGINT)
            for process in left:
                process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            pass
        finally:
            for process in left:
                process.kill()
