"""Whether the tests pass on other processors, with other numbers of threads, and with other LLVMs.

    python benchmarks/portability.py [-o out/portability] [--only NAME] ... [--llvm FILE] ...
        [arguments of pytest ...]

Runs the tests once in each environment and prints a table: how many passed and failed, and which
failed. Without arguments of pytest that is the whole suite each time. Results between machines may
differ by rounding, and no test may depend on that.

``host``          this machine as it is
``avx2``          no AVX-512: kernels of Dr.Jit for a Haswell, 8 lanes; the others without it
``sse``           no AVX: NumPy, SciPy, OpenCV, torch and libm with SSE 4.2 alone. Dr.Jit starts on
                  no processor without FMA, so its kernels have 4 lanes, with AVX and FMA
``one-thread``    one thread each; Dr.Jit has two, with fewer Mitsuba may wait for ever
``eight-threads`` eight threads each
``llvm-N``        this machine with the libLLVM of ``--llvm``

Each has a cache of kernels of its own. What is in force is printed, as the libraries themselves
tell. Not restricted: Embree (inside Mitsuba), Warp, and Dr.Jit in processes that tests start.
Writes ``portability.json`` and pytest's ``NAME.xml`` and ``NAME.log`` into OUT.
"""

import argparse
import contextlib
import ctypes
import importlib
import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from polyfit.backend import VARIABLE, find_libllvm, set_variant
from polysft_mi.errors import InputError, cli

ROOT = Path(__file__).resolve().parent.parent
TARGET = "PORTABILITY_TARGET"  # processor, lanes and features that Dr.Jit compiles for
THREADS = "PORTABILITY_THREADS"  # for every library; the usual variables cannot exceed the cores

