"""The report of ``sft.py``: results as tables, as a page and as a plot of accuracy against time."""

import os
import textwrap

import numpy as np
from sft_results import JET, METHODS, SEQUENCES, SIMULATED

from polyfit.files import aside
from polysft_mi.results.evaluation import LABELS

KINDS = (  # of ground truth: title, figures in the table
    ("True vertices", ("e3d_proc", "en_deg", "e3d")),
    ("True vertices, with those in view", ("e3d_proc_seen", "en_deg_seen", "e3d_proc")),
    ("Depth points", ("depth_rmse_mm", "depth_rmse_mm_worst", "depth_rmse_allpix_mm")),
    ("Point clouds", ("chamfer_1e4", "chamfer_1e4_worst")),
)
PANELS = ("e3d_proc", "en_deg", "depth_rmse_mm", "e3d_proc_seen", "en_deg_seen", "chamfer_1e4")
COLOURS = {
    "gauss-newton": ("#c4572e", "o"),
    "adam": ("#3b6ea5", "s"),
    "adam-reweighted": ("#7d9fc9", "D"),
    "per-vertex": ("#4b8b3b", "^"),
}


def against(results, others):
    """Lines of Markdown: each result's figures and seconds beside those of the same sequence,
    method and frames among ``others``, as ratios, and their geometric means.
    """
    lines = ["| sequence | method | figure | before | now | ratio | seconds |", _row(["---"] * 7)]
    ratios, times = [], []
    for r in results:
        same = lambda o, r=r: all(o.get(k) == r.get(k) for k in ("sequence", "method", "frames"))
        other = next((o for o in others if same(o) and "error" not in o), None)
        shown = next((names for _, names in KINDS[::-1] if _shows(r, names[0])), None)
        if other is None or shown is None or r["method"] == JET:
            continue
        seconds = r["seconds_a_frame"] / other["seconds_a_frame"]
        times.append(seconds)
        for name in shown[: 2 if "deg" in shown[1] else 1]:
            before, now = other["figures"][name], r["figures"][name]
            if np.isfinite([now, before]).all():
                ratios.append(now / before)
            numbers = f"{before:.4g}", f"{now:.4g}", f"{now / before:.3f}", f"{seconds:.2f}"
            lines.append(_row([r["sequence"], r["method"], LABELS[name], *numbers]))
    if ratios:
        means = (f"{np.exp(np.mean(np.log(x))):.3f}" for x in (ratios, times))
        lines.append(_row(["geometric mean", "", "", "", "", *means]))
    return "\n".join(lines)


def table(results):
    """Results as Markdown: a table for each kind of ground truth, sequences and methods in their
    order here.
    """
    place = {name: k for k, name in enumerate((*METHODS, JET))}
    ordered = sorted(
        results,
        key=lambda r: (SEQUENCES.index(r["sequence"]), place[r["method"]], r.get("orders") or []),
    )
    parts = []
    for title, names in KINDS:
        rows = [r for r in ordered if _shows(r, names[0])]
        if not rows:
            continue
        head = [
            "sequence",
            "method",
            "order",
            "frames",
            *(LABELS[name] for name in names),
            "seconds a frame",
            "iterations a window",
        ]
        lines = [f"## {title}", "", _row(head), _row(["---"] * 4 + ["---:"] * (len(head) - 4))]
        for r in rows:
            method = "*best jet*" if r["method"] == JET else f"`{r['method']}`"
            orders = "–" if not r.get("orders") else "–".join(map(str, dict.fromkeys(r["orders"])))
            time_taken = [
                _number(r.get("seconds_a_frame"), ".3g"),
                _number(r.get("iterations"), ".0f"),
            ]
            frames = f"{r['frames']}, {r['lost']} lost" if r.get("lost") else r["frames"]
            figures = [
                f"{r['figures'][name]:.4g}" if name in r["figures"] else "–" for name in names
            ]
            lines.append(_row([r["sequence"], method, orders, frames, *figures, *time_taken]))
        parts.append("\n".join(lines))
    for key, title in (("error", "Failed"), ("unscored", "Without figures")):
        lines = [f"- {r['sequence']}, `{r['method']}`: {r[key]}" for r in ordered if key in r]
        if lines:
            parts.append("\n".join([f"## {title}", "", *lines]))
    return "\n\n".join(parts)


def _shows(result, name):
    """Whether a result is shown by a figure: where it is known what is in view, by that."""
    figures = result.get("figures", {})
    return name in figures and f"{name}_seen" not in figures


def _row(cells):
    return "| " + " | ".join(map(str, cells)) + " |"


def _number(value, form):
    return "–" if value is None else format(value, form)


