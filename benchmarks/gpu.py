"""Whether the code runs on a GPU, and what it is worth there: Mitsuba's ``cuda_ad_rgb`` beside
``llvm_ad_rgb``, torch's ``cuda`` beside ``cpu``.

    python benchmarks/gpu.py [-m cuda_ad_rgb] [--budget 480] [--data FOLDER ...] [--only PART ...]

Each part is a process of its own with a time limit, the most telling first: arithmetic of Dr.Jit
without rays, the renderer and the closed forms against finite differences and between the variants,
the demo, the tests, then other sequences, OneFit, and where the time of a frame goes. A part that
fails, hangs or ends its process is told in a line, and the next one begins. ``gpu.json`` (with
tracebacks), ``gpu.md`` and ``gpu.log`` (all that the parts printed) are written anew after each
part; the tests' verdicts are in ``junit.xml``.

With ``-m llvm_ad_rgb`` the same is done on the CPU alone.
"""

import argparse
import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from dataclasses import asdict, dataclass, field

from sequences import DATA, ROOT, folder_of, scene_of

from polysft_mi.errors import InputError, cli

WORKER = os.path.join(ROOT, "benchmarks", "gpu_parts.py")
HOST = "llvm_ad_rgb"
_LEAST = 15.0  # seconds that must be left for a part to begin
_GRACE = 10.0  # seconds from SIGINT, which lets pytest write its report, to SIGKILL
_KEPT = 60  # last lines of a failed part's output in gpu.json
# Folders of the tests that use Mitsuba's variant, in the order of what they tell
_TESTS = (
    ("render",),
    ("images", "objective"),
    ("solvers", "tracker", "surface", "scene"),
    ("results", "pictures"),
)


@dataclass
class Part:
    """What is done in one process: ``name`` and ``on`` (variant, or torch's device); the command;
    at most ``limit`` seconds. Afterwards: its ``status`` (done, failed, timed out, left out),
    ``seconds``, the ``checks`` and ``figures`` that it told, and of what did not end well the last
    lines of its output.
    """

    name: str
    on: str
    command: list
    limit: float
    junit: str | None = None
    status: str = "left out"
    seconds: float = 0.0
    checks: list = field(default_factory=list)
    figures: dict = field(default_factory=dict)
    tail: list = field(default_factory=list)

    @property
    def title(self):
        return f"{self.name}, {self.on}"


def parts_of(options, scratch):
    """All parts, the most telling first."""
    device, torch_device = options.mode, "cuda" if options.mode.startswith("cuda") else "cpu"
    sequences = {}
    for name in ("flag", "shirt"):
        found = next(filter(None, (folder_of(place, name) for place in options.data)), None)
        if found:
            sequences[name] = [scene_of(name), f"data={found}"]
    worker = lambda part, on, limit, *arguments, name=None: Part(
        name or part, on, [WORKER, part, on, scratch, *map(str, arguments)], limit
    )
    track = lambda name, on, limit, frames, title=None, *more: worker(
        "track",
        on,
        limit,
        *sequences.get(name, [scene_of(name), ""]),
        frames,
        *more,
        name=title or name,
    )
    both = [device] + [HOST] * (device != HOST and not options.device_only)
    parts = [worker("arrays", on, 60) for on in both]
    parts += [worker("forms", on, 120) for on in both]
    parts += [track("demo", on, 120, 12) for on in both]
    parts += [_tests(folders, device, scratch, options.workers) for folders in _TESTS[:2]]
    parts += [track("flag", on, 90, options.frames) for on in both if "flag" in sequences]
    parts += [
        track("flag", on, 60, 5, "kernels timed, flag", "history")
        for on in both
        if "flag" in sequences
    ]
    parts += [_tests(folders, device, scratch, options.workers) for folders in _TESTS[2:]]
    command = ["-m", "polysft_mi.run", scene_of("demo"), "-m", device, "-q", "--json"]
    out = os.path.join(scratch, "run")
    parts.append(Part("polysft run, demo", device, [*command, "-o", out], 120))
    parts += [track("shirt", on, 90, options.frames) for on in both if "shirt" in sequences]
    for on in dict.fromkeys((torch_device, torch_device if options.device_only else "cpu")):
        parts.append(worker("drape", on, 60))
        parts.append(worker("train", on, 60))
    return parts


def _tests(folders, device, scratch, workers):
    junit = os.path.join(scratch, f"{folders[0]}.xml")
    paths = [os.path.join("tests", "polysft_mi", folder) for folder in folders]
    command = ["-m", "pytest", "-q", "--mode", device, f"--junitxml={junit}", "--durations=5"]
    shared = ["-n", str(workers), "--dist", "loadfile"] if workers > 1 else []
    return Part(f"tests: {', '.join(folders)}", device, [*command, *shared, *paths], 120, junit)


