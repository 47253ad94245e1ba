"""Whether more patches, or jets of a higher order, hold and track a surface better.

    python benchmarks/atlas_cuts.py [--data FOLDER ...] [--only tube ...] [--every 4] [--runs 2]
    [-o out/benchmarks]

Each sequence with true vertices is held, and tracked, by the atlas as it is cut; with each patch
halved across its largest extent; and with jets of two orders more.

*left* [mm] is the distance of the true vertices from the jets alone, without relief: the least that
is found (``best_jets.py``), with vertices that may slide, as the mean of every fourth frame. With
the relief each vertex may go anywhere, and nothing is left of any surface.

*error* is what tracking gives: ``e3d_proc``, and where it is known what is in view, ``e3d_proc``
over that. The tracker runs several times, with ``k_mi`` changed by some hundred-thousandths: the
smallest and the largest error tell what chance does. A sheet keeps the rules of a sheet when it is
halved. Seconds are those of one thread's CPU a frame.

Each result goes into ``atlas_cuts.json`` in OUT as soon as it is there; the next call does what is
missing and prints the table.
"""

import argparse
import json
import os
import sys

import numpy as np
from ablation import Switch, run
from best_jets import best_jets
from sequences import DATA, folder_of, scene_of

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polyfit.mesh import edges_of
from polyfit.patches import Cover, partition
from polysft_mi.errors import InputError, cli
from polysft_mi.results import metrics
from polysft_mi.results.truth import Truth
from polysft_mi.scene.settings import Settings
from polysft_mi.surface import meshio
from polysft_mi.surface.template import Template

SEQUENCES = (
    *("ball", "shirt", "tube", "roll", "pillow", "skirt"),
    *("flag", "bend", "paper", "curtain", "poster"),
)
CUTS = ("as it is", "patches halved", "order + 2")
CHANCES = (0.0, 1e-5, -1e-5, 2e-5)  # shares by which k_mi changes from run to run


def halved(template):
    """The :class:`polyfit.patches.Cover` of a template with each patch halved across its largest
    extent, which its chart has for u.
    """
    label, u = template.patch[:, 0], template.chart[:, 0, 0]
    middle = np.array([np.median(u[label == k]) for k in range(len(template))])
    label = 2 * label + (u > middle[label])
    faces = template.faces
    patch, weight = partition(template.vertices, faces, edges_of(faces)[0], label)
    normal = np.stack([template.axes[label == k, :, 2].mean(0) for k in range(2 * len(template))])
    return Cover(patch, weight, normal / np.linalg.norm(normal, axis=1, keepdims=True))


def cut(folder, how):
    """The template of a sequence's folder, cut in one of the ways :data:`CUTS`."""
    obj = os.path.join(folder, "template.obj")
    mesh, order = meshio.read_textured_template(obj), Settings().jet_order
    template = Template.fit(*mesh, order, exact=False, where=obj)
    if how == "as it is":
        return template
    order, cover = template.order + 2, None
    if how == "patches halved":
        order, cover = template.order, halved(template)
    return Template.fit(*mesh, order, exact=False, cover=cover, where=obj)


def held(template, folder, every):
    """What the jets of a template leave of each ``every``-th true surface [mm], as a mean."""
    truth = Truth.open(folder)
    meshes = [truth.at(k) for k in sorted(truth.places)[::every]]
    found = best_jets(template, np.stack(meshes))
    return 1e3 * float(np.mean([metrics.rmse(V, G) for V, G in zip(found, meshes, strict=True)]))


def tracked(template, name, folder, chance, sheet):
    """(error, CPU seconds a frame) of tracking with a template, ``k_mi`` changed by a share."""
    one = Settings().for_patches(1)
    weights = {name: getattr(one, name) for name in ("k_mi", "k_silhouette", "k_relief")}
    switch = Switch("", {"unseen": 1.0} if sheet else {}, weights if sheet else {}, chance)
    result = run(switch, scene_of(name), folder, template=template)
    figures = result["figures"]
    return figures.get("e3d_proc_seen", figures["e3d_proc"]), result["cpu"]


def measured(name, folder, options, known, keep):
    """Fill ``known``, a dict (sequence/cut) of results, with what is missing of a sequence."""
    sheet = len(cut(folder, CUTS[0])) == 1
    for how in CUTS:
        result = known.setdefault(f"{name}/{how}", {"errors": [], "seconds": []})
        template = cut(folder, how)
        result |= {"patches": len(template), "order": template.order}
        if "left" not in result:
            result["left"] = held(template, folder, options.every)
            keep(known)
        for chance in CHANCES[len(result["errors"]) : options.runs]:
            error, seconds = tracked(template, name, folder, chance, sheet)
            result["errors"].append(error)
            result["seconds"].append(seconds)
            keep(known)
        print(f"{name}, {how}: {json.dumps(result)}", file=sys.stderr, flush=True)


def table(known):
    """All results as Markdown: a row a sequence, with what is left, errors and seconds by cuts."""
    groups = "left [mm]", "error", "seconds"
    head = ["sequence", "patches, order"]
    head += [f"{group}, {CUTS[0]}" if cut == CUTS[0] else cut for group in groups for cut in CUTS]
    rows = [head, ["---"] * 2 + ["---:"] * (len(head) - 2)]
    for name in dict.fromkeys(key.partition("/")[0] for key in known):
        found = [known.get(f"{name}/{how}") for how in CUTS]
        if not all(found):
            continue
        row = [name, f"{found[0]['patches']}, {found[0]['order']}"]
        row += [f"{r['left']:.2f}" for r in found]
        spans = [
            dict.fromkeys(f"{f(r['errors'], default=np.nan):.3g}" for f in (min, max))
            for r in found
        ]
        row += [" to ".join(span) for span in spans]
        row += [f"{np.median(r['seconds']):.2f}" if r["seconds"] else "nan" for r in found]
        rows.append(row)
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main(argv=None):
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--data", nargs="+", metavar="FOLDER", default=[DATA], help=f"default: {DATA}")
    p.add_argument(
        "--only", nargs="+", metavar="SEQUENCE", choices=SEQUENCES, default=list(SEQUENCES)
    )
    p.add_argument("--every", type=int, default=4, help="frames for which jets are fitted")
    p.add_argument("--runs", type=int, default=2, help=f"of tracking, 0 to {len(CHANCES)}")
    p.add_argument("--threads", type=int, default=1, metavar="N", help="default: 1")
    p.add_argument("-o", "--out", metavar="OUT", default="out/benchmarks")
    add_mode_argument(p)
    options = p.parse_args(argv)
    if options.every < 1 or not 0 <= options.runs <= len(CHANCES) or options.threads < 1:
        raise InputError(
            f"--every {options.every} --runs {options.runs} --threads {options.threads}: positive"
            f" numbers are needed, and {len(CHANCES)} runs at most"
        )
    set_variant(options.mode)
    import drjit as dr

    dr.set_thread_count(options.threads)
    path = os.path.join(options.out, "atlas_cuts.json")
    os.makedirs(options.out, exist_ok=True)
    known = {}
    if os.path.exists(path):
        with open(path, encoding="utf-8") as file:
            known = json.load(file)

    def keep(results):
        with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=1)

    for name in options.only:
        folder = next(filter(None, (folder_of(data, name) for data in options.data)), None)
        if folder is None:
            print(f"{name}: not in {', '.join(options.data)}, left out", file=sys.stderr)
            continue
        measured(name, folder, options, known, keep)
    print(table(known))


if __name__ == "__main__":
    cli(main)
