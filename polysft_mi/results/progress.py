"""Where a run is, told on the terminal."""

import sys
import time


class Progress:
    """The progress of a run: a bar on a terminal, a line every ten seconds elsewhere, nothing with
    ``quiet``.

    ``frames``: their number; ``settings``: :class:`polysft_mi.scene.settings.Settings`.
    """

    def __init__(self, frames, settings, quiet):
        self.frames, self.windows = frames, frames - min(settings.window, frames) + 1
        # a sweep goes over all frames but the first and the last, and then over all but the first
        self.total = self.windows + settings.sweeps * max(0, 2 * frames - 3)
        self.period, self.quiet, self.terminal = settings.period, quiet, sys.stderr.isatty()
        self._start, self._began, self._done, self._shown = None, time.perf_counter(), None, 0.0

    def __enter__(self):
        if self.terminal and not self.quiet:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[state]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bar.start()
            self._task = self._bar.add_task("tracking", total=self.total, state="")
        return self

    def __exit__(self, *_):
        if self.terminal and not self.quiet:
            self._bar.stop()

    def __call__(self, done, frame, iteration, total, terms):
        if self.quiet:
            return
        now = time.perf_counter()
        if self._start is None:
            self._start, self._began = done, now
        if done >= self.total:  # a second pass, which a noisy video gets
            self.total += self.windows
            if self.terminal:
                self._bar.update(self._task, total=self.total)
        if done != self._done:
            self._done = done
        elif now - self._shown < (0.2 if self.terminal else 10):
            return
        self._shown = now
        again = "again " if done >= self.windows else ""
        at = f"it {iteration} " if iteration else ""  # where lines are rare, a frame has begun
        state = f"{again}frame {frame + 1}/{self.frames} {at}loss {total:.4g}"
        detail = " ".join(f"{name[:3]} {value:.2g}" for name, value in terms.items() if value)
        if self.terminal:
            self._bar.update(
                self._task,
                completed=done + iteration / self.period,
                state=f"{state} ({detail})",
            )
        else:
            solved = done - self._start
            left = (
                f", {(now - self._began) / solved * (self.total - done):.0f} s left"
                if solved
                else ""
            )
            print(f"{state} ({detail}){left}", file=sys.stderr)

    def say(self, text):
        if self.quiet:
            return
        if self.terminal:
            self._bar.console.print(text, highlight=False)
        else:
            print(text, file=sys.stderr)

    def stage(self, name):
        """What is being written after the tracking."""
        if self.terminal and not self.quiet:
            self._bar.update(self._task, completed=self.total, state=f"writing {name}")
