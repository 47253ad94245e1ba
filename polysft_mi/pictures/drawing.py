"""A run's pictures, drawn while the tracker works on.

A track leaves a second processor idle for the most part, and pictures need nothing of it but the
surfaces. So a process of its own opens the scene once more and draws each frame as soon as it is
solved (:class:`polysft_mi.pictures.album.Album`).
"""

import contextlib
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from polyfit.errors import silence_others

from .panels import evenly_spaced

_album = None  # of the drawing process


def _draw_in_background(variant, scene, overrides, template, sequence, album, calls):
    """In the drawing process: make the album (by these arguments) where there is none yet, and call
    these of its methods. Returns what the last one does.
    """
    global _album
    if _album is None:
        threading.Thread(target=_end_with_parent, args=[album[-1]], daemon=True).start()
        if hasattr(os, "nice"):
            os.nice(5)  # below the tracker in rank
        from polyfit.backend import set_variant

        set_variant(variant)
        import drjit as dr

        from polysft_mi.objective import Problem
        from polysft_mi.scene import experiment as scenes

        from .album import Album

        _album = Album(Problem(scenes.load(scene, overrides, template), sequence), *album)
        # not before: with one thread, Mitsuba waits for ever for an EXR texture
        dr.set_thread_count(1)
    result = None
    for name, *arguments in calls:
        result = getattr(_album, name)(*arguments)
    return result


def _end_with_parent(folder):
    """A process pool's processes outlive a parent that is killed."""
    multiprocessing.parent_process().join()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


@contextlib.contextmanager
def _without_main():
    """A process that starts inside does not run the caller's script again, which would call for
    another run where it is not under ``if __name__ == "__main__"``.
    """
    main = sys.modules["__main__"]
    kept = {name: vars(main)[name] for name in ("__spec__", "__file__") if name in vars(main)}
    main.__spec__ = None
    vars(main).pop("__file__", None)
    try:
        yield
    finally:
        vars(main).update(kept)


class Drawing:
    """The pictures of ``problem``'s run in the folder ``out``: hand over each frame when it is
    solved, and :meth:`finish`.

    ``overrides``: of the scene's defaults; ``exr_frames``: how many comparison EXRs at most;
    ``about``: for their headers; ``worth``: frames from which on another process is worth its
    start. Shorter runs are drawn here, at the end, as is everything where the drawing process
    fails, or may not be started.
    """

    def __init__(self, problem, overrides, out, *, exr_frames, about, worth=8):
        self.problem, self.out, self.exr_frames = problem, out, exr_frames
        self._folder = tempfile.TemporaryDirectory(prefix="polysft_mi-", ignore_cleanup_errors=True)
        self._album = out, about, self._folder.name
        self._given, self._jobs, self._pool = {}, [], None
        self._here = None  # the album, where it must be drawn in this process
        self._exr = self._chosen(len(problem.sequence.indices))
        # those of a multiprocessing.Pool may start none of their own
        is_pooled = multiprocessing.current_process().daemon
        if len(problem.sequence.indices) >= worth and not is_pooled:
            import mitsuba as mi

            self._first = (
                mi.variant(),
                problem.experiment.path,
                overrides,
                problem.template,
                problem.sequence,
                self._album,
            )
            self._pool = ProcessPoolExecutor(
                1, multiprocessing.get_context("spawn"), initializer=silence_others
            )
            with _without_main():
                self._submit()  # starts the process

    def _chosen(self, count):
        return set(evenly_spaced(count, self.exr_frames))

    def _submit(self, *calls):
        """Have the album's methods called: the future of the last one, None where the process is
        gone, which :meth:`finish` minds.
        """
        alone = threading.current_thread() is threading.main_thread()
        kept = (
            signal.signal(signal.SIGINT, signal.SIG_IGN) if alone else None
        )  # Ctrl-C is for the tracker; the process inherits this
        try:
            return self._pool.submit(_draw_in_background, *self._first, calls)
        except RuntimeError:  # the pool is broken
            return None
        finally:
            if alone:
                signal.signal(signal.SIGINT, kept)

    def frame(self, k, vertices):
        """The surface of frame ``k`` has ``vertices`` (N, 3) [m, world]; later calls replace
        earlier ones.
        """
        if self._pool is not None:
            self._give(k, vertices)

    def _give(self, k, vertices):
        self._jobs.append(self._submit(self._call(k, vertices)))
        self._given[k] = vertices, k in self._exr

    def _call(self, k, vertices):
        return "draw", k, vertices, self.problem.placed.texcoords, k in self._exr

    def finish(self, vertices, surfaces, fps):
        """Have the rest drawn, all bound, and plots made: what ``finish``, ``bind`` and ``plot`` of
        :class:`polysft_mi.pictures.album.Album` return, each as a function to call for it, in this
        order.

        ``vertices``, ``surfaces`` (T, N, 3) [m]: of all frames, in the world and in the camera
        frame.
        """
        self._exr = self._chosen(len(vertices))
        last = ("finish", surfaces), ("bind", len(surfaces), fps), ("plot",)
        if self._pool is not None:
            for k, v in enumerate(vertices):
                before, exr = self._given.get(k, (None, False))
                if not np.array_equal(before, v) or (k in self._exr and not exr):
                    self._give(k, v)
            jobs = [self._submit(call) for call in last]

        def result(k):
            if self._pool is not None and self._here is None:
                try:
                    return [job.result() for job in (*self._jobs, *jobs[: k + 1])][-1]
                except Exception:  # killed, or out of memory, or what drawing it here will tell
                    pass
            if self._here is None:
                if self._pool is not None:
                    self._pool.shutdown(
                        cancel_futures=True
                    )  # and wait for it: two must not write the same files
                self._draw_here(vertices)
                if k > 0:
                    self._here.finish(surfaces)
            name, *arguments = last[k]
            return getattr(self._here, name)(*arguments)

        def drawn():
            found = result(0)
            self._remove_other_exrs()  # now that none is being written
            return found

        return drawn, *(partial(result, k) for k in (1, 2))

    def _draw_here(self, vertices):
        """Draw all frames in this process; ``vertices`` (T, N, 3) [m, world]."""
        from .album import Album

        self._here = Album(self.problem, *self._album)
        for k, v in enumerate(vertices):
            self._here.draw(*self._call(k, v)[1:])

    def _remove_other_exrs(self):
        """Of frames that were chosen when more, or fewer, were to come."""
        indices = self.problem.sequence.indices
        kept = {f"{indices[k]:03d}.exr" for k in self._exr}
        for path in Path(self.out, "comparison").glob("**/*.exr"):
            if path.name not in kept:
                path.unlink()

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if self._pool is not None:
            # not waited for, its end and that of the interpreter could meet (Python 3.11 then
            # prints an OSError), or it would miss its folder
            self._pool.shutdown(cancel_futures=True)
        if self._here is not None:
            # its threads may still be at work where an error or Ctrl-C ended the rest
            self._here.close()
        self._folder.cleanup()
