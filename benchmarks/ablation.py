"""What each rule of the tracker is worth: it is switched off alone, on every sequence.

    python benchmarks/ablation.py --simulated FOLDER [--data FOLDER] [--only "flag 91" ...]
    [--rules relief ...] [--until-decided] [--threads N] [--docs docs]

A rule is a field of ``polysft_mi.scene.rules.Rules``, or a setting, that decides when or whether
something happens, or how much it counts. Each is switched off by the values in ``SWITCHES``, or,
where a number has no off, moved far; everything else stays as it is. Measured are the error of the
surface and the seconds of CPU a frame, tracking alone.

The simulated sequences were made after the rules had their values. FOLDER holds a folder a seed:

    python benchmarks/simulate.py FOLDER/91 --seed 91 --only flag
    python benchmarks/simulate.py FOLDER/96 --seed 96 --plain --only flag

and so on: SIMULATED below says which kinds of surface of which seed are used. Those of seeds 96 to
124 are plain, with textures of few details.

Where folds come and go, the smallest change grows from frame to frame. So the tracker runs several
times with a setting changed by some hundred-thousandths; a rule's error is compared with the median
of these runs, and pays only where it is larger than all of them. A rule stays when the error grows
so by 5 % without it on at least two sequences. Rules stay, too, without which a real video is lost.

Each result goes into ``ablation.json`` as soon as it is there, and the next call does what is
missing. All of it takes many hours. With ``--until-decided`` a rule is measured until two sequences
need it, and only a rule that may go on all. Writes ``ablation.json`` and ``ablation.md`` into DOCS.
"""

import argparse
import dataclasses
import json
import math
import os
import sys
import tempfile
import time
from dataclasses import dataclass, field

import numpy as np
from ablation_results import BASELINE, CHANCES, FIGURES, ROUNDED, decided, page, read, write
from sequences import DATA, ROOT, folder_of, scene_of

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.errors import InputError, cli
from polysft_mi.scene.rules import Rules

SEQUENCES = ("kinect_paper", "phi_sft_R1", "tube", "shirt", "ball")
SIMULATED = {  # name in the table: (kind of surface, seed)
    f"{kind} {seed}": (kind, seed)
    for kind, seed in (
        *(("flag", 91), ("bend", 92), ("paper", 93), ("curtain", 94), ("pushed", 95)),
        *(("flag", 96), ("bend", 97), ("pushed", 99), ("pushed", 103)),  # with --plain
        *(("flag", 121), ("pushed", 124)),  # likewise
        *(("skirt", 1), ("pillow", 1), ("roll", 1)),
    )
}
UNMASKED = {f"{name}, no masks": SIMULATED[name] for name in ("flag 91", "bend 92")}
ORDER = (*SIMULATED, *UNMASKED, *SEQUENCES)  # of the table's columns


@dataclass(frozen=True)
class Switch:
    """How a rule is switched off: fields of the rules and settings that take other values;
    ``chance``: a share by which k_mi changes; ``rounded``: whether the rule is of surfaces of
    several patches alone.
    """

    rule: str
    fields: dict = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    chance: float = 0.0
    rounded: bool = False


SWITCHES = (
    Switch(BASELINE),
    # changes that mean nothing: how far results move by themselves
    *(Switch(rule, chance=share) for rule, share in CHANCES.items()),
    Switch("three stages", {"blurs": (1.0, 1.0, 1.0)}),
    Switch("a wider blur where it moved far", {"far_blur": 3.0}),
    Switch("soft edges first", {"stiffness": (1.0, 1.0, 1.0)}),
    Switch("more steps at first", {"iterations": (3, 3, 3)}),
    Switch("window of local brightness", {"window": 16.0}),
    Switch("small step ends a stage", {"gain": 1e-4}),
    Switch("damping", {"damping": (1e-8, 1e-8)}),
    Switch("robust scale", {"scale_least": 0.3}),  # what it is in the first frame
    Switch("fine passes", {"fine_passes": False}),
    Switch("motion starts", {"motion_starts": False}),
    Switch("a frame may be explained", {"margin": 0.0}),
    Switch("other starts", {"usual_frames": 2}),
    Switch("mirror images", {"mirror_share": 0.0}),
    Switch("rims", {"rim": 0.0}),
    Switch("relief", {"relief_vertices": 0}),
    Switch("relief's bending", {"relief_bend": 0.0}),
    Switch("relief's caution", {"noise_misfit": math.inf}),
    Switch("caution's steepness", {"noise_power": 2.0}),
    Switch("second pass", {"second_pass": 1.0}),
    Switch("edges give", {"give": math.inf}),
    Switch("fine texture", {"texels": 0.75}),
    Switch("texture fit", {"texture_gain": 0.0}),
    Switch("appearance", {"appearance": False}),
    Switch("borders", {"border": 0.0}),
    Switch("shading", settings={"k_shading": 0}),
    Switch("chromaticity", settings={"k_chroma": 0}),
    Switch("chromaticity's outliers", {"chroma_scale": 1.0}),
    Switch("triangles' blur", {"shading_blur": 0.05}),  # OpenCV has no blur of 0
    Switch("exposure", {"exposure": False}),
    Switch("light's prior", {"light_ridge": 0.0}),
    Switch("shading's robust norm", {"light_scale": 1.0}),
    Switch("few refits", {"light_refits": 60}),
    Switch("light's memory", {"light_kept": 1.0}),
    Switch("joints", settings={"k_coupling": 0.0}, rounded=True),
    Switch("unseen parts are held", {"unseen": 1.0}, rounded=True),
    Switch("softer lengths", settings={"k_mi": 100.0}, rounded=True),
    Switch("firmer outline", settings={"k_silhouette": 0.1}, rounded=True),
    Switch("softer relief", settings={"k_relief": 1e-3}, rounded=True),
)