def run(part, limit, scratch, log):
    """Run a part for at most ``limit`` seconds, and put down how it ended."""
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    told = os.path.join(scratch, "told.jsonl")
    environment["GPU_PART_TELLS"] = told
    paths = [ROOT, os.environ.get("PYTHONPATH")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    open(told, "w").close()
    start = log.tell()
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *part.command],
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        status = process.wait(limit)
        part.status = "done" if status == 0 else "failed"
    except subprocess.TimeoutExpired:
        part.status, status = "timed out", None
        _end(process)
    part.seconds = time.perf_counter() - began
    log.flush()
    with open(log.name, encoding="utf-8", errors="replace") as file:
        file.seek(start)
        lines = file.read().splitlines()
    log.seek(0, os.SEEK_END)
    with open(told, encoding="utf-8") as file:
        for line in file:
            if line.endswith("\n"):
                entry = json.loads(line)
                if "check" in entry:
                    part.checks.append(entry)
                else:
                    part.figures |= entry
    if status:
        part.figures["exit status"] = status
    if part.status != "done":
        part.tail = lines[-_KEPT:]
    if part.name.startswith("polysft run") and part.status == "done":
        part.figures |= _last_json(lines)
    if part.junit:
        part.figures |= _verdicts(part.junit, lines)


def _end(process):
    """End a process and all that it started: politely, then at once."""
    for sign, patience in ((signal.SIGINT, _GRACE), (signal.SIGKILL, None)):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, sign)
        try:
            process.wait(patience)
        except subprocess.TimeoutExpired:
            continue
        if sign == signal.SIGKILL:
            return


def _last_json(lines):
    found = next((text for text in reversed(lines) if text.startswith("{")), "{}")
    return {k: v for k, v in json.loads(found).items() if isinstance(v, int | float)}


def _verdicts(junit, lines):
    """How many tests passed, failed and were left out, and of each failure its first line."""
    try:
        suite = next(ET.parse(junit).getroot().iter("testsuite"))
    except (OSError, ET.ParseError, StopIteration):
        return {"said": next((text for text in reversed(lines) if text.strip()), "nothing")}
    counts = {k: int(suite.get(k, 0)) for k in ("tests", "failures", "errors", "skipped")}
    failed = {}
    for case in suite.iter("testcase"):
        for kind in ("failure", "error"):
            found = case.find(kind)
            if found is not None:
                text = (found.get("message") or "").strip().splitlines() or [kind]
                failed[f"{case.get('classname')}::{case.get('name')}"] = text[0][:300]
    return {**counts, "failed": failed}


def machine():
    """The machine in words: processor, GPU, driver, OptiX's library, versions."""
    ask = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        gpu = subprocess.run(ask, capture_output=True, text=True, timeout=30).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        gpu = ""
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        names = [text.partition(":")[2].strip() for text in file if text.startswith("model name")]
    return {
        "cpu": f"{(names or ['unknown'])[0]}, {os.cpu_count()} cores",
        "gpu": gpu or "none",
        "python": platform.python_version(),
        "optix": os.environ.get("DRJIT_LIBOPTIX_PATH", "searched by Dr.Jit"),
        "llvm": os.environ.get("DRJIT_LIBLLVM_PATH", "searched"),
    }


def table(report):
    """The report as Markdown: what failed, then the figures of all parts, with ratios."""
    about, parts = report["machine"], report["parts"]
    text = ["# On a GPU", "", *(f"- {k}: {v}" for k, v in about.items()), "", "## Parts", ""]
    text += ["| part | on | how it ended | seconds | checks |", "|---|---|---|---:|---|"]
    for p in parts:
        good = sum(c["ok"] for c in p["checks"])
        checks = f"{good} of {len(p['checks'])}" if p["checks"] else ""
        if "tests" in p["figures"]:
            f = p["figures"]
            bad = f["failures"] + f["errors"]
            checks = f"{f['tests'] - bad - f['skipped']} passed, {bad} failed, {f['skipped']} not"
        text.append(f"| {p['name']} | {p['on']} | {p['status']} | {p['seconds']:.1f} | {checks} |")
    text += ["", "## What is wrong", ""]
    for p in parts:
        title = f"{p['name']}, {p['on']}"
        for c in p["checks"]:
            if not c["ok"]:
                text.append(f"- {title}: {c['check']}: {c['said']}")
        for name, said in p["figures"].get("failed", {}).items():
            text.append(f"- {title}: {name}: {said}")
        if p["status"] in ("failed", "timed out") and not p["figures"].get("failed"):
            last = next((line for line in reversed(p["tail"]) if line.strip()), "")
            text.append(f"- {title}: {p['status']}: {last[:300]}")
    text += ["", "## Checks", "", "| part | on | check | found |", "|---|---|---|---|"]
    for p in parts:
        text += [
            f"| {p['name']} | {p['on']} | {c['check']} | {c['said']} |"
            for c in p["checks"]
            if c["ok"]
        ]
    text += ["", "## Figures", "", "| part | figure | device | host | host / device |"]
    text.append("|---|---|---:|---:|---:|")
    names = dict.fromkeys(p["name"] for p in parts)
    for name in names:
        same = [p["figures"] for p in parts if p["name"] == name]
        for key in dict.fromkeys(k for figures in same for k in figures):
            values = [f.get(key) for f in same]
            if all(isinstance(v, int | float) or v is None for v in values) and key != "tests":
                cells = ["" if v is None else f"{v:.5g}" for v in values] + [""] * (2 - len(values))
                both = len(values) == 2 and all(values)
                ratio = f"{values[1] / values[0]:.2f}" if both else ""
                text.append(f"| {name} | {key} | {cells[0]} | {cells[1]} | {ratio} |")
    return "\n".join(text) + "\n"


