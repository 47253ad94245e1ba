"""Every sequence by every solver, and by a per-vertex baseline: accuracy against time a frame.

    python benchmarks/sft.py [--data FOLDER] [--only flag ...] [--methods adam ...] [--frames N]
    [--threads N] [-o out/benchmarks]

Each method is a command, run as a user would and timed as a whole, start-up and everything it
writes included: ``python -m polysft_mi.run`` with the solver ``gauss-newton`` or ``adam``, and
``per_vertex.py``. The figures are those of ``python -m polysft_mi.evaluate``. Each result goes into
``sft.json`` as soon as it is there; the next call does what is missing (all of it with
``--again``), and draws the tables and the plot from everything that was run in the same way. Where
the truth is a mesh, they also say what the best jet of the order used makes of it: one fitted to
the true vertices of each frame.

Writes ``sft.json``, ``sft.md`` and ``sft.png`` into ``docs``, where the results of whole videos
stand already (``--docs FOLDER`` for another; for runs that are shortened or by other settings, into
OUT).
"""

import argparse
import json
import os
import subprocess
import sys
import textwrap
import time

import numpy as np
from best_jets import best_jets

from polysft_mi.backend import add_mode_argument
from polysft_mi.errors import InputError, cli
from polysft_mi.files import aside
from polysft_mi.results.evaluation import LABELS, evaluate, score
from polysft_mi.results.truth import find_truth, load_npz
from polysft_mi.surface import meshio

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))

SCENES = os.path.join(ROOT, "scenes")
DATA = os.environ.get("POLYSFT_DATA") or os.path.join(os.path.dirname(ROOT), "shared", "data")
SEQUENCES = ("flag", "bend", "paper", "curtain", "corner", "kinect_paper", "phi_sft_R1")
METHODS = ("gauss-newton", "adam", "per-vertex")
JET = "best jet"
KINDS = (  # of ground truth: title, figures in the table
    ("True vertices", ("e3d_proc", "en_deg", "e3d")),
    ("Depth points", ("depth_rmse_mm", "depth_rmse_mm_worst", "depth_rmse_allpix_mm")),
    ("Point clouds", ("chamfer_1e4", "chamfer_1e4_worst")),
)
PANELS = ("e3d_proc", "en_deg", "depth_rmse_mm", "chamfer_1e4")
COLOURS = {
    "gauss-newton": ("#c4572e", "o"),
    "adam": ("#3b6ea5", "s"),
    "per-vertex": ("#4b8b3b", "^"),
}


# ---- running -------------------------------------------------------------------------------------


def folder_of(data, sequence):
    """The folder of a sequence in ``data`` or one folder further down; None where there is none."""
    places = (
        [data] + sorted(entry.path for entry in os.scandir(data) if entry.is_dir())
        if os.path.isdir(data)
        else []
    )
    return next(
        (
            path
            for path in (os.path.join(place, sequence) for place in places)
            if os.path.isdir(path)
        ),
        None,
    )


def command(sequence, method, folder, out, setup):
    """The command line of one result, a list; ``setup`` as :func:`setup_of` makes it."""
    define = [f"data={os.path.abspath(folder)}", *setup["define"]]
    if setup["frames"]:
        define.append(f"last={setup['frames'] - 1}")
    if method == "per-vertex":
        line = [sys.executable, os.path.join(ROOT, "benchmarks", "per_vertex.py")]
    else:
        line = [sys.executable, "-m", "polysft_mi.run"]
        define.append(f"solver={method}")
    line += [os.path.join(SCENES, f"{sequence}.xml"), "-o", out, "--overwrite", "-q"]
    if setup["mode"]:
        line += ["-m", setup["mode"]]
    if method == "per-vertex" and setup["iterations"]:
        line += ["--iterations", str(setup["iterations"])]
    return line + [part for text in define for part in ("-D", text)]


def setup_of(options):
    """What two results must share to stand in one table."""
    return {
        name: getattr(options, name)
        for name in ("frames", "threads", "define", "mode", "iterations")
    }


def is_whole(setup):
    """Whether results of this setup are what the documentation shows: whole videos, default
    settings.
    """
    return not (setup["frames"] or setup["threads"] or setup["define"] or setup["iterations"])


