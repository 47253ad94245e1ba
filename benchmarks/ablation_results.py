"""The results of ``benchmarks/ablation.py``: read, written, judged, and as a page."""

import json
import os
import statistics
import textwrap

from polyfit.files import aside
from polysft_mi.errors import InputError

BASELINE = "all rules"
CHANCES = {f"nothing (k_mi changed by {share:+g})": share for share in (1e-5, -1e-5, 2e-5, -2e-5)}
PAYS = 0.05  # share by which the error must grow without a rule
FIGURES = {"e3d_proc": "e3d aligned", "depth_rmse_mm": "depth RMSE [mm]", "chamfer_1e4": "Chamfer"}
ROUNDED = ("tube", "shirt", "ball", "skirt 1", "pillow 1", "roll 1")  # surfaces of several patches
BEFORE = ", before"  # ends the names of sequences that were measured before there was chromaticity
NEEDED = {  # rules that stay where they pay on one sequence alone, and why
    "other starts": "without it Kinect-Paper loses its sheet in fast motion",
    "texture fit": "without it the texture of φ-SfT R1 lies pixels off in every frame",
    "joints": "it is what holds patches together",
    "small step ends a stage": "it is for time: a stage that has converged ends",
    "a wider blur where it moved far": "it is for fast motion, which Kinect-Paper has",
    "caution's steepness": "it is for a real camera's noise, as on Kinect-Paper",
    "mirror images": "they are for plain textures (tracker.md has those that gain)",
    "rims": "they are for plain textures (tracker.md has those that gain)",
    "exposure": "it is for cameras whose exposure changes; that of the simulated ones does not",
    "few refits": "more take longer, and flag loses its corner more often",
}
OF_CHANCE = (
    "Where folds come and go, the smallest change grows from frame to frame. So the tracker also"
    " ran with a setting changed by some hundred-thousandths. Errors are compared with the median"
    " of these runs. The first row is how far the runs lie from it: a rule pays only where its"
    " error is above all of them."
)


def read(path):
    """Results (rule, sequence) -> result; none where there is no such file."""
    if not os.path.exists(path):
        return {}
    try:
        with open(path, encoding="utf-8") as file:
            return {(r["rule"], r["sequence"]): r for r in json.load(file)["results"]}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a file of results ({error}); remove it") from None


def write(path, results):
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump({"results": list(results.values())}, file, indent=1)
        file.write("\n")


def error_of(result):
    """(name, value) of a result's figure; a lost sheet may leave it infinite."""
    return next((n, result["figures"][n]) for n in FIGURES if n in result["figures"])


def errors_with_all_rules(results, sequence):
    """The errors of the runs with all rules, ascending: the first, and those of chance."""
    runs = (results.get((rule, sequence)) for rule in (BASELINE, *CHANCES))
    return sorted(error_of(result)[1] for result in runs if result)


def change(results, rule, sequence):
    """(share, pays): by what share the error grows without a rule, and whether that is more than
    :data:`PAYS` and than chance; None where it was not measured.
    """
    known, without = errors_with_all_rules(results, sequence), results.get((rule, sequence))
    if not (known and without):
        return None
    error = error_of(without)[1]
    share = error / statistics.median(known) - 1
    return share, share >= PAYS and error > known[-1]


def outcome(results, rule, names):
    """(on how many of the sequences a rule pays, on how many it was measured)."""
    known = [c for name in names if (c := change(results, rule, name)) is not None]
    return sum(pays for _, pays in known), len(known)


def decided(results, rule):
    """Whether a rule stays, whatever else is measured."""
    return outcome(results, rule, [name for kind, name in results if kind == rule])[0] > 1


def verdict(results, rule, names):
    """What the table says of a rule, in a few words."""
    pays, measured = outcome(results, rule, names)
    said = f"pays on {pays} of {measured}"
    if rule in NEEDED and pays < 2:
        return f"{said}; stays: {NEEDED[rule]}"
    if measured < len(names) and pays < 2:
        return said
    return f"{said}; {'stays' if pays > 1 else 'goes'}"


def slower(results, rule, names):
    """Median over the sequences of the time without a rule over the time with it; None: unknown."""
    ratios = [
        results[rule, n]["cpu"] / results[BASELINE, n]["cpu"]
        for n in names
        if (rule, n) in results and (BASELINE, n) in results
    ]
    return statistics.median(ratios) if ratios else None