# The libraries' own variables; those of NumPy and glibc list what is taken away
ENVIRONMENTS = {
    "host": {},
    "avx2": {
        TARGET: "haswell 8 +avx2,+fma",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
        "OPENCV_CPU_DISABLE": "AVX512-SKX",
        "OPENBLAS_CORETYPE": "Haswell",
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F",
    },
    "sse": {
        TARGET: "nehalem 4 +avx,+fma",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
        "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16,AVX",
        "OPENBLAS_CORETYPE": "Nehalem",
        "ATEN_CPU_CAPABILITY": "default",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX",
    },
    "one-thread": {THREADS: "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    "eight-threads": {THREADS: "8"},
}


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    """As a plugin of pytest: what no variable can say."""
    set_variant(config.getoption("--mode", None))
    if TARGET in os.environ:
        set_target(*os.environ[TARGET].split())
    if THREADS in os.environ:
        import drjit as dr
        import threadpoolctl

        count = int(os.environ[THREADS])
        dr.set_thread_count(max(2, count))
        load_libraries()
        threadpoolctl.threadpool_limits(count)
        if torch := sys.modules.get("torch"):
            torch.set_num_threads(count)


def pytest_report_header(config):
    return "in force: " + ", ".join(in_force())


def load_libraries():
    """Load what has threads of its own, so that it can be asked and told; torch where it is."""
    for name in ("scipy.linalg", "cv2", "torch"):
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(name)


def _core():
    import drjit as dr

    return ctypes.CDLL(str(next(Path(dr.__file__).parent.glob("*drjit-core.*"))))


def set_target(processor, lanes, features):
    """Have Dr.Jit compile for a processor by LLVM's name for it, with these features (at least
    one: LLVM 23 refuses an empty list). Dr.Jit offers this in C++ alone.
    """
    function = _core()._Z19jit_llvm_set_targetPKcS0_j
    function.argtypes = ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32
    function.restype = None
    function(processor.encode(), features.encode(), int(lanes))


def in_force():
    """What the libraries say that they use, a phrase each."""
    import cv2
    import drjit as dr
    import numpy as np
    import threadpoolctl

    load_libraries()
    core = _core()
    core._Z19jit_llvm_target_cpuv.restype = ctypes.c_char_p
    version = ".".join(map(str, dr.detail.llvm_version()))
    yield (
        f"Dr.Jit: LLVM {version} for {core._Z19jit_llvm_target_cpuv().decode()},"
        f" {core._Z21jit_llvm_vector_widthv()} lanes, {dr.thread_count()} threads"
    )
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    yield f"NumPy: {(simd['baseline'] + simd.get('found', []))[-1]}"
    usable = [word for word in cv2.getCPUFeaturesLine().split() if not word.endswith("?")]
    yield f"OpenCV: {usable[-1].strip('*')}"
    for pool in threadpoolctl.threadpool_info():
        if pool["internal_api"] == "openblas":
            yield f"OpenBLAS: {pool['architecture']}, {pool['num_threads']} threads"
            break
    if torch := sys.modules.get("torch"):
        yield f"torch: {torch.backends.cpu.get_cpu_capability()}, {torch.get_num_threads()} threads"


def run(name, variables, arguments, out):
    """The tests in one environment: what was in force, how many passed, the names of the failed."""
    report, log = out / f"{name}.xml", out / f"{name}.log"
    cache = out / "kernels" / name
    cache.mkdir(parents=True, exist_ok=True)
    report.unlink(missing_ok=True)
    words = "-m pytest -rN -p portability -p no:cacheprovider --color=no".split()
    environment = os.environ | variables | {"DRJIT_CACHE_DIR": str(cache)}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "benchmarks"), str(ROOT)])
    with open(log, "w", encoding="utf-8") as file:
        subprocess.run(
            [sys.executable, *words, f"--junitxml={report}", *arguments],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    text = log.read_text(encoding="utf-8", errors="replace")
    cases = list(ET.parse(report).getroot().iter("testcase")) if report.exists() else []
    if not cases:  # a wrong argument, or the process died
        raise InputError(f"{name}: no test has ended: {log} says why")
    found = [line for line in text.splitlines() if line.startswith("in force: ")]
    bad = [c for c in cases if c.find("failure") is not None or c.find("error") is not None]
    skipped = sum(c.find("skipped") is not None for c in cases)
    return {
        "in force": found[0].removeprefix("in force: ") if found else "",
        "passed": len(cases) - len(bad) - skipped,
        "skipped": skipped,
        "failed": sorted({f"{c.get('classname').split('.')[-1]}::{c.get('name')}" for c in bad}),
        "seconds": round(sum(float(c.get("time", 0)) for c in cases)),
    }


def table(results):
    """Lines of the table in Markdown."""
    yield "| environment | passed | skipped | failed | seconds |"
    yield "|---|---|---|---|---|"
    for name, found in results.items():
        failed = "; ".join([str(len(found["failed"])), *(f"`{f}`" for f in found["failed"])])
        yield f"| {name} | {found['passed']} | {found['skipped']} | {failed} | {found['seconds']} |"


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("-o", "--output", default="out/portability", metavar="OUT")
    p.add_argument(
        "--only", action="append", metavar="NAME", help="this environment alone; may be repeated"
    )
    p.add_argument(
        "--llvm", action="append", default=[], metavar="FILE", help="another libLLVM, once for each"
    )
    return p


def main(arguments=None):
    options, rest = parser().parse_known_args(arguments)
    environments = dict(ENVIRONMENTS)
    for path in options.llvm:
        os.environ[VARIABLE] = path
        _, version = find_libllvm()  # refuses what cannot be used
        del os.environ[VARIABLE]
        environments[f"llvm-{version[0]}"] = {VARIABLE: path}
    names = options.only or list(environments)
    for name in names:
        if name not in environments:
            raise InputError(f"--only {name}: choose among {', '.join(environments)}")
    out = Path(options.output).resolve()
    out.mkdir(parents=True, exist_ok=True)
    results = {}
    for name in names:
        results[name] = run(name, environments[name], rest, out)
        print(f"{name}: {results[name]['in force']}", flush=True)
        (out / "portability.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    print(*table(results), sep="\n")
    return int(any(found["failed"] for found in results.values()))


if __name__ == "__main__":
    cli(main)
