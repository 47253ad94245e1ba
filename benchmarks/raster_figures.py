"""The figures of ``benchmarks/raster.py``: medians and ratios of what it measured, as a table, a
plot, a file and lines of text.
"""

import json
import os
import sys

import numpy as np
from cases import parse_size

from polyfit.files import aside

CONTENDERS = ("raster", "raster, mi", "prb_projective", "deodr", "nvdiffrast", "drtk")
#: of a variant's figures: the name of its file, and of its table's marks in docs/raster.md
ON_CPU, ON_GPU = ("raster", "speed"), ("raster_cuda", "speed, cuda")
TARGET = ("640x480", 33, 3.0)  # a case, and how many times faster raster is to be there


def summarise(size, grid, times, memory):
    """The figures of a case: medians, quartiles, ratios."""
    passes = {name: np.array(values) for name, values in times["passes"].items()}
    whole = {name: passes[name] + np.array(times["moves"][name]) for name in passes}
    case = {
        "size": size,
        "vertices": grid * grid,
        "triangles": 2 * (grid - 1) ** 2,
        "turns": len(passes["raster"]),
        "contenders": {},
    }
    for name in passes:
        low, middle, high = np.percentile(passes[name], [25, 50, 75])
        case["contenders"][name] = {
            "ms": middle,
            "ms_quartiles": [low, high],
            "picture_ms": float(np.median(times["pictures"][name])),
            "move_ms": float(np.median(times["moves"][name])),
            "ratio": float(np.median(passes[name] / passes["raster"])),
            "ratio_quartiles": list(np.percentile(passes[name] / passes["raster"], [25, 75])),
            "ratio_with_move": float(np.median(whole[name] / whole["raster"])),
            **{k: v for k, v in memory[name].items() if k.endswith("_mb")},
        }
    return {
        **case,
        **{k: v for k, v in times.items() if k.startswith(("coverage", "mean_", "gradient_"))},
    }


def judge_long_run(growth, kernels):
    """Memory between iteration 50 (or a sixth) and the end, and kernels that came new after the
    second iteration.
    """
    held, new = growth["resident_mb"], kernels["new"]
    early = min(50, len(held) // 6)
    return {
        "iterations": len(held),
        "early_iteration": early,
        "early_mb": held[early - 1],
        "late_mb": held[-1],
        "growth_mb": held[-1] - held[early - 1],
        "kernels_an_iteration": float(np.median(kernels["launched"])),
        "new_kernels_first_two": sum(new[:2]),
        "new_kernels_later": sum(new[2:]),
        "iterations_with_new_kernels": [k + 1 for k, n in enumerate(new) if n],
    }


def names_in(cases):
    """Names of the contenders that any of the cases has."""
    return [name for name in CONTENDERS if any(name in case["contenders"] for case in cases)]


def print_likeness(case):
    """How far the other contenders' pictures and gradients are from raster's."""
    for name in case["contenders"]:
        key = "mean_absolute_difference" + ("" if name == "prb_projective" else f"_of_{name}")
        if key in case:
            print(
                f"{case['size']}, {case['vertices']:,} vertices: {name}'s picture is"
                f" {case[key]:.4f} from raster's, mean absolute difference on the sheet; cosine of"
                f" the gradients {case[f'gradient_cosine_of_{name}']:.3f}",
                file=sys.stderr,
            )


def print_table(cases):
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 120)
    table = Table(
        title=(
            "One forward + backward pass in ms, how many times that of raster; peak memory of the"
            " process in MB (of Dr.Jit; on a GPU, on the device)"
        )
    )
    table.add_column("image")
    table.add_column("triangles", justify="right")
    names = names_in(cases)
    for name in names:
        table.add_column(name, justify="right")
    table.add_column("move, ms", justify="right")
    for case in cases:
        cells = []
        for name in names:
            c = case["contenders"].get(name)
            if c is None:
                cells.append("")
                continue
            ratio = "" if name == "raster" else f"  [bold]{c['ratio']:.1f}x[/bold]"
            own = c.get("device_peak_mb", c["drjit_peak_mb"])
            cells.append(f"{c['ms']:.1f}{ratio}\n{c['peak_mb']:.0f} ({own:.0f})")
        table.add_row(
            case["size"],
            f"{case['triangles']:,}",
            *cells,
            f"{case['contenders']['raster']['move_ms']:.1f}",
        )
    console.print(table)


