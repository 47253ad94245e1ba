"""One page, in one file, that shows a run in any browser and without a network."""

import os
from importlib import resources

from polyfit.files import aside, json_text
from polysft_mi.errors import InputError
from polysft_mi.results import Run

from ..panels import PEAKS, box_of, evenly_spaced
from .content import about, figures, further, labels, loss, subtitle, warning
from .images import images, picture
from .surface import mesh, scalars


def write_report(out, path=None, *, truth=None, frames=200, positions=450_000):
    """Write the report of the run in the folder ``out`` to ``path`` (default: ``report.html`` in
    it); returns the path.

    At most ``frames`` frames are shown, spread evenly, and fewer where they have more than
    ``positions`` vertices together.

    ``truth``: ground truth as :meth:`polysft_mi.results.truth.Truth.open` takes it. Raises
    InputError.
    """
    run = Run.open(out)
    path = run.path("report.html") if path is None else path
    if os.path.isdir(path) or not os.path.isdir(os.path.dirname(os.path.abspath(path))):
        raise InputError(f"{path}: is not a file in a folder that exists")
    if not os.fspath(path).lower().endswith((".html", ".htm")):
        raise InputError(f"{path}: a name that ends in .html is needed")
    count, vertices = run.vertices.shape[:2]
    shown = evenly_spaced(count, min(frames, max(1, positions // vertices)))
    columns, cards, distance = figures(run, truth)
    pictures, errors = images(run, shown)
    data = {
        "title": os.path.basename(os.path.abspath(out)),
        "subtitle": subtitle(run, shown),
        "warning": warning(run),
        "cards": cards,
        "command": run.about.get("command", ""),
        "settings": [[name, value or ""] for name, value in run.settings.items()],
        "about": about(run),
        "footer": (
            f"polysft_mi {run.about.get('versions', {}).get('polysft_mi', '')}. Lengths in metres,"
            " camera frame turned to z up."
        ),
        "shown": shown,
        "fps": run.fps,
        "peaks": {name: f"{peak:g} or more" for name, peak in PEAKS.items()},
        "shows": _shows(run),
        "columns": columns,
        "labels": labels(run),
        "cameras": [
            {"name": name, "text": text, "picture": picture(path)}
            for name, text, path in further(run)
        ],
        "images": pictures,
        "mesh": mesh(run, shown),
        "scalars": scalars(run, shown, errors, distance),
        "loss": loss(run.log()),
    }
    from plotly.offline import get_plotlyjs

    page = resources.files("polysft_mi").joinpath("data/report.html").read_text(encoding="utf-8")
    text = (
        json_text(data, separators=(",", ":")).replace("</", "<\\/").replace("<!--", "<\\u0021--")
    )
    title = data["title"].replace("&", "&amp;").replace("<", "&lt;")
    for name, value in (("title", title), ("plotly", get_plotlyjs()), ("data", text)):
        before, _, after = page.partition("{{" + name + "}}")
        page = before + value + after
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(page)
    return path


def _shows(run):
    """What part of the video the pictures show, in words."""
    box, camera = box_of(run), run.camera
    if camera is None or box.size == (camera.width, camera.height):
        return ""
    return (
        f"The pictures are cropped to the sheet: x {box.left} to {box.right}, y {box.top} to"
        f" {box.bottom} of {camera.width}×{camera.height} pixels."
    )
