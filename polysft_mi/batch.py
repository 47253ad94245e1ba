"""``python -m polysft_mi.batch SCENES -o OUT``: many runs, each in a process of its own, several at
a time, with one table at the end.
"""

import sys
from pathlib import Path

from polyfit.backend import cores

from . import batches, commands
from .errors import InputError, cli

_EXAMPLES = [
    ("data -o out/all --workers 2", "every scene.xml in data and below it"),
    ("a/scene.xml b/scene.xml -o out/two -D order=6", "these scenes, with jets of order 6"),
    (
        "--garments dress shirt.obj --motions walk dance -o out/drapes -- --seconds 2",
        "four drapes; what follows -- is for each onefit.drape",
    ),
]


def parser():
    p = commands.parser(
        "batch",
        "Reconstruct many scenes, or drape many garments, each in a process of its own; called"
        " again, it goes on where it was.",
        _EXAMPLES,
    )
    p.add_argument(
        "scenes",
        metavar="SCENE",
        nargs="*",
        help="a scene, or a folder: every scene.xml in it or below, else its .xml files",
    )
    p.add_argument("-o", "--output", metavar="OUT", required=True, help="folder for the results")
    p.add_argument(
        "--garments", nargs="+", metavar="GARMENT", help="instead of scenes: as onefit.drape's"
    )
    p.add_argument(
        "--motions", nargs="+", metavar="MOTION", help="each garment is draped in each of these"
    )
    commands.add_define_argument(p)
    p.add_argument(
        "--workers",
        type=int,
        metavar="N",
        default=max(1, cores() // 2),
        help="how many at a time (default: one for two processors)",
    )
    p.add_argument("-q", "--quiet", action="store_true", help="no line for each, only the result")
    return p


def main(arguments=None):
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    extra = []
    if "--" in arguments:
        k = arguments.index("--")
        arguments, extra = arguments[:k], arguments[k + 1 :]
    for word in extra:
        if word.startswith(("-o", "--output")):
            raise InputError(
                f"{word} after --: each result has its own folder in that of -o, before --"
            )
    options = parser().parse_args(arguments)
    commands.definitions(options.define)
    drapes = bool(options.garments or options.motions)
    if drapes == bool(options.scenes):
        raise InputError("either scenes, or --garments and --motions are needed")
    if drapes and not (options.garments and options.motions and not options.define):
        raise InputError("--garments and --motions belong together, and take no -D")
    if options.workers < 1:
        raise InputError(f"--workers {options.workers}: at least 1 is needed")
    out = Path(options.output)
    common = [word for text in options.define for word in ("-D", text)] + extra
    if drapes:
        jobs = batches.drapes(options.garments, options.motions, common, out)
    else:
        jobs = batches.runs(options.scenes, common, out)
    table = batches.Table.opened(jobs, out, common)
    return _work(table, options)


def _work(table, options):
    waiting = [job for job in table.jobs if not job.done()]
    say = (lambda text: None) if options.quiet else (lambda text: print(text, file=sys.stderr))
    say(f"{len(table.jobs)} in all, {len(table.jobs) - len(waiting)} of them done before")
    table.write()
    try:
        for job, status, seconds in batches.work(waiting, options.workers) if waiting else ():
            row = table.ended(job, status, seconds)
            say(f"{job.name}: {row.get('error') or 'done'} ({seconds:.0f} s)")
    except KeyboardInterrupt:
        table.look_again()
        print(f"interrupted: {table.count('done')} of {len(table.jobs)} are done; the same command"
              " goes on", file=sys.stderr)  # fmt: skip
        return 130
    failed = table.count("failed")
    print(
        f"done: {table.count('done')} of {len(table.jobs)}"
        + (f", failed: {failed}" if failed else "")
    )
    print(f"table: {table.out / 'batch.md'}, {table.out / 'batch.json'}")
    print(f"next: open {table.out / 'batch.html'}")
    return 1 if failed else 0


if __name__ == "__main__":
    cli(main)