# ---- running -------------------------------------------------------------------------------------


def sequences(data, simulated):
    """Name in the table to (scene file, folder of the data and the truth, settings); those that are
    there.
    """
    found = {name: (name, folder_of(data, name), {}) for name in SEQUENCES}
    for name, (kind, seed) in (SIMULATED | UNMASKED).items() if simulated else ():
        settings = {"masks": ""} if name in UNMASKED else {}
        found[name] = kind, os.path.join(simulated, str(seed), kind), settings
    return {
        name: (scene_of(kind), folder, settings)
        for name, (kind, folder, settings) in found.items()
        if folder and os.path.isdir(folder)
    }


def run(switch, scene_file, data, settings=None, template=None):
    """One sequence with one rule off: its figures, ``lost`` frames and ``cpu`` seconds a frame;
    under ``settings``, and with a :class:`Template`, where one is given, instead of the scene's.
    """
    from polysft_mi import tracker
    from polysft_mi.objective.problem import Problem
    from polysft_mi.results.evaluation import score
    from polysft_mi.results.truth import find_truth
    from polysft_mi.scene import experiment as scene
    from polysft_mi.surface.patch import Unknowns

    experiment = scene.load(
        scene_file, {"data": data, **(settings or {}), **switch.settings}, template
    )
    sequence = experiment.sequence()
    rules = dataclasses.replace(Rules(), **switch.fields)
    problem = Problem(experiment, sequence, rules)
    problem.check_start()
    s = problem.settings
    problem.settings = dataclasses.replace(s, k_mi=s.k_mi * (1 + switch.chance))
    began = time.process_time()
    with tempfile.TemporaryDirectory() as out:
        done = tracker.track(tracker.FrameTracker(problem), len(sequence.indices), out)
    seconds = time.process_time() - began
    states = [problem.surface(Unknowns.from_numpy(state)) for state in done.states]
    surface = {
        "vertices": np.stack([problem.camera.to_camera(v.astype(float)) for v in states]),
        "faces": np.array(problem.template.faces),
        "frames": np.array(sequence.indices),
    }
    figures = score(surface, find_truth(data))
    names = (*FIGURES, "en_deg", "e3d_proc_seen", "en_deg_seen")
    kept = {name: float(figures[name]) for name in names if name in figures}
    return {"figures": kept, "lost": len(done.lost), "cpu": seconds / len(states)}


# ---- the command ---------------------------------------------------------------------------------


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--data", metavar="FOLDER", default=DATA, help="default: %(default)s")
    p.add_argument("--simulated", metavar="FOLDER", help="holds SEED/flag and so on")
    p.add_argument("--only", nargs="+", metavar="SEQUENCE", help="names as in the table")
    known = [s.rule for s in SWITCHES]
    p.add_argument("--rules", nargs="*", metavar="RULE", choices=known, help=", ".join(known))
    p.add_argument(
        "--threads", type=int, default=1, metavar="N", help="default: 1, times are of it"
    )
    p.add_argument("--docs", metavar="FOLDER", default=os.path.join(ROOT, "docs"))
    p.add_argument(
        "--until-decided",
        action="store_true",
        help="no more of a rule that pays on two sequences already",
    )
    add_mode_argument(p)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    os.makedirs(options.docs, exist_ok=True)
    path = os.path.join(options.docs, "ablation.json")
    found = sequences(options.data, options.simulated)
    if not found:
        raise InputError(f"none of the sequences is in --data {options.data}, or in --simulated")
    if unknown := set(options.only or ()) - set(found):
        raise InputError(f"--only {', '.join(sorted(unknown))}: known are {', '.join(found)}")
    set_variant(options.mode)
    import drjit as dr

    dr.set_thread_count(options.threads)
    for switch in SWITCHES:
        if options.rules is not None and switch.rule not in options.rules:
            continue
        for name in options.only or [n for n in ORDER if n in found]:
            known = read(path)
            if options.until_decided and decided(known, switch.rule):
                break
            if (switch.rule, name) in known or (switch.rounded and name not in ROUNDED):
                continue
            result = {"rule": switch.rule, "sequence": name, **run(switch, *found[name])}
            write(path, read(path) | {(switch.rule, name): result})
            print(f"{switch.rule}, {name}: {json.dumps(result)}", file=sys.stderr, flush=True)
    text = page(read(path), SWITCHES, ORDER)
    with (
        aside(os.path.join(options.docs, "ablation.md")) as temporary,
        open(temporary, "w", encoding="utf-8") as file,
    ):
        file.write(text)


if __name__ == "__main__":
    cli(main)