def table(results, rules, names):
    """A row a rule: by how many percent the error grows without it, on each sequence; the first is
    what chance does.
    """

    def number(change):
        if change is None:
            return "–"
        return f"{100 * change[0]:+.0f}" if change[0] < 99 else "lost"

    def spread(errors):
        if len(errors) < 2:
            return "–"
        median = statistics.median(errors)
        return f"{100 * (errors[0] / median - 1):+.0f} to {100 * (errors[-1] / median - 1):+.0f}"

    rows = [
        ["rule off", *names, "time", "verdict"],
        ["---", *["---:"] * (len(names) + 1), "---"],
    ]
    known = [errors_with_all_rules(results, name) for name in names]
    if any(len(errors) > 1 for errors in known):
        rows.append(["none", *(spread(errors) for errors in known), "–", "what chance does"])
    for rule in rules:
        ratio = slower(results, rule, names)
        rows.append(
            [rule]
            + [number(change(results, rule, name)) for name in names]
            + ["–" if ratio is None else f"{100 * (ratio - 1):+.0f}"]
            + [verdict(results, rule, names)]
        )
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def wrap(line):
    """A line of the page, wrapped where it is no row of a table."""
    return line if line.startswith("|") else textwrap.fill(line, 100, break_long_words=False)


def baseline_table(results, names):
    """The figures with all rules on: the median error of the runs."""
    rows = [["sequence", "figure", "error", "normals", "CPU seconds a frame"], ["---"] * 5]
    for name in names:
        if result := results.get((BASELINE, name)):
            figure, value = (
                error_of(result)[0],
                statistics.median(errors_with_all_rules(results, name)),
            )
            normals = result["figures"].get("en_deg")
            rows.append(
                [name, FIGURES[figure], f"{value:.4g}"]
                + ["–" if normals is None else f"{normals:.1f}°", f"{result['cpu']:.2f}"]
            )
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def page(results, all_switches, order):
    """The text of ``ablation.md``: the rules of ``all_switches``, sequences in ``order``."""
    done = [n for n in order if (BASELINE, n) in results]
    sheets, rounded = ([n for n in done if (n in ROUNDED) == part] for part in (False, True))
    before = [n for rule, n in results if rule == BASELINE and n.endswith(BEFORE)]
    switches = [s for s in all_switches if s.rule not in (BASELINE, *CHANCES)]
    measured = lambda rule, names: any((rule, n) in results for n in names)
    rules = [s.rule for s in switches if not s.rounded and measured(s.rule, sheets)]
    unknown = [s.rule for s in switches if not s.rounded and not measured(s.rule, sheets)]
    now = {s.rule for s in all_switches}
    gone = list(dict.fromkeys(rule for rule, _ in results if rule not in now))
    parts = [OF_CHANCE] if any(measured(rule, sheets) for rule in CHANCES) else []
    parts += [table(results, rules + gone, sheets)] if rules + gone else []
    if gone:
        parts.append(f"Gone since, for they did not pay: {', '.join(gone)}.")
    if unknown:
        parts.append(f"Not measured: {', '.join(unknown)}.")
    of_rules = "\n\n".join("\n".join(map(wrap, part.splitlines())) for part in parts)
    text = f"""# What each rule of the tracker is worth

Made by `python benchmarks/ablation.py`. Each row is one rule switched off alone. A number is the
change of the error in percent: +30 means that the error is 30 % larger without the rule. *Time* is
the median change of the CPU time, in percent. A rule stays when the error grows by
{100 * PAYS:.0f} % without it, and more than by chance, on at least two sequences. "–": not
measured, mostly since two sequences had decided by then.

{of_rules}

With all rules on, also those that are gone since (CPU time on one thread, beside other work:
compare it within this page only):

{baseline_table(results, sheets)}
"""
    undecided = [rule for rule in unknown + rules if outcome(results, rule, sheets)[0] < 2]
    rules = [rule for rule in undecided if measured(rule, before)]
    if rules:
        text += f"""
## Before

Rules that are not decided above, on sequences that were in view when rules got their values, two
real videos among them; before there was chromaticity.

{table(results, rules, before)}
"""
    rules = [s.rule for s in switches if measured(s.rule, rounded)]
    gone = [rule for rule in gone if measured(rule, rounded)]
    if rules:
        text += f"""
## Surfaces of several patches

The error is that of all vertices, of those that no pixel sees too. The sequences with a number were
made by `python benchmarks/simulate.py` with that seed, after the rules had their values.

{table(results, rules + gone, rounded)}

{baseline_table(results, rounded)}
"""
    return text