def run(sequence, method, folder, out, setup):
    """Run one command and read its accuracy: a result, a dict. A command that fails gives one with
    ``error``, its last line.
    """
    line = command(sequence, method, folder, out, setup)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [ROOT, os.environ.get("PYTHONPATH")])),
    }
    limit = None
    if setup["threads"]:
        environment |= {
            name: str(setup["threads"])
            for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        }
        chosen = set(
            allowed_cores()[: setup["threads"]]
        )  # Dr.Jit and OpenCV take as many threads as there are cores for them
        limit = (
            (lambda: os.sched_setaffinity(0, chosen)) if hasattr(os, "sched_setaffinity") else None
        )
    # the results are for other machines too: paths begin with the sequence's name there
    plain = lambda text: (
        text.replace(os.path.abspath(folder), sequence)
        .replace(folder, sequence)
        .replace(ROOT + os.sep, "")
    )
    result = {
        "sequence": sequence,
        "method": method,
        "setup": setup,
        "command": [plain(part) for part in line[1:]],
    }
    result |= {"machine": machine(setup), "load": os.getloadavg()[0]}
    os.makedirs(os.path.dirname(os.path.abspath(out)), exist_ok=True)
    with open(f"{out}.log", "w+", encoding="utf-8") as log:
        began = time.perf_counter()
        status = subprocess.run(
            line,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            preexec_fn=limit,
        ).returncode
        result["seconds"] = time.perf_counter() - began
        log.seek(0)
        said = log.read().split("\n")
    if status:
        return {
            **result,
            "error": plain(
                next((text for text in reversed(said) if text.strip()), f"exit status {status}")
            ),
        }
    with open(os.path.join(out, "metrics.json"), encoding="utf-8") as file:
        summary = json.load(file)
    orders = [summary["order"]] if summary.get("order") else []
    try:
        figures = {"figures": evaluate(out, folder)}
    except InputError as error:  # none of the first frames may have a truth
        figures = {"figures": {}, "unscored": plain(str(error))}
    return {
        **result,
        **figures,
        "frames": summary["frames"],
        "lost": len(summary.get("lost", {})),
        "seconds_a_frame": result["seconds"] / summary["frames"],
        "iterations": summary.get("iterations_per_window"),
        "orders": [int(min(orders)), int(max(orders))] if orders else None,
        "versions": summary.get("versions"),
    }


def allowed_cores():
    """Numbers of the cores that this process may run on."""
    return (
        sorted(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else list(range(os.cpu_count() or 1))
    )


def machine(setup):
    """The machine in words: CPU, how many of its cores are used, and the GPU where one is asked for
    by name.
    """
    name = "CPU of unknown model"
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next(
                text.partition(":")[2].strip() for text in file if text.startswith("model name")
            )
    except (OSError, StopIteration):
        pass
    cores, used = os.cpu_count() or 1, min(len(allowed_cores()), setup["threads"] or sys.maxsize)
    text = f"{name}, {cores} core{'s' * (cores != 1)}" + (
        f", {used} of them used" if used < cores else ""
    )
    if (setup["mode"] or "").startswith("cuda"):
        ask = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        text += ", " + (
            subprocess.run(ask, capture_output=True, text=True).stdout.strip().split("\n")[0]
            or "GPU of unknown model"
        )
    return text


# ---- the best that a jet can hold ----------------------------------------------------------------


def jet_result(sequence, folder, order, setup):
    """The result of :func:`best_jets` on a sequence whose truth is a mesh; None on others."""
    from polysft_mi.surface.template import Template

    truth_path, obj = find_truth(folder), os.path.join(folder, "template.obj")
    if os.path.isdir(truth_path) or not os.path.isfile(obj):
        return None
    truth = load_npz(truth_path)
    if "vertices" not in truth:
        return None
    vertices, faces, uv = meshio.read_template(obj)
    template = Template.fit(vertices, faces, uv, order, tolerance=np.inf, where=obj)
    meshes = truth["vertices"][: setup["frames"] or None]
    surface = {
        "vertices": best_jets(template, meshes),
        "faces": template.faces,
        "frames": np.arange(len(meshes)),
    }
    figures = score(surface, truth_path)
    return {
        "sequence": sequence,
        "method": JET,
        "setup": setup,
        "frames": len(meshes),
        "orders": [order, order],
        "figures": figures,
    }


# ---- results -------------------------------------------------------------------------------------


def read(path):
    """The results in ``sft.json``, a list; empty where there is no such file."""
    if not os.path.exists(path):
        return []
    try:
        with open(path, encoding="utf-8") as file:
            return json.load(file)["results"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a file of results ({error}); remove it") from None


def add(path, result):
    """Write a result into the file, in place of an earlier one of the same sequence, method, order
    (of a best jet) and setup.
    """
    mine = identity(result)
    kept = [other for other in read(path) if identity(other) != mine]
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump({"results": [*kept, result]}, file, indent=1, default=float)
        file.write("\n")


def identity(result):
    """What no two results in the file share: sequence, method, order (of a best jet), setup."""
    return (
        result["sequence"],
        result["method"],
        result["orders"][1] if result["method"] == JET else None,
        result["setup"],
    )


def find(results, sequence, method, setup, order=None):
    """The good result of one sequence, method and setup, or None."""
    wanted = (sequence, method, order, setup)
    return next((r for r in results if identity(r) == wanted and "error" not in r), None)


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
        rows = [r for r in ordered if names[0] in r.get("figures", {})]
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
            " start-up and outputs included, divided by the number of frames. Measured on:"
        ),
        *(f"- {machine}" for machine in machines or ["no machine yet"]),
        "The methods and figures:",
        "- `gauss-newton` is our solver, the default. `adam` is the paper's.",
        (
            "- `per-vertex` is what a Mitsuba user would write without jets"
            " (`benchmarks/per_vertex.py`): the same renderer and objective, with the template's"
            " vertices as unknowns through `mi.ad.LargeSteps`. It writes no pictures."
        ),
    ]
    if jets:
        text.append(
            "- *Best jet* is the jet that comes closest to the true vertices of each frame, found"
            " by a local search: about the least distance that its order can reach. Its normals"
            " belong to that jet; they are not the best possible."
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
    panels = [
        name for name in PANELS if any(np.isfinite(r["figures"].get(name, np.nan)) for r in timed)
    ]
    if not panels:
        return False
    figure = Figure(figsize=(4.2 * len(panels), 4), dpi=110, layout="constrained")
    for axes, name in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels):
        shown = [
            r for r in timed if np.isfinite(r["figures"].get(name, np.nan))
        ]  # infinite where a sheet has left the truth's rays
        named = []
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


