"""Whether a surface is wrong because the objective prefers it, or because no step leads out of it.

    python benchmarks/from_truth.py [--data FOLDER ...] [--only tube ...] [--every 4] [--docs docs]

While a sequence is tracked, every so many frames are solved once more from the true surface, under
the same objective: what the frames before say of light and noise, and the surface that the frame is
tied to, are those of the track. The track goes on from its own surface. Two costs are compared:

- from the true surface less than on the track: the track is in a local minimum;
- more: the objective prefers the wrong surface, and no start would help.

The cost is that of the last stage, in thousandths of the objective's unit. *left* is how far the
vertices are from the true ones [mm], in view where that is known. Writes ``from_truth.json`` and
``from_truth.md`` into DOCS.
"""

import argparse
import json
import os
import tempfile

import numpy as np
from sequences import DATA, ROOT, folder_of, scene_of

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.errors import InputError, cli
from polysft_mi.results.truth import Truth

SEQUENCES = ("flag", "bend", "paper", "curtain", "corner", "tube", "shirt", "ball")
PARTS = {  # columns of the table: the terms that they sum up
    "images": ("rgb", "silhouette", "shading", "chroma"),
    "lengths": ("inextensibility",),
}


def probed(experiment, truth, every):
    """Rows of every so many frames: the frame, and of ``track`` and ``truth`` the ``terms`` (name
    to energy) and what is ``left`` [mm] of the way to the true surface.

    ``experiment``: of a scene, :class:`polysft_mi.scene.experiment.Experiment`; ``truth``: of its
    template's vertices (N, 3) [m, camera frame]. Raises InputError where it is of others.
    """
    from polysft_mi import tracker
    from polysft_mi.objective.problem import Problem

    problem = Problem(experiment, experiment.sequence())
    camera, rows, count = problem.camera, [], len(experiment.template.vertices)
    if truth.kind != "mesh" or len(truth.at(min(truth.places))) != count:
        raise InputError(f"{truth.path}: the template's {count} vertices in each frame are needed")

    class Probe(tracker.FrameTracker):
        def _newest(self, start, frame, history, known):
            found, context = super()._newest(start, frame, history, known)
            if frame % every == 0 and frame > 0:
                rows.append(self._compared(frame, found, context))
            return found, context

        def _compared(self, frame, found, context):
            atlas, number = self.problem.atlas, self.problem.sequence.indices[frame]
            true = truth.at(number)
            world = true @ camera.axes + camera.origin
            there = atlas.reaching(world, found.state, iterations=20)
            other = self._stages.descend(
                atlas.with_relief_in_jets(there), context, self.objective.usual[1:]
            )

            def row(found):
                vertices = camera.to_camera(atlas.surface(found.state).vertices)
                apart = np.linalg.norm(vertices - true, axis=1)
                apart = apart[truth.seen[number]] if truth.seen else apart
                left = 1e3 * float(np.sqrt(np.mean(apart**2)))
                return {"left": left, "terms": {k: float(x) for k, x in found.model.terms.items()}}

            return {"frame": number, "track": row(found), "truth": row(other)}

    problem.check_start()
    with tempfile.TemporaryDirectory() as out:
        tracker.track(Probe(problem), len(problem.sequence.indices), out)
    return rows


def page(results):
    """The text of ``from_truth.md``; ``results``: rows by sequence."""
    total = lambda row, names=None: (
        1e3 * sum(x for name, x in row["terms"].items() if names is None or name in names)
    )
    known = [name for names in PARTS.values() for name in names]
    lines = [
        "| sequence | frame | left, track | left, from the truth | cost, track | from the truth |"
        f" {' | '.join(f'{part}, of both' for part in (*PARTS, 'the rest'))} |",
        "|---|" + "---:|" * (5 + len(PARTS) + 1),
    ]
    for sequence, rows in results.items():
        for row in rows:
            track, truth = row["track"], row["truth"]
            parts = [[total(x, names) for x in (track, truth)] for names in PARTS.values()]
            rest = [total(x, set(x["terms"]) - set(known)) for x in (track, truth)]
            lines.append(
                f"| {sequence} | {row['frame']} | {track['left']:.1f} | {truth['left']:.1f} |"
                f" {total(track):.1f} | {total(truth):.1f} |"
                + "".join(f" {a:.1f}, {b:.1f} |" for a, b in (*parts, rest))
            )
    text = """\
Made by `python benchmarks/from_truth.py`, whose help says what is compared: frames as they are
tracked, and solved from the true surface under the same objective. *left*: millimetres from the
true vertices, in view where that is known. Costs are in thousandths. Where the cost from the truth
is less, the track is in a local minimum; where it is more, the objective prefers what was found."""
    return "# Local minima, or the objective\n\n" + text + "\n\n" + "\n".join(lines) + "\n"


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--data", nargs="+", metavar="FOLDER", default=[DATA], help="of sequences")
    p.add_argument("--only", nargs="+", metavar="SEQUENCE", default=SEQUENCES)
    p.add_argument("--every", type=int, default=6, metavar="N", help="frames; default: %(default)s")
    p.add_argument("--docs", metavar="FOLDER", default=os.path.join(ROOT, "docs"))
    add_mode_argument(p)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    folders = {
        name: next(filter(None, (folder_of(data, name) for data in options.data)), None)
        for name in options.only
    }
    if missing := [name for name, folder in folders.items() if folder is None]:
        raise InputError(f"--data {' '.join(options.data)}: {', '.join(missing)} is not there")
    set_variant(options.mode)
    from polysft_mi.scene import experiment

    path = os.path.join(options.docs, "from_truth.json")
    results = {}
    if os.path.exists(path):
        with open(path, encoding="utf-8") as file:
            results = json.load(file)
    for name, folder in folders.items():
        loaded, truth = experiment.load(scene_of(name), {"data": folder}), Truth.open(folder)
        results[name] = probed(loaded, truth, options.every)
        with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=1)
            file.write("\n")
        with (
            aside(os.path.join(options.docs, "from_truth.md")) as temporary,
            open(temporary, "w", encoding="utf-8") as file,
        ):
            file.write(page(results))


if __name__ == "__main__":
    cli(main)
