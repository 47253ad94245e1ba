"""The page that holds this project beside the paper, sentence by sentence: docs/paper.md.

    python docs/paper.py

Figures are read from the JSON files of docs/, which the benchmarks write (``-o docs``); what was
not measured yet says so. tests/house/test_paper.py parses every command.
"""

import argparse
import json
from pathlib import Path

from paper_entries import SECTIONS

DOCS = Path(__file__).resolve().parent
HEAD = """# The paper, beside this project

*Patch-based Representation and Learning for Efficient Deformation Modeling* (3DV 2026), in its own
order: what it says, the command that does it here, its figures and ours, and why they differ.
`python docs/paper.py` makes this page from the JSON files that the benchmarks write into `docs/`.

One word asks for the paper and nothing else; every option beside it wins over it:

    python -m polysft_mi.run scenes/demo.xml -D preset=paper -o OUT
    python -m polyfit garment.obj -o surface.ply --preset paper
    python -m polyfit.train MESH ... -o OUT --preset paper
    python -m onefit.train -o OUT --preset paper
    python -m onefit.drape dress dance -o OUT --preset paper

`make demo-paper` runs the first of them, with its report. DATA is a folder with the sequences and
garments, RUNS one for trained networks; neither comes with this project. *Not measured yet* means
what it says: the command is there, the hours were not.
"""


def read(folder=DOCS):
    """The JSON files of ``folder`` by their names; an empty dict where there is none."""
    names = ("sft", "stability_demo", "stability_kinect_paper", "readings", "stretch")
    names += ("polyfit_reconstruction", "polyfit_accuracy", "onefit_paper", "onefit_speed", "gpu")
    found = {}
    for name in names:
        path = Path(folder) / f"{name}.json"
        found[name] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return found


def page(data):
    """The page's text."""
    parts = [HEAD]
    for title, entries in SECTIONS.items():
        parts.append(f"## {title}\n")
        for entry in entries:
            parts.append(f"**{entry.where}.** {entry.says}\n")
            if entry.commands:
                parts.append("".join(f"    {line}\n" for line in entry.commands))
            if entry.figures:
                parts.append((entry.figures(data) or "*Not measured yet.*") + "\n")
            if entry.why:
                parts.append(f"*Why they differ:* {entry.why}\n")
    return "\n".join(wrapped(part) for part in parts)


def wrapped(part):
    """Prose at 100 columns; code, tables and headings as they are."""
    import textwrap

    if part.startswith(("    ", "|", "#")) or "\n\n" in part.strip():
        return part
    text = textwrap.fill(
        " ".join(part.split()), 100, break_long_words=False, break_on_hyphens=False
    )
    return text + "\n"


def plot_orders(found, path):
    """Height and normals over the order of the jets, as a picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(8, 3), layout="constrained")
    for axis, name, title in zip(axes, ("height", "angle"), ("RMS of height, in s", "normals, °")):
        for kind in next(iter(found.values())):
            for frame, style in (("PCA", "--"), ("STN", "-")):
                values = [row[kind][frame][name] for row in found.values()]
                axis.plot(list(map(int, found)), values, style, label=f"{kind}, {frame}")
        axis.set(xlabel="order", ylabel=title, ylim=(0, None))
    axes[0].legend()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def main():
    data = read()
    if orders := data["polyfit_accuracy"].get("orders"):
        plot_orders(orders, DOCS / "paper_orders.png")
    (DOCS / "paper.md").write_text(page(data), encoding="utf-8")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
