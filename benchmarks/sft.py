"""Every sequence by every solver, and by a per-vertex baseline: accuracy against time a frame.

    python benchmarks/sft.py [--data FOLDER ...] [--only flag ...] [--methods adam ...] [--frames N]
    [--threads N] [-o out/benchmarks]

Each method is a command, run as a user would and timed as a whole, start-up and everything it
writes included: ``python -m polysft_mi.run`` with the solver ``gauss-newton`` or ``adam``, and
``per_vertex.py``; if it is asked for, ``adam-reweighted``: the paper's solver and losses by other
weights, on Kinect-Paper with the ``--masks`` that ``polysft prepare`` makes. The figures are those
of ``python -m polysft_mi.evaluate``. Each result goes into ``sft.json`` as soon as it is there; the
next call does what is missing (all of it with ``--again``), and draws the tables and the plot from
everything that was run in the same way. Where the truth is a mesh, they also say what the best jets
of the order used make of it: those fitted to the true vertices of each frame.

To see what a change does, run the code before and after it with ``--threads 1 --docs FOLDER`` of
its own, and the second time with ``--against`` the first one's sft.json; ``--only flag bend paper
curtain ball shirt`` takes some eight minutes, and the rest of ``docs/sft.md`` as long again.

Writes ``sft.json``, ``sft.md`` and ``sft.png`` into ``docs``, where the results of whole videos
stand already (``--docs FOLDER`` for another; for runs that are shortened or by other settings, into
OUT).
"""

import argparse
import json
import os
import sys

import sft_results
import sft_runs
from sequences import DATA, ROOT, folder_of
from sft_report import against, report
from sft_results import JET, METHODS, SEQUENCES

from polyfit.backend import add_mode_argument
from polysft_mi.commands import add_define_argument, definitions
from polysft_mi.errors import InputError, cli


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "--data",
        nargs="+",
        metavar="FOLDER",
        default=[DATA],
        help=f"hold the sequences' folders (default, or POLYSFT_DATA: {DATA})",
    )
    p.add_argument(
        "--only",
        nargs="+",
        metavar="SEQUENCE",
        choices=SEQUENCES,
        default=list(SEQUENCES),
        help=f"of {', '.join(SEQUENCES)}",
    )
    usual = [name for name in METHODS if name != "adam-reweighted"]
    known = f"of {', '.join(METHODS)}; none for the report alone (default: {' '.join(usual)})"
    p.add_argument(
        "--methods", nargs="*", metavar="METHOD", choices=METHODS, default=usual, help=known
    )
    p.add_argument("--masks", metavar="FOLDER", help="for adam-reweighted, of a sequence without")
    p.add_argument("--frames", type=int, metavar="N", help="only the first N frames of each")
    p.add_argument("--threads", type=int, metavar="N", help="cores for each command (default: all)")
    p.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="iterations a frame of per-vertex (default: its own)",
    )
    add_define_argument(p)
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
    p.add_argument(
        "--against",
        metavar="FILE",
        help="an sft.json of other code: also print figures and seconds as ratios to its own",
    )
    add_mode_argument(p)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    for name in ("frames", "threads", "iterations"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: at least 1 is needed")
    definitions(options.define)  # a wrong one is told before anything runs
    for folder in options.data:
        if not os.path.isdir(folder):
            raise InputError(f"--data {folder}: no such folder; the sequences' folders are needed")
    setup = sft_runs.setup_of(options)
    docs = options.docs or (os.path.join(ROOT, "docs") if sft_runs.is_whole(setup) else options.out)
    path = os.path.join(docs, "sft.json")
    os.makedirs(docs, exist_ok=True)
    sft_results.read(path)  # a damaged file is told before anything runs
    for sequence in options.only:
        places = (folder_of(data, sequence) for data in options.data)
        folder = next(filter(None, places), None)
        if folder is None:
            print(f"{sequence}: not in {', '.join(options.data)}, left out", file=sys.stderr)
            continue
        for method in options.methods:
            if (
                sft_results.find(sft_results.read(path), sequence, method, setup)
                and not options.again
            ):
                print(f"{sequence}, {method}: done before", file=sys.stderr)
                continue
            print(f"{sequence}, {method} ...", file=sys.stderr)
            shortened = f"-first{setup['frames']}" if setup["frames"] else ""
            result = sft_runs.run(
                sequence,
                method,
                folder,
                os.path.join(options.out, "sft", f"{sequence}-{method}{shortened}"),
                setup,
                options.masks,
            )
            sft_results.add(path, result)
            told = (
                result.get("error")
                or f"{result['seconds_a_frame']:.2f} s a frame, {json.dumps(result['figures'])}"
            )
            print(f"{sequence}, {method}: {told}", file=sys.stderr)
        results = [
            r for r in sft_results.read(path) if r["sequence"] == sequence and r["setup"] == setup
        ]
        for order in sorted(
            {r["orders"][1] for r in results if r.get("orders") and r["method"] != JET}
        ):
            if options.again or not sft_results.find(results, sequence, JET, setup, order):
                result = sft_runs.jet_result(sequence, folder, order, setup)
                if result:
                    sft_results.add(path, result)
    results = [r for r in sft_results.read(path) if r["setup"] == setup]
    print(report(results, docs))
    if options.against:
        chosen = [r for r in results if r["sequence"] in options.only]
        print(f"\n{against(chosen, sft_results.read(options.against))}")
    print(f"\nin {docs}: sft.json, sft.md, sft.png")


if __name__ == "__main__":
    cli(main)