def write(options, report):
    for name, text in (("gpu.json", json.dumps(report, indent=1)), ("gpu.md", table(report))):
        path = os.path.join(options.out, name)
        with open(path + ".new", "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(path + ".new", path)


def join_junit(options, parts):
    whole = ET.Element("testsuites")
    for part in parts:
        try:
            whole.extend(ET.parse(part.junit).getroot().iter("testsuite"))
        except (OSError, ET.ParseError, TypeError):
            continue
    if len(whole):
        ET.ElementTree(whole).write(os.path.join(options.out, "junit.xml"), encoding="utf-8")


def agreement(scratch, device):
    """Checks that what a part left on the device is what it left on the host."""
    import numpy as np

    stored = [os.path.join(scratch, f"forms-{on}.npz") for on in (device, HOST)]
    if device == HOST or not all(map(os.path.exists, stored)):
        return None
    part = Part("agreement of the variants", f"{device}, {HOST}", [], 0, status="done")
    one, other = (np.load(path) for path in stored)
    for name in one.files:
        if name not in other.files:
            continue
        a, b = (x[name].astype(np.float64) for x in (one, other))
        if a.shape != b.shape:
            said, ok = f"shapes {a.shape} and {b.shape}", False
        else:
            apart = float(np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-30))
            said, ok = f"relative difference {apart:.2g}", apart < 1e-2
        part.checks.append({"check": name, "ok": ok, "said": said})
    return part


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "-m", "--mode", default="cuda_ad_rgb", help="the device's variant (default: cuda_ad_rgb)"
    )
    p.add_argument(
        "--budget", type=float, default=480, help="seconds for everything (default: 480)"
    )
    p.add_argument(
        "--data",
        nargs="+",
        default=[DATA],
        metavar="FOLDER",
        help="folders that hold the sequences flag and shirt, or one above; what is missing is left"
        " out",
    )
    p.add_argument("--frames", type=int, default=15, help="of flag and shirt (default: 15)")
    p.add_argument(
        "--workers", type=int, default=min(6, os.cpu_count() or 1), help="processes of the tests"
    )
    p.add_argument(
        "--device-only", action="store_true", help="nothing on the CPU, as where LLVM is not found"
    )
    p.add_argument("--only", nargs="+", metavar="PART", help="parts whose names begin so")
    p.add_argument("--skip", nargs="+", default=[], metavar="PART", help="parts to leave out")
    p.add_argument("-o", "--out", default="out/benchmarks/gpu", metavar="FOLDER")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if not options.budget > 0 or options.frames < 2:
        raise InputError(
            f"--budget {options.budget:g} --frames {options.frames}: more than 0 seconds and at"
            " least 2 frames are needed"
        )
    end = time.perf_counter() + options.budget
    os.makedirs(options.out, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,
        open(os.path.join(options.out, "gpu.log"), "w+", encoding="utf-8") as log,
    ):
        parts = [
            part
            for part in parts_of(options, scratch)
            if (not options.only or part.name.startswith(tuple(options.only)))
            and not part.name.startswith(tuple(options.skip or ["\n"]))
        ]
        if not parts:
            raise InputError(f"--only {' '.join(options.only or [])}: no part begins so")
        about, compared = machine(), None
        for part in parts:
            left = end - time.perf_counter() - _GRACE
            if left >= _LEAST:
                log.write(f"\n==== {part.title}\n")
                log.flush()
                run(part, min(part.limit, left), scratch, log)
            compared = compared or agreement(scratch, options.mode)
            every = parts + [compared] * (compared is not None)
            write(options, {"machine": about, "parts": [asdict(p) for p in every]})
            join_junit(options, parts)
            bad = [f"{c['check']}: {c['said']}" for c in part.checks if not c["ok"]]
            print(f"{part.seconds:5.1f} s  {part.title}: {part.status}", *bad, sep="\n    ")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    cli(main)
