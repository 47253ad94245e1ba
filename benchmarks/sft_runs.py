"""The runs of ``sft.py``: each method's command on a sequence, timed as a whole and scored; and the
best that a jet can hold of the sequence's truth.
"""

import functools
import glob
import json
import os
import subprocess
import sys
import time

import numpy as np
from best_jets import best_jets
from sequences import ROOT, scene_of
from sft_results import JET

from polysft_mi.errors import InputError
from polysft_mi.results.evaluation import evaluate, score
from polysft_mi.results.truth import find_truth, load_npz
from polysft_mi.surface import meshio

_METHODS = {
    "gauss-newton": ["solver=gauss-newton"],
    "adam": ["preset=paper"],
    "adam-reweighted": ["preset=paper", "k_mi=1", "k_tc=5e-5", "k_silhouette=0.05"],
}


def command(sequence, method, folder, out, setup, masks=None):
    """The command line of one result, a list; ``setup`` as :func:`setup_of` makes it; ``masks``: a
    folder of them, for adam-reweighted where the sequence has none.
    """
    define = [f"data={os.path.abspath(folder)}", *setup["define"]]
    if setup["frames"]:
        define.append(f"last={setup['frames'] - 1}")
    if method == "per-vertex":
        line = [sys.executable, os.path.join(ROOT, "benchmarks", "per_vertex.py")]
    else:
        line = [sys.executable, "-m", "polysft_mi.run"]
        define += _METHODS[method]
        if masks and method == "adam-reweighted" and not glob.glob(os.path.join(folder, "mask*")):
            define.append(f"masks={os.path.abspath(masks)}")
    line += [scene_of(sequence), "-o", out, "--overwrite", "-q"]
    if setup["mode"]:
        line += ["-m", setup["mode"]]
    if method == "per-vertex" and setup["iterations"]:
        line += ["--iterations", str(setup["iterations"])]
    return line + [part for text in define for part in ("-D", text)]


def setup_of(options):
    """What two results must share to stand in one table."""
    return {
        name: getattr(options, name)
        for name in ("frames", "threads", "define", "mode", "iterations")
    }


def is_whole(setup):
    """Whether results of this setup are what the documentation shows: whole videos, default
    settings.
    """
    return not (setup["frames"] or setup["threads"] or setup["define"] or setup["iterations"])


def run(sequence, method, folder, out, setup, masks=None):
    """Run one command (:func:`command`) and read its accuracy: a result, a dict. A command that
    fails gives one with ``error``, its last line.
    """
    line = command(sequence, method, folder, out, setup, masks)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [ROOT, os.environ.get("PYTHONPATH")])),
    }
    limit = None
    if setup["threads"]:
        environment |= {
            name: str(setup["threads"])
            for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        }
        chosen = set(
            allowed_cores()[: setup["threads"]]
        )  # Dr.Jit and OpenCV take as many threads as there are cores for them
        limit = (
            (lambda: os.sched_setaffinity(0, chosen)) if hasattr(os, "sched_setaffinity") else None
        )
    # the results are for other machines too: paths begin with the sequence's name there
    known = {os.path.abspath(folder): sequence, folder: sequence, ROOT + os.sep: ""}
    known |= {out: os.path.join("OUT", os.path.basename(out))}
    if masks:
        known = {os.path.abspath(masks): "MASKS", **known}
    plain = lambda text: functools.reduce(lambda t, pair: t.replace(*pair), known.items(), text)
    result = {
        "sequence": sequence,
        "method": method,
        "setup": setup,
        "command": [plain(part) for part in line[1:]],
    }
    result |= {"machine": machine(setup), "load": os.getloadavg()[0]}
    os.makedirs(os.path.dirname(os.path.abspath(out)), exist_ok=True)
    with open(f"{out}.log", "w+", encoding="utf-8") as log:
        began = time.perf_counter()
        status = subprocess.run(
            line,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            preexec_fn=limit,
        ).returncode
        result["seconds"] = time.perf_counter() - began
        log.seek(0)
        said = log.read().split("\n")
    if status:
        return {
            **result,
            "error": plain(
                next((text for text in reversed(said) if text.strip()), f"exit status {status}")
            ),
        }
    with open(os.path.join(out, "metrics.json"), encoding="utf-8") as file:
        summary = json.load(file)
    orders = [summary["order"]] if summary.get("order") else []
    try:
        figures = {"figures": evaluate(out, folder)}
    except InputError as error:  # none of the first frames may have a truth
        figures = {"figures": {}, "unscored": plain(str(error))}
    return {
        **result,
        **figures,
        "frames": summary["frames"],
        "lost": len(summary.get("lost", {})),
        "seconds_a_frame": result["seconds"] / summary["frames"],
        "iterations": summary.get("iterations_per_window"),
        "orders": [int(min(orders)), int(max(orders))] if orders else None,
        "versions": summary.get("versions"),
    }


def allowed_cores():
    """Numbers of the cores that this process may run on."""
    return (
        sorted(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else list(range(os.cpu_count() or 1))
    )


def machine(setup):
    """The machine in words: CPU, how many of its cores are used, and the GPU where one is asked for
    by name.
    """
    name = "CPU of unknown model"
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next(
                text.partition(":")[2].strip() for text in file if text.startswith("model name")
            )
    except (OSError, StopIteration):
        pass
    cores, used = os.cpu_count() or 1, min(len(allowed_cores()), setup["threads"] or sys.maxsize)
    text = f"{name}, {cores} core{'s' * (cores != 1)}" + (
        f", {used} of them used" if used < cores else ""
    )
    if (setup["mode"] or "").startswith("cuda"):
        ask = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        text += ", " + (
            subprocess.run(ask, capture_output=True, text=True).stdout.strip().split("\n")[0]
            or "GPU of unknown model"
        )
    return text


def jet_result(sequence, folder, order, setup):
    """The result of :func:`best_jets` on a sequence whose truth is a mesh; None on others."""
    from polysft_mi.surface.template import Template

    truth_path, obj = find_truth(folder), os.path.join(folder, "template.obj")
    if os.path.isdir(truth_path) or not os.path.isfile(obj):
        return None
    truth = load_npz(truth_path)
    if "vertices" not in truth:
        return None
    vertices, faces, texcoords = meshio.read_textured_template(obj)
    template = Template.fit(vertices, faces, texcoords, order, exact=False, where=obj)
    meshes = truth["vertices"][: setup["frames"] or None]
    surface = {
        "vertices": best_jets(template, meshes),
        "faces": template.faces,
        "frames": np.arange(len(meshes)),
    }
    figures = score(surface, truth_path)
    return {
        "sequence": sequence,
        "method": JET,
        "setup": setup,
        "frames": len(meshes),
        "orders": [order, order],
        "figures": figures,
    }
