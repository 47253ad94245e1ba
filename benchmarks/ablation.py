"""What each rule of the tracker is worth: it is switched off alone, on every sequence.

    python benchmarks/ablation.py [--data FOLDER] [--simulated FOLDER] [--only flag ...]
    [--rules relief ...] [--until-decided] [--threads N] [--docs docs]

A rule is a field of ``polysft_mi.scene.rules.Rules``, or a setting, that decides when or whether
something happens. Each is switched off by the values in ``SWITCHES``, and everything else stays as
it is. Measured are the error of the surface and the seconds of CPU a frame, tracking alone.

Where folds come and go, the smallest change grows from frame to frame. So the tracker runs several
times with a setting changed by some hundred-thousandths; a rule's error is compared with the median
of these runs, and pays only where it is larger than all of them. A rule stays when the error grows
so by 5 % without it on at least two sequences. Rules stay, too, without which a real video is lost.

Each result goes into ``ablation.json`` as soon as it is there, and the next call does what is
missing. All of it takes many hours. With ``--until-decided`` a rule is measured until two sequences
need it, and only a rule that may go on all. The simulated sequences are made by
``benchmarks/simulate.py OUT --seed N``, one folder a seed below FOLDER. Writes ``ablation.json``
and ``ablation.md`` into DOCS.
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
from sequences import DATA, ROOT, SCENES, folder_of, scene_of

from polyfit.backend import add_mode_argument, set_variant
from polyfit.files import aside
from polysft_mi.errors import InputError, cli
from polysft_mi.scene.rules import Rules

SEQUENCES = tuple(
    "demo flag bend paper curtain corner hand poster".split()
    + "kinect_paper phi_sft_R1 tube shirt ball".split()
)
SIMULATED = (
    ("flag", 5),
    ("flag", 10),
    ("curtain", 6),
    ("bend", 10),
    ("bend", 5),
    ("bend", 11),
    ("paper", 5),
    ("curtain", 5),
    ("skirt", 1),
    ("pillow", 1),
    ("roll", 1),
)
ORDER = (*SEQUENCES, *(f"{name} {seed}" for name, seed in SIMULATED))  # of the table's columns


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
    Switch("appearance", {"appearance": False}),
    Switch("shading", settings={"k_shading": 0}),
    Switch("chromaticity", settings={"k_chroma": 0}),
    Switch("exposure", {"exposure": False}),
    Switch("light's memory", {"light_kept": 1.0}),
    Switch("relief", settings={"k_relief": 0}),
    Switch("relief's bending", {"relief_bend": 0.0}),
    Switch("relief's caution", {"noise_misfit": math.inf}),
    Switch("edges give", {"give": math.inf}),
    Switch("robust scale", {"scale_least": 0.3}),  # what it is in the first frame
    Switch("fine passes", {"fine_passes": False}),
    Switch("motion starts", {"motion_starts": False}),
    Switch("other starts", {"usual_frames": 2}),
    Switch("more iterations there", {"far_converges": False}),
    Switch("small step ends a stage", {"gain": 1e-4}),
    Switch("mirror images", {"mirror_share": 0.0}),
    Switch("texture fit", {"texture_gain": 0.0}),
    Switch("joints", settings={"k_coupling": 0.0}, rounded=True),
    Switch("unseen parts are held", {"unseen": 1.0}, rounded=True),
    Switch("softer lengths", settings={"k_mi": 100.0}, rounded=True),
    Switch("firmer outline", settings={"k_silhouette": 0.1}, rounded=True),
    Switch("softer relief", settings={"k_relief": 1e-3}, rounded=True),
)


# ---- running -------------------------------------------------------------------------------------


def sequences(data, simulated):
    """Name in the table to (scene file, folder of the data and the truth); those that are there."""
    found = {name: (name, folder_of(data, name)) for name in SEQUENCES}
    found["demo"] = "demo", os.path.join(SCENES, "demo")
    for name, seed in SIMULATED if simulated else ():
        found[f"{name} {seed}"] = name, os.path.join(simulated, str(seed), name)
    return {
        name: (scene_of(kind), folder)
        for name, (kind, folder) in found.items()
        if folder and os.path.isdir(folder)
    }


def run(switch, scene_file, data, template=None):
    """One sequence with one rule off: its figures, ``lost`` frames and ``cpu`` seconds a frame;
    with a :class:`Template`, where one is given, instead of the scene's.
    """
    from polysft_mi import tracker
    from polysft_mi.objective.problem import Problem
    from polysft_mi.results.evaluation import score
    from polysft_mi.results.truth import find_truth
    from polysft_mi.scene import experiment as scene
    from polysft_mi.surface.patch import Unknowns

    experiment = scene.load(scene_file, {"data": data, **switch.settings}, template)
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
    if set(found) == {"demo"}:
        raise InputError(f"--data {options.data}: none of the sequences is there")
    if unknown := set(options.only or ()) - set(found):
        raise InputError(f"--only {', '.join(sorted(unknown))}: known are {', '.join(found)}")
    set_variant(options.mode)
    import drjit as dr

    dr.set_thread_count(options.threads)
    for switch in SWITCHES:
        if options.rules is not None and switch.rule not in options.rules:
            continue
        for name in options.only or found:
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
