"""A long run of simulations, for what must not happen: all templates and some sewing patterns, in
every kind of generated motion, on six bodies.

    python benchmarks/onefit_soak.py -o docs/onefit_soak.json --minutes 60
    python benchmarks/onefit_soak.py -o soak.json --only jumpsuit shirt.obj --kinds walk

In each round every garment is simulated once, in the next kind of motion and on the next body: the
standard one, and five drawn at random. A row is written after each, and rows that are there are
not made again: so a run goes on where the last one ended, until all rows together took so many
minutes. Of a row: *strain* [%]: the median over the edges of how much longer or shorter each is
than at rest, in the worst frame; *inside* [%] of the vertices in the body, in the worst frame, and
*deep* [mm], how deep at most; *crossings* for 1,000 faces: pairs of faces that pass through each
other, a mean over every third frame; *bad*: vertices that are not finite; *ms* a frame, the median.
The table that is printed has a line for each garment: the worst of its rows, the mean of crossings.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from onefit_accuracy import SEED

import onefit
from onefit.body import ClosestSurface
from onefit.garment import LOOSE, TEMPLATES
from onefit.motion import KINDS
from onefit.objective import crossings
from polyfit.errors import cli
from polyfit.files import aside
from polyfit.mesh import edges_of

BODIES, FRAME_STEP, REACH = 6, 3, 0.08  # one frame in so many is looked at for crossings; [m]
PATTERNS = sorted(Path("tests/onefit/garment/patterns").glob("*_specification.json"))
LIMITS = dict(bad=0, strain=3.0, inside=0.1, crossings=2.0)
HEAD = "| garment | runs | frames | not finite | strain % | inside % | deep mm | crossings | ms |"


def figures(drape, lengths, edges):
    """The row's numbers of a simulated drape whose ``edges`` (E, 2) have ``lengths`` (E,) [m]."""
    x, faces = drape.vertices, drape.faces.numpy()
    strain, inside, deep, through = [], [], [], []
    surface = ClosestSurface(drape.body[0], drape.body_faces)
    for k, (frame, body) in enumerate(zip(x, drape.body)):
        now = (frame[edges[:, 0]] - frame[edges[:, 1]]).norm(dim=1)
        strain.append(float((now / lengths - 1).abs().median()))
        surface.follow(body)
        distance = surface(frame, REACH).distance
        inside.append(float((distance < 0).float().mean()))
        deep.append(float(-distance.min()))
        if k % FRAME_STEP == 0:
            through.append(crossings(frame.numpy(), faces) / len(faces))
    return dict(
        frames=len(x),
        bad=int((~torch.isfinite(x)).any(-1).sum()),
        strain=round(100 * max(strain), 2),
        inside=round(100 * max(inside), 3),
        deep=round(1e3 * max(0.0, *deep), 1),
        crossings=round(1e3 * float(np.mean(through)), 2),
    )


def row(draper, name, kind, body, seed, seconds):
    garment, ends = draper.garment(name), []
    motion = onefit.Motion.generate(kind, seconds=seconds, seed=seed)
    draper.patched(garment)  # cut once
    start = time.perf_counter()
    drape = draper.simulate(garment, motion, body, advance=lambda: ends.append(time.perf_counter()))
    minutes = (time.perf_counter() - start) / 60
    edges = torch.as_tensor(edges_of(drape.faces.numpy())[0])
    found = figures(drape, garment.rest_lengths(edges, drape.rest), edges)
    ms = round(1e3 * float(np.median(np.diff(ends))), 1)
    return dict(**found, ms=ms, minutes=round(minutes, 3))


def line(name, rows):
    """A garment's line of the table."""
    most = lambda key: max(row[key] for row in rows)
    frames = sum(row["frames"] for row in rows)
    mean = sum(row["crossings"] * row["frames"] for row in rows) / frames
    cells = [name, len(rows), frames, sum(row["bad"] for row in rows), most("strain")]
    cells += [most("inside"), most("deep"), f"{mean:.2f}"]
    cells.append(f"{np.median([row['ms'] for row in rows]):.0f}")
    return "| " + " | ".join(map(str, cells)) + " |"


def over(row):
    """Whether a row has what must not happen."""
    return any(row[name] > limit for name, limit in LIMITS.items())


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", metavar="FILE.json", required=True, type=Path)
    parser.add_argument("--minutes", type=float, default=60, help="of simulations, in all")
    parser.add_argument("--seconds", type=float, default=1.0, help="of a motion (default: 1)")
    parser.add_argument("--only", nargs="+", metavar="GARMENT", help="default: all, and patterns")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    args = parser.parse_args(argv)
    names = args.only or [*TEMPLATES, *LOOSE, *map(str, PATTERNS)]
    rows = json.loads(args.output.read_text(encoding="utf-8")) if args.output.exists() else []
    done = {tuple(row[k] for k in ("garment", "kind", "body", "seed")) for row in rows}
    draper, rng = onefit.load(), np.random.default_rng(SEED)
    bodies = [None] + [draper.model.random_shape(rng) for _ in range(BODIES - 1)]
    spent, turn = sum(row["minutes"] for row in rows), 0
    while spent < args.minutes:
        lap, k = divmod(turn, len(names))
        turn += 1
        if lap >= BODIES * len(args.kinds):
            break
        kind, body = args.kinds[(lap + k) % len(args.kinds)], (lap + k) % BODIES
        name = names[k]
        what = dict(garment=Path(name).stem.removesuffix("_specification"), kind=kind, body=body)
        what["seed"] = SEED + lap
        if tuple(what.values()) in done:
            continue
        rows.append(what | row(draper, name, kind, bodies[body], what["seed"], args.seconds))
        spent += rows[-1]["minutes"]
        print(json.dumps(rows[-1]), "<- over" if over(rows[-1]) else "", flush=True)
        with aside(args.output) as temporary:
            text = ",\n".join(" " + json.dumps(one) for one in rows)
            Path(temporary).write_text(f"[\n{text}\n]\n", encoding="utf-8")
    print(HEAD, "|---" * HEAD.count(" |") + "|", sep="\n")
    for name in dict.fromkeys(row["garment"] for row in rows):
        print(line(name, [row for row in rows if row["garment"] == name]))
    print(
        f"{spent:.1f} minutes of simulations; over a limit: {sum(map(over, rows))} of {len(rows)}"
    )


if __name__ == "__main__":
    cli(main)