def plot(path, cases):
    from matplotlib.figure import Figure

    triangles = sorted({case["triangles"] for case in cases})
    figure = Figure(figsize=(4.2 * len(triangles) + 0.6, 4), dpi=110, layout="constrained")
    rows = figure.subplots(1, len(triangles), sharey=True, squeeze=False)[0]
    colours = ("#c4572e", "#e0a58c", "#3b6ea5", "#6a994e", "#7d5ba6", "#b08900")
    names = names_in(cases)
    for axes, count in zip(rows, triangles):
        chosen = [case for case in cases if case["triangles"] == count]
        at = [np.prod(parse_size(case["size"])) for case in chosen]
        for name, colour in zip(names, colours):
            have = [case["contenders"].get(name, {}) for case in chosen]
            ms = [c.get("ms", np.nan) for c in have]
            axes.plot(at, ms, color=colour, marker="o", markersize=4, label=name)
            if name == "prb_projective":
                for x, y, c in zip(at, ms, have):
                    axes.annotate(
                        f"{c['ratio']:.1f}×" if c else "",
                        (x, y),
                        (0, 7),
                        textcoords="offset points",
                        ha="center",
                        fontsize=8,
                    )
        axes.set_xscale("log"), axes.set_yscale("log")
        axes.set_xticks(
            at, [case["size"].replace("x", "×") for case in chosen], fontsize=8, rotation=30
        )
        axes.minorticks_off()
        axes.margins(y=0.12)
        axes.set_title(f"{count:,} triangles", fontsize=10)
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    rows[0].set_ylabel("forward + backward [ms]")
    rows[0].legend(frameon=False, fontsize=8)
    with aside(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")


def print_end(report, out):
    size, grid, wanted = TARGET
    for case in report["cases"]:
        c = case["contenders"].get("prb_projective")
        if c and (case["size"], case["vertices"]) == (size, grid * grid):
            low, high = c["ratio_quartiles"]
            print(
                f"{size}, {grid * grid:,} vertices: raster, RGB and alpha, is {c['ratio']:.2f}"
                f" times as fast as prb_projective, RGB (quartiles {low:.2f} to {high:.2f};"
                f" {c['ratio_with_move']:.2f} with the time to move the sheet); wanted: at least"
                f" {wanted:g}"
            )
    r = report["long_run"]
    print(
        f"{r['iterations']} iterations of raster at {r['size']}: {r['growth_mb']:+.1f} MB between"
        f" iteration {r['early_iteration']} and the last ({r['late_mb']:.0f} MB);"
        f" {r['kernels_an_iteration']:.0f} kernels an iteration, {r['new_kernels_later']} new after"
        " the second"
    )
    load, name = report["load"], _names(report)[0]
    print(
        f"{report['versions']['variant']}, {report['versions']['machine']}, load {min(load):.1f} to"
        f" {max(load):.1f}; in {out}: {name}.json, {name}.png"
    )


def page_table(report):
    """The table of docs/raster.md, as text."""
    names = names_in(report["cases"])
    several = len({case["triangles"] for case in report["cases"]}) > 1
    lines = [
        f"| image | {' | '.join(names)} |",
        "|---" * (1 + len(names)) + "|",
    ]
    for case in report["cases"]:
        cells = []
        for name in names:
            c = case["contenders"].get(name)
            if c is None:
                cells.append("")
                continue
            memory = c.get("device_peak_mb", c["peak_mb"] - c["started_mb"])
            digits = 1 if "device_peak_mb" in c else 0  # a GPU takes few milliseconds
            cells.append(f"{c['picture_ms']:.{digits}f} / {c['ms']:.{digits}f} ms, {memory:.0f} MB")
        image = case["size"].replace("x", "×")
        if several:
            image += f", {case['triangles']:,} triangles"
        lines.append(f"| {image} | {' | '.join(cells)} |")
    return "\n".join(lines)


def marked(report):
    """The table of docs/raster.md between its marks, and the marks."""
    word = _names(report)[1]
    begin, end = f"<!-- {word} -->\n", f"\n<!-- /{word} -->"
    return f"{begin}{page_table(report)}{end}", begin, end


def _names(report):
    return ON_GPU if report["versions"]["variant"].startswith("cuda") else ON_CPU


def write(report, out):
    """``raster.json`` and ``raster.png`` (of a GPU ``raster_cuda``) in the folder ``out``; where it
    has a page raster.md, as docs/ has, its table too.
    """
    name = os.path.join(out, _names(report)[0])
    with aside(f"{name}.json") as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump(report, file, indent=1)
        file.write("\n")
    page = os.path.join(out, "raster.md")
    if not os.path.exists(page):
        plot(f"{name}.png", report["cases"])
        return
    with open(page, encoding="utf-8") as file:
        text = file.read()
    table, begin, end = marked(report)
    before, rest = text.split(begin)
    after = rest.split(end)[1]
    with aside(page) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(f"{before}{table}{after}")
