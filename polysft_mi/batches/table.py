"""The result of a batch: ``batch.json``, ``batch.md``, and ``batch.html`` with a picture a line."""

from __future__ import annotations

import base64
import contextlib
import html
import io
import json
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from polyfit.errors import InputError
from polyfit.files import aside

from .jobs import Job, read_json

# By kind: the file that holds a job's figures, and (figure, its heading, its form)
_FIGURES: dict[str, tuple[str, list[tuple[str, str, str]]]] = {
    "run": (
        "metrics.json",
        [
            ("frames", "frames", "{}"),
            ("psnr_mask", "PSNR [dB]", "{:.2f}"),
            ("ssim_mask", "SSIM", "{:.3f}"),
            ("seconds_per_frame", "s a frame", "{:.2f}"),
            ("lost", "lost", "{}"),
        ],
    ),
    "drape": (
        "figures.json",
        [
            ("frames", "frames", "{}"),
            ("collision", "inside the body [%]", "{:.2f}"),
            ("edge", "edges [%]", "{:.2f}"),
        ],
    ),
}
_HEAD = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 2em; color: #222 }}
table {{ border-collapse: collapse }}
th, td {{ padding: .4em .8em; border-bottom: 1px solid #ddd; text-align: left }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums }}
.failed td {{ background: #fdecea }}
img {{ max-width: 640px; max-height: 160px; display: block }}
</style>
<h1>{title}</h1><p>{about}</p>
<table><tr>{columns}</tr>
"""


class Table:
    """The table of ``jobs``, all of one kind, in the folder ``out``; ``options``: what they have
    in common. :meth:`ended` tells it how a job ended; it is written anew each time.
    """

    def __init__(self, jobs: Sequence[Job], out: Path, options: Sequence[str]) -> None:
        self.out, self.jobs, self.options = out, list(jobs), list(options)
        known = {row["name"]: row for row in read_json(out / "batch.json").get("jobs", [])}
        self._rows = {job.name: self._row(job, known.get(job.name, {})) for job in jobs}
        self._pictures: dict[str, str] = {}

    @classmethod
    def opened(cls, jobs: Sequence[Job], out: Path, options: Sequence[str]) -> Table:
        """The table, its folder made where it is new. Raises InputError where ``out`` holds
        anything but a batch, or what a batch with other options made.
        """
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is a file; OUT must be a folder")
        before = read_json(out / "batch.json")
        if not before and out.exists() and any(out.iterdir()):
            raise InputError(f"{out}: is not empty and holds no batch; give an empty or new folder")
        left = any((out / row["name"]).exists() for row in before.get("jobs", []))
        if left and before.get("options") != list(options):
            made = shlex.join(before.get("options", [])) or "none"
            raise InputError(
                f"{out}: was made with other options ({made}); go on with those, or give another"
                " folder"
            )
        out.mkdir(parents=True, exist_ok=True)
        return cls(jobs, out, options)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A line a job: ``name``, ``status`` ("done", "failed", "waiting"), ``seconds`` of its
        last process, its figures, ``error``: the last line that it said, where it failed.
        """
        return [self._rows[job.name] for job in self.jobs]

    def look_again(self) -> None:
        """Take up what jobs left that did not end by themselves."""
        for job in self.jobs:
            if self._rows[job.name]["status"] == "waiting":
                self._rows[job.name] = self._row(job, {})
        self.write()

    def count(self, status: str) -> int:
        """How many jobs have the status."""
        return sum(row["status"] == status for row in self.rows)

    def ended(self, job: Job, status: int, seconds: float) -> dict[str, Any]:
        """The line of a job whose process ended with the exit ``status``, after ``seconds``."""
        row = self._row(job, {"seconds": round(seconds, 2)})
        if status != 0 or row["status"] != "done":
            row |= {"status": "failed", "error": _last_line(job.log) or f"exit status {status}"}
        self._rows[job.name] = row
        self.write()
        return row

    def _row(self, job, known):
        row = {"name": job.name, "kind": job.kind, "arguments": list(job.arguments)}
        row["status"] = "done" if job.done() else "waiting"
        file, figures = _FIGURES[job.kind]
        found = read_json(job.folder / file)
        if "seconds" in known:
            row["seconds"] = known["seconds"]
        for name, _, _ in figures:
            if name in found:
                row[name] = len(found[name]) if name == "lost" else found[name]
        return row

    def write(self) -> None:
        """Write the three files."""
        about = {"options": self.options, "jobs": self.rows}
        self._file("batch.json", json.dumps(about, indent=1) + "\n")
        columns = ["name", "status", "s", *(title for _, title, _ in self._figures), "error"]
        lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        for row in self.rows:
            cells = [row["name"], *self._cells(row), _escaped(row.get("error", ""))]
            lines.append(f"| {' | '.join(cells)} |")
        self._file("batch.md", "\n".join(lines) + "\n")
        self._file("batch.html", self._page(columns))

    @property
    def _figures(self):
        return _FIGURES[self.jobs[0].kind][1]

    def _cells(self, row):
        seconds = f"{row['seconds']:.0f}" if "seconds" in row else ""
        forms = ((form, row.get(name)) for name, _, form in self._figures)
        return [row["status"], seconds, *("" if x is None else f.format(x) for f, x in forms)]

    def _page(self, columns):
        counts = ", ".join(
            f"{self.count(s)} {s}" for s in ("done", "failed", "waiting") if self.count(s)
        )
        options = html.escape(" ".join(self.options))
        text = _HEAD.format(
            title=html.escape(os.path.basename(os.path.abspath(self.out))),
            about=counts + (f"; options: <code>{options}</code>" if options else ""),
            columns="".join(f"<th>{html.escape(c)}</th>" for c in (*columns, "picture")),
        )
        for job, row in zip(self.jobs, self.rows):
            target = next((n for n in _PAGES if (job.folder / n).exists()), f"../{job.name}.log")
            link = html.escape(f"{job.name}/{target}".replace(f"{job.name}/../", ""))
            status, *numbers = self._cells(row)
            shown = self._picture(job) if row["status"] == "done" else ""
            text += (
                f'<tr class="{status}"><td><a href="{link}">{html.escape(job.name)}</a></td>'
                f"<td>{status}</td>"
                + "".join(f'<td class="n">{n}</td>' for n in numbers)
                + f"<td>{html.escape(row.get('error', ''))}</td><td>{shown}</td></tr>\n"
            )
        return text + "</table></html>\n"

    def _picture(self, job):
        if job.name not in self._pictures:
            image = None
            with contextlib.suppress(Exception):  # the line stands without its picture
                image = _PICTURES[job.kind](job.folder)
            self._pictures[job.name] = "" if image is None else _inline(image)
        return self._pictures[job.name]

    def _file(self, name, text):
        with (
            aside(os.path.join(self.out, name)) as temporary,
            open(temporary, "w", encoding="utf-8") as file,
        ):
            file.write(text)


_PAGES = ("report.html", "drape.mp4")


def _of_run(folder):
    """The middle one of the pictures in a run's comparison video."""
    from polyfit.pictures import read_video

    path = folder / "comparison.mp4"
    if path.exists():
        frames = list(read_video(path))
    else:
        frames = [_read(p) for p in sorted((folder / "comparison").glob("*.png"))]
    return frames[len(frames) // 2] if frames else None


def _of_drape(folder):
    paths = sorted((folder / "frames").glob("*.png"))
    return _read(paths[len(paths) // 2]) if paths else None


_PICTURES: Mapping[str, Callable[[Path], Any]] = {"run": _of_run, "drape": _of_drape}


def _read(path):
    from polysft_mi.scene import read_rgb

    return read_rgb(path)


def _inline(image):
    from PIL import Image

    small, data = Image.fromarray(image), io.BytesIO()
    small.thumbnail((1280, 320))
    small.save(data, "WEBP", quality=80)
    return f'<img alt="" src="data:image/webp;base64,{base64.b64encode(data.getvalue()).decode()}">'


def _last_line(log):
    """The last line that a job said, without the mark of an error."""
    try:
        lines = [s for s in log.read_text("utf-8", "replace").splitlines() if s.strip()]
    except OSError:
        return ""
    return lines[-1].strip().removeprefix("error: ") if lines else ""


def _escaped(text):
    return text.replace("|", "\\|")