# ---- the command ---------------------------------------------------------------------------------


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "--data",
        metavar="FOLDER",
        default=DATA,
        help="holds the sequences' folders (default, or POLYSFT_DATA: %(default)s)",
    )
    p.add_argument(
        "--only",
        nargs="+",
        metavar="SEQUENCE",
        choices=SEQUENCES,
        default=list(SEQUENCES),
        help=f"of {', '.join(SEQUENCES)}",
    )
    known = f"of {', '.join(METHODS)}; none for the report alone"
    p.add_argument(
        "--methods", nargs="*", metavar="METHOD", choices=METHODS, default=list(METHODS), help=known
    )
    p.add_argument("--frames", type=int, metavar="N", help="only the first N frames of each")
    p.add_argument("--threads", type=int, metavar="N", help="cores for each command (default: all)")
    p.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="iterations a frame of per-vertex (default: its own)",
    )
    p.add_argument(
        "-D",
        dest="define",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="override a <default> of every scene",
    )
    p.add_argument("--again", action="store_true", help="run what has a result, too")
    p.add_argument(
        "-o",
        "--out",
        metavar="FOLDER",
        default="out/benchmarks",
        help="for the runs (default: out/benchmarks)",
    )
    p.add_argument(
        "--docs",
        metavar="FOLDER",
        help=(
            "for sft.json, sft.md and sft.png (default: docs for whole runs by default settings,"
            " else OUT)"
        ),
    )
    add_mode_argument(p)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    for name in ("frames", "threads", "iterations"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: at least 1 is needed")
    for text in options.define:
        if "=" not in text:
            raise InputError(f"-D {text}: NAME=VALUE is needed")
    if not os.path.isdir(options.data):
        raise InputError(
            f"--data {options.data}: no such folder; it must hold the sequences' folders"
        )
    setup = setup_of(options)
    docs = options.docs or (os.path.join(ROOT, "docs") if is_whole(setup) else options.out)
    path = os.path.join(docs, "sft.json")
    os.makedirs(docs, exist_ok=True)
    read(path)  # a damaged file is told before anything runs
    for sequence in options.only:
        folder = folder_of(options.data, sequence)
        if folder is None:
            print(f"{sequence}: not in {options.data}, left out", file=sys.stderr)
            continue
        for method in options.methods:
            if find(read(path), sequence, method, setup) and not options.again:
                print(f"{sequence}, {method}: done before", file=sys.stderr)
                continue
            print(f"{sequence}, {method} ...", file=sys.stderr)
            shortened = f"-first{setup['frames']}" if setup["frames"] else ""
            result = run(
                sequence,
                method,
                folder,
                os.path.join(options.out, "sft", f"{sequence}-{method}{shortened}"),
                setup,
            )
            add(path, result)
            told = (
                result.get("error")
                or f"{result['seconds_a_frame']:.2f} s a frame, {json.dumps(result['figures'])}"
            )
            print(f"{sequence}, {method}: {told}", file=sys.stderr)
        results = [r for r in read(path) if r["sequence"] == sequence and r["setup"] == setup]
        for order in sorted(
            {r["orders"][1] for r in results if r.get("orders") and r["method"] != JET}
        ):
            if options.again or not find(results, sequence, JET, setup, order):
                result = jet_result(sequence, folder, order, setup)
                if result:
                    add(path, result)
    print(report([r for r in read(path) if r["setup"] == setup], docs))
    print(f"\nin {docs}: sft.json, sft.md, sft.png")


if __name__ == "__main__":
    cli(main)
