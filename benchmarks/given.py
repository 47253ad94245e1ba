"""What ``evidence.py`` and ``dressed.py`` share: runs of some sequences, each by several kinds of
what is given, whose results are kept in a JSON file, and a table of them in ``docs/evidence.md``.
"""

import argparse
import contextlib
import json
import os
import re
import resource
import sys

from sequences import ROOT


def parser(doc, program, sequences, kinds):
    """An argument parser with what both commands take; ``doc``: the module's docstring."""
    p = argparse.ArgumentParser(
        prog=f"python benchmarks/{program}.py",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--only", nargs="+", metavar="SEQUENCE", default=list(sequences))
    p.add_argument("--kinds", nargs="*", choices=list(kinds), default=list(kinds))
    p.add_argument("--docs", metavar="FOLDER", default=os.path.join(ROOT, "docs"))
    p.add_argument("--again", action="store_true", help="run what has a result, too")
    return p


def results(args, program, run):
    """The results in ``program``.json, with those of ``args.only`` and ``args.kinds`` that were
    missing; written as soon as each is there. ``run(sequence, kind)`` gives a result, a dict, or
    None where something that it needs is not given.
    """
    path, found = os.path.join(args.docs, f"{program}.json"), []
    if os.path.exists(path):
        with open(path, encoding="utf-8") as file:
            found = json.load(file)
    for sequence in args.only:
        for kind in args.kinds:
            done = [r for r in found if (r["sequence"], r["kind"]) == (sequence, kind)]
            if done and not args.again:
                continue
            print(f"{sequence}, {kind} ...", file=sys.stderr, flush=True)
            result = run(sequence, kind)
            if result is None:
                continue
            result = {"sequence": sequence, "kind": kind, **result}
            found = [r for r in found if r not in done] + [result]
            with open(path, "w", encoding="utf-8") as file:
                json.dump(found, file, indent=1)
                file.write("\n")
    return found


def show(args, program, table):
    """Print a Markdown table, and put it into the page between the comments that name the
    ``program``.
    """
    page = os.path.join(args.docs, "evidence.md")
    if os.path.exists(page):
        with open(page, encoding="utf-8") as file:
            text = file.read()
        place = re.compile(rf"(<!-- {program} -->\n).*?(\n<!-- /{program} -->)", re.S)
        with open(page, "w", encoding="utf-8") as file:
            file.write(place.sub(lambda m: m[1] + table + m[2], text))
    print(table)


@contextlib.contextmanager
def processor_seconds():
    """A list that receives how many seconds of the processor the commands run inside took."""
    spent = []
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    yield spent
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