def page(results, picture):
    """The text of ``sft.md``."""
    machines = sorted(
        {f"{r['machine']}, `{r['versions']['variant']}`" for r in results if r.get("versions")}
    )
    jets = any(r["method"] == JET for r in results)
    text = [
        "# Accuracy and time of the solvers",
        (
            "`python benchmarks/sft.py` makes this page. It compares the accuracy and the time of"
            " the solvers on every sequence. The time a frame is that of the whole command,"
            " start-up and outputs included, divided by the number of frames. Others share the"
            " machine: what takes 0.4 s in one hour takes 0.9 s in another, and each method was"
            " measured in hours of its own. Measured on:"
        ),
        *(f"- {machine}" for machine in machines or ["no machine yet"]),
        "The methods and figures:",
        (
            "- `gauss-newton` is the default. `adam` is the paper's way (`preset` = `paper`). Its"
            " rows of `curtain`, `corner` and `phi_sft_R1` are of an earlier state, on a slower"
            " machine, with the frame by PCA, and with image losses that are means over the sheet,"
            " not over the image; by these flag, bend and paper were 0.0057, 0.0204 and 0.0244."
            " These three were run beside much other work: their time is twice what it is alone."
        ),
        (
            "- `per-vertex` is what a Mitsuba user would write without jets"
            " (`benchmarks/per_vertex.py`): the same renderer, with the template's vertices as"
            " unknowns through `mi.ad.LargeSteps`, and the paper's terms, with image losses that"
            " are means over the sheet, which does better here. It writes no pictures."
        ),
    ]
    if any(r["method"] == "adam-reweighted" for r in results):
        text.append(
            "- `adam-reweighted` is `adam` with lengths ten times as heavy (`k_mi` = 1), ties"
            " between frames a thousandth (`k_tc` = 5e-5, as if a mean over the vertices), and"
            " masks a tenth (`k_silhouette` = 0.05). On Kinect-Paper, which has no masks, with"
            " those of `polysft prepare`, drawn in by 1.3 pixels."
        )
    if any(r["sequence"] in SIMULATED for r in results):
        text.append(
            f"- {', '.join(SIMULATED)}: made by `python benchmarks/simulate.py FOLDER --seed 1"
            f" --only {' '.join(SIMULATED)}`; `--data DATA FOLDER` finds them."
        )
    text.append(
        "- Each row is one run. Rounding alone moves some of them: with `-D k_mi` changed in its"
        " fifth digit, three to six runs each gave e3d of vertices in view from 0.0011 to 0.0022"
        " for ball, 0.0020 to 0.0052 for roll, 0.0083 to 0.0124 for tube; curtain and corner move"
        " by a fifth and a half, the smooth sheets hardly."
    )
    if jets:
        text.append(
            "- *Best jet* is the jet that comes closest to the true vertices of each frame, or the"
            " jets of a template of several patches, found by a local search: about the least"
            " distance that their order can reach without a relief. Normals belong to these jets;"
            " they are not the best possible."
        )
    if any(
        np.isinf(value)
        for r in results
        for value in r.get("figures", {}).values()
        if isinstance(value, float)
    ):
        text.append(
            "- *inf*: in some frame no ray of the ground truth meets the surface. The plot leaves"
            " these out."
        )
    text = [
        textwrap.fill(
            t, 100, subsequent_indent="  " if t[:2] == "- " else "", break_on_hyphens=False
        )
        for t in text
    ]
    if any(r.get("seconds_a_frame") for r in results):
        text.append(f"![Accuracy against seconds a frame, one marker a method]({picture})")
    return "\n\n".join([*text, table(results)]) + "\n"


def plot(path, results):
    """Accuracy against seconds a frame, a panel a figure, a marker a method; lines join the methods
    of a sequence.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter

    timed = [r for r in results if r.get("seconds_a_frame") and "figures" in r]
    points_of = lambda name: [  # infinite where a sheet has left the truth's rays
        r for r in timed if _shows(r, name) and np.isfinite(r["figures"][name])
    ]
    panels = [name for name in PANELS if points_of(name)]
    if not panels:
        return False
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.2 * columns, 4 * rows), dpi=110, layout="constrained")
    for place, name in enumerate(panels):
        axes, shown, named = figure.add_subplot(rows, columns, place + 1), points_of(name), []
        for sequence in dict.fromkeys(r["sequence"] for r in shown):
            points = sorted(
                (r["seconds_a_frame"], r["figures"][name])
                for r in shown
                if r["sequence"] == sequence
            )
            axes.plot(*zip(*points), color="0.85", linewidth=0.8, zorder=1)
            named.append((points[0], sequence))
        for method, (colour, marker) in COLOURS.items():
            points = [
                (r["seconds_a_frame"], r["figures"][name]) for r in shown if r["method"] == method
            ]
            if points:
                axes.plot(*zip(*points), marker, color=colour, markersize=6, label=method, zorder=2)
        axes.set_xscale("log"), axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):  # plain numbers
            axis.set_major_formatter(LogFormatter()), axis.set_minor_formatter(LogFormatter())
        axes.margins(0.15)
        _label(axes, named)
        axes.set_title(LABELS[name], fontsize=9, loc="left")
        axes.set_xlabel("seconds a frame", fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        axes.grid(True, color="0.93", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    with aside(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")
    return True


def _label(axes, named):
    """Write names, (point, name) each, beside their points, upwards of one another where points lie
    close together.
    """
    axes.autoscale_view()  # else the limits come later
    position = axes.transLimits.transform  # of logarithms, to shares of the axes
    places = [(*position(np.log10(point)), name) for point, name in named]
    least = -np.inf
    for x, y, name in sorted(places, key=lambda place: place[1]):
        y = max(y, least)
        least = y + 0.04
        axes.text(x + 0.025, y, name, transform=axes.transAxes, fontsize=7, color="0.35")


def report(results, folder):
    """Write ``sft.md`` and ``sft.png`` into a folder; returns the tables."""
    os.makedirs(folder, exist_ok=True)
    plot(os.path.join(folder, "sft.png"), results)
    with (
        aside(os.path.join(folder, "sft.md")) as temporary,
        open(temporary, "w", encoding="utf-8") as file,
    ):
        file.write(page(results, "sft.png"))
    return table(results)
