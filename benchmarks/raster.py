"""How fast ``raster`` is beside Mitsuba's path replay, DEODR, nvdiffrast and DRTK: a picture, and
one forward and backward pass, gradient to all vertex positions.

    python benchmarks/raster.py [--sizes 160x120 640x480 ...] [--grids 33 72 225] [-o
    out/benchmarks] [-m llvm_ad_rgb]

The scene is a gently bent, textured sheet that fills half of the image, under a constant emitter of
radiance 1; the loss is the squared difference to the picture of the sheet a little further bent.
The contenders:

    raster          ``render()`` under Dr.Jit's AD, as the solver calls it: RGB and alpha, unlit
    raster, mi      the same through ``mi.render``, which renders once more for the backward pass
    prb_projective  through ``mi.render``, 1 sample a pixel, depth 2, ``sppi = 0``: RGB alone
    deodr           where it is installed (``pip install deodr``): RGB and alpha, one thread
    nvdiffrast      where it is installed, with ``-m cuda_ad_rgb``: RGB and alpha, antialiased
    drtk            likewise: RGB and alpha

Depth 2 is one bounce, the emitter's light off the sheet, which is the texture's own colour wherever
the sheet does not shadow itself: what raster shows (depth 1 would be black). ``sppi = 0`` leaves
out the edges of shadows, which this scene does not have. That is in path replay's favour: by
default it looks for them with 512 samples a pixel in every backward pass, and took 500 times as
long as raster at 160x120.

All of a case's contenders run in one process, turn by turn; times are medians after a warm-up,
ratios medians of the ratios within a turn, so that what else the machine does meanwhile falls on
all. Moving the sheet (``params.update()``, which rebuilds what rays are traced with) is timed
apart, for it is no part of either. Peak memory is measured in a process of its own for each
contender and case; growth and compilation over many iterations too. The table of docs/raster.md,
on one core, where times are those of the processor:

    taskset -c 0 python benchmarks/raster.py --grids 33 -o docs \\
        --sizes 256x256 512x512 1024x1024 2048x2048

On a GPU (``-m cuda_ad_rgb``) times are those of the clock, after Dr.Jit and torch have ended what
they do, and memory is also the peak of what Dr.Jit or torch allocated on the device: without what
nvdiffrast allocates past torch. A contender that fails is left out, with a line that says why.

Writes ``raster.json`` and ``raster.png`` (of a GPU ``raster_cuda``), anew after every case, so that
an interrupted run leaves the cases that it reached.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
from cases import add_case_arguments, parse_size
from raster_cuda import AVAILABLE as AVAILABLE_ON_CUDA
from raster_cuda import CONTENDERS as CUDA_CONTENDERS
from raster_deodr import AVAILABLE, DeodrContender
from raster_figures import (
    CONTENDERS,
    TARGET,
    judge_long_run,
    page_table,
    print_end,
    print_likeness,
    print_table,
    summarise,
    write,
)
from sequences import ROOT

from polyfit.backend import add_mode_argument, set_variant
from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError, cli

SIZES = ("160x120", "320x240", "640x480", "1280x720", "1920x1080")
GRIDS = (33, 72, 225)  # vertices a side: 1,089 vertices, 10,082 and 100,352 triangles
WARM_UP, LEAST_TURNS, MOST_TURNS = 2, 3, 60  # few where a turn takes seconds
MEMORY_PASSES = 2
AT_ONCE = 8  # processes that measure memory on a GPU
# On one core, seconds of that core: what others do on it meanwhile does not count
_CLOCK = time.process_time if len(os.sched_getaffinity(0)) == 1 else time.perf_counter
NAMES = [name for name in CONTENDERS if {"deodr": AVAILABLE, **AVAILABLE_ON_CUDA}.get(name, True)]

_SCENE = """<scene version="3.0.0">
{sensor}
    <shape type="ply" id="template">
        <string name="filename" value="{mesh}"/>
        <bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
            <string name="filename" value="{texture}"/><string name="wrap_mode" value="clamp"/>
        </texture></bsdf></bsdf>
    </shape>
    <emitter type="constant"/>
</scene>"""


def sheet(points, size):
    """A bent sheet of points x points vertices before :func:`camera`: (vertices (N, 3) [m, camera
    frame], faces (F, 3), uv (N, 2)).
    """
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, points), np.linspace(0, 1, points)))
    extent = np.sqrt(0.5) * np.array([size[0], size[1]]) / camera(size).fx
    x, y = (u - 0.5) * extent[0], (v - 0.5) * extent[1]
    z = 1 + 0.1 * extent[0] * np.cos(np.pi * (u - 0.5 + 0.3 * v))
    c, s = (
        np.cos(np.radians(10)),
        np.sin(np.radians(10)),
    )  # so that its borders run slantwise over the pixels
    k = np.arange(points * points).reshape(points, points)
    a, b, d, e = (q.ravel() for q in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    faces = np.stack([a, d, b, b, d, e], axis=1).reshape(-1, 3)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1), faces, np.stack([u, 1 - v], axis=1)


def camera(size):
    width, height = size
    return Intrinsics(1.1 * width, 1.1 * width, width / 2, height / 2, width, height)


# ---- in a worker's process -----------------------------------------------------------------------


class Contender:
    """One way to render the scene, and the sheet in it."""

    def __init__(self, name, size, points, folder):
        import drjit as dr
        import mitsuba as mi

        from polyfit.mesh import write_ply

        self.name, self.path_replay = name, name.startswith("prb")
        vertices, faces, uv = sheet(points, size)
        mesh = os.path.join(folder, "sheet.ply")
        write_ply(mesh, vertices, faces, uv)
        sensor = camera(size).sensor_xml()
        if self.path_replay:
            sensor = sensor.replace("rgba", "rgb")
        texture = os.path.join(ROOT, "scenes", "demo", "texture.jpg")
        self.scene = mi.load_string(
            _SCENE.format(sensor=sensor, mesh=mesh, texture=texture), optimize=False
        )
        integrator = (
            {"type": "prb_projective", "max_depth": 2, "sppi": 0}
            if self.path_replay
            else {"type": "raster"}
        )
        self.integrator = mi.load_dict(integrator)
        self.params, self.key = mi.traverse(self.scene), "template.vertex_positions"
        self.rest = mi.Float(self.params[self.key])
        bend = np.zeros_like(vertices)
        bend[:, 2] = vertices[:, 0] ** 2
        self.bend = mi.Float(bend.ravel().astype(np.float32))
        self.place(0.5)
        with dr.suspend_grad():
            self.target = self.render(0).array
            dr.eval(self.target)

    def place(self, amount):
        """Bend the sheet by ``amount`` [1/m], attached to its vertex positions."""
        import drjit as dr
        import mitsuba as mi

        self.positions = mi.Float(self.rest + dr.opaque(mi.Float, amount) * self.bend)
        dr.eval(self.positions)
        dr.enable_grad(self.positions)
        self.params[self.key] = self.positions
        self.params.update()
        dr.sync_thread()

    def render(self, seed):
        import mitsuba as mi

        if self.name == "raster":
            return self.integrator.render(self.scene, 0, spp=1)
        return mi.render(self.scene, self.params, integrator=self.integrator, spp=1, seed=seed)

    def forward_backward(self, seed):
        """Gradient of the loss to the vertex positions, Float of 3N, evaluated."""
        import drjit as dr

        loss = dr.sum(dr.square(self.render(seed).array - self.target))
        dr.backward(loss)
        gradient = dr.grad(self.positions)
        dr.eval(loss, gradient)
        dr.sync_thread()
        return gradient

    def forward(self, seed):
        """The picture alone, evaluated."""
        import drjit as dr

        with dr.suspend_grad():
            image = self.render(seed).array
        dr.eval(image)
        dr.sync_thread()
        return image


def on_gpu(mode):
    return mode is not None and mode.startswith("cuda")


def names_for(mode):
    """Names of the contenders that there are here."""
    return [name for name in NAMES if on_gpu(mode) or name not in CUDA_CONTENDERS]


def contender(name, size, points, folder):
    """The contender of this name, with its sheet."""
    if name != "deodr" and name not in CUDA_CONTENDERS:
        return Contender(name, size, points, folder)
    import mitsuba as mi

    vertices, faces, uv = sheet(points, size)
    bitmap = mi.Bitmap(os.path.join(ROOT, "scenes", "demo", "texture.jpg"))
    linear = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    bend = np.zeros_like(vertices)
    bend[:, 2] = vertices[:, 0] ** 2
    make = CUDA_CONTENDERS.get(name, DeodrContender)
    return make(vertices, faces, uv, camera(size), np.array(linear), bend)


def now():
    """Seconds; on a GPU those of the clock, when all that was asked of it is done."""
    import mitsuba as mi

    if not on_gpu(mi.variant()):
        return _CLOCK()
    import drjit as dr

    dr.sync_thread()
    torch = sys.modules.get("torch")
    if torch and torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


def turn(contender, k):
    """Move the sheet, take a picture and a gradient: seconds of each."""
    times = [now()]
    for do in (
        lambda: contender.place(amount(k)),
        lambda: contender.forward(k),
        lambda: contender.forward_backward(k),
    ):
        do()
        times.append(now())
    return np.diff(times).tolist()


def amount(k):
    """How far the sheet is bent in iteration k [1/m]: never twice the same within hundreds, so that
    its outline changes as in a fit.
    """
    return 0.3 * np.sin(0.37 * k)


def resident():
    """Memory of this process [MB] that is in use now."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6


def peak_resident():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def measure_times(size, points, folder, seconds, names=None):
    """Milliseconds of every turn, contender to list: ``passes``, ``pictures`` and ``moves``; and
    how far the pictures differ. ``names``: of the contenders, all by default.
    """
    import mitsuba as mi

    names = names_for(mi.variant()) if names is None else names
    contenders = {}
    for name in names:
        try:
            contenders[name] = contender(name, size, points, folder)
        except Exception as error:
            leave_out(contenders, name, error)
    passes, pictures, moves = ({name: [] for name in contenders} for _ in range(3))
    began = None
    for k in range(WARM_UP + MOST_TURNS):
        if k == WARM_UP:
            began = time.perf_counter()
        if k >= WARM_UP + LEAST_TURNS and time.perf_counter() - began > seconds:
            break
        for name in list(contenders) if k % 2 else list(contenders)[::-1]:
            try:
                move, picture, one_pass = turn(contenders[name], k)
            except Exception as error:
                leave_out(contenders, name, error)
                continue
            if k >= WARM_UP:
                moves[name].append(1e3 * move)
                pictures[name].append(1e3 * picture)
                passes[name].append(1e3 * one_pass)
    likeness = compare_pictures(contenders)
    kept = lambda times: {name: times[name] for name in contenders}
    return {
        "passes": kept(passes),
        "pictures": kept(pictures),
        "moves": kept(moves),
        **likeness,
    }


def leave_out(contenders, name, error):
    """Take the contender that failed out of ``contenders``, and say so; raster must not fail."""
    if name == "raster":
        raise error
    contenders.pop(name, None)
    say_left_out(name, f"{type(error).__name__}: {error}")


def say_left_out(name, why):
    print(f"{name} is left out: {' '.join(why.split())[:300]}", file=sys.stderr, flush=True)


def as_array(values):
    """A NumPy array of a tensor of torch, or an array of Dr.Jit or NumPy."""
    if hasattr(values, "detach") and hasattr(values, "cpu"):
        values = values.detach().cpu()
    return np.array(values, dtype=np.float64)


def compare_pictures(contenders):
    """That all show the same: share of the image that the sheet covers, mean colour on it, and mean
    difference of raster from path replay (16 samples); how far the others' pictures are from
    raster's, and the cosine of each gradient with raster's.
    """
    import mitsuba as mi

    raster = contenders["raster"]
    for one in contenders.values():
        one.place(0)
    image = np.array(raster.render(0))
    gradient = as_array(raster.forward_backward(0))
    inside = image[..., 3] > 0.999
    found = {
        "coverage": float(image[..., 3].mean()),
        "mean_colour": float(image[inside, :3].mean()),
    }
    for name, one in list(contenders.items()):
        if name.split(",")[0] == "raster":
            continue
        try:
            if name == "prb_projective":
                other = np.array(mi.render(one.scene, integrator=one.integrator, spp=16))
                apart = image[inside, :3] - other[inside]
                found["mean_difference"] = float(apart.mean())
                found["mean_absolute_difference"] = float(np.abs(apart).mean())
            else:
                apart = np.abs(image[inside] - as_array(one.forward(0))[inside])
                found[f"mean_absolute_difference_of_{name}"] = float(apart.mean())
            other = as_array(one.forward_backward(0))
        except Exception as error:
            leave_out(contenders, name, error)
            continue
        lengths = np.linalg.norm(gradient) * np.linalg.norm(other)
        found[f"gradient_cosine_of_{name}"] = float(gradient @ other / lengths)
    return found


def measure_memory(size, points, folder, name):
    """Peak memory of this process [MB], what it held before the first scene, and Dr.Jit's own
    peak.
    """
    import drjit as dr
    import mitsuba as mi

    started = resident()
    one = contender(name, size, points, folder)
    for k in range(MEMORY_PASSES):
        turn(one, k)
    gpu = on_gpu(mi.variant())
    backend = dr.JitBackend.CUDA if gpu else dr.JitBackend.LLVM
    memory = {
        "started_mb": started,
        "peak_mb": peak_resident(),
        "drjit_peak_mb": dr.detail.malloc_watermark(backend) / 1e6,
    }
    if gpu:
        memory["device_peak_mb"] = memory["drjit_peak_mb"]
        if name in CUDA_CONTENDERS:
            import torch

            memory["device_peak_mb"] = torch.cuda.max_memory_allocated() / 1e6
    return memory


def measure_growth(size, points, folder, iterations):
    """Memory of the process [MB] after each iteration of raster."""
    one, held = contender("raster", size, points, folder), []
    for k in range(iterations):
        one.place(amount(k))
        one.forward_backward(k)
        held.append(resident())
    return {"resident_mb": held}


def measure_kernels(size, points, folder, iterations):
    """Kernels that each iteration of raster launched, and those that it did not find in Dr.Jit's
    memory: compiled, or read from its cache on the disk.
    """
    import drjit as dr

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    one, launched, new = contender("raster", size, points, folder), [], []
    dr.kernel_history_clear()
    for k in range(iterations):
        one.place(amount(k))
        one.forward_backward(k)
        history = [
            entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT
        ]  # reading clears it
        launched.append(len(history))
        new.append(sum(entry["cache_disk"] or not entry["cache_hit"] for entry in history))
    return {"launched": launched, "new": new}


MEASURES = {
    "times": measure_times,
    "memory": measure_memory,
    "growth": measure_growth,
    "kernels": measure_kernels,
}


def worker(job):
    """Do one measurement and print its result, a line of JSON."""
    variant = set_variant(job["mode"])
    from polysft_mi.results import outputs
    from polysft_mi.scene import plugins

    plugins.register()
    size = parse_size(job["size"])
    with tempfile.TemporaryDirectory() as folder:
        result = MEASURES[job["measure"]](size, job["grid"], folder, **job.get("options", {}))
    print(json.dumps({**result, "variant": variant, "versions": outputs.versions()}))


# ---- in the benchmark's own process, which stays small: a process counts its parent's memory as
# its own peak


def in_process(measure, size, grid, mode, **options):
    """What the measurement returns that a process of its own makes."""
    job = {"measure": measure, "size": size, "grid": grid, "mode": mode, "options": options}
    done = subprocess.run(
        [sys.executable, os.path.abspath(__file__), "--worker", json.dumps(job)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if measure == "memory" else None,
        text=True,
    )
    if done.returncode:
        words = (done.stderr or "").strip().splitlines()[-1:]
        raise InputError(
            f"{measure} at {size}, {grid}x{grid} vertices: the measuring process ended with status"
            f" {done.returncode}{''.join(': ' + word for word in words)}"
        )
    return json.loads(done.stdout.splitlines()[-1])


def memory_or_why(size, grid, mode, name):
    """Peak memory of a contender, or in words why it failed: of raster, raises InputError."""
    try:
        return in_process("memory", size, grid, mode, name=name)
    except InputError as error:
        if name == "raster":
            raise
        return str(error)


def time_case(size, grid, options, names):
    """The times of a case; a second time without the contenders in torch where they end the
    process.
    """
    measure = lambda names: in_process(
        "times", size, grid, options.mode, seconds=options.seconds, names=names
    )
    try:
        return measure(names)
    except InputError as error:
        left = [name for name in names if name not in CUDA_CONTENDERS]
        if left == names:
            raise
        say_left_out(", ".join(name for name in names if name not in left), str(error))
        return measure(left)


def parser():
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_case_arguments(p, SIZES, GRIDS)
    p.add_argument(
        "--seconds",
        type=float,
        default=5,
        help=(
            f"time for the turns of a case, of which there are at least {LEAST_TURNS} (default: 5)"
        ),
    )
    p.add_argument(
        "--iterations",
        type=int,
        default=300,
        help="length of the run that must not grow or compile (default: 300)",
    )
    p.add_argument(
        "-o",
        "--out",
        metavar="FOLDER",
        default="out/benchmarks",
        help="for raster.json and raster.png (default: out/benchmarks)",
    )
    add_mode_argument(p)
    p.add_argument("--worker", help=argparse.SUPPRESS)
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if options.worker:
        return worker(json.loads(options.worker))
    for size in options.sizes:
        parse_size(size)
    if min(options.grids) < 2 or options.iterations < 12:
        raise InputError(
            f"--grids {options.grids} --iterations {options.iterations}: at least 2 vertices a side"
            " and 12 iterations are needed"
        )
    os.makedirs(options.out, exist_ok=True)
    began, cases = time.perf_counter(), []
    size, grid = (TARGET[0] if TARGET[0] in options.sizes else options.sizes[0]), min(options.grids)
    growth, kernels = (
        in_process(measure, size, grid, options.mode, iterations=options.iterations)
        for measure in ("growth", "kernels")
    )
    report = {
        "versions": growth["versions"],
        "cores": len(os.sched_getaffinity(0)),
        "load": [os.getloadavg()[0]],  # before the first case and after each
        "long_run": {"size": size, "vertices": grid**2, **judge_long_run(growth, kernels)},
        "cases": cases,
    }
    at_once = ThreadPoolExecutor(AT_ONCE if on_gpu(options.mode) else 1)
    measure_of_memory = lambda size, grid: {
        name: at_once.submit(memory_or_why, size, grid, options.mode, name)
        for name in names_for(options.mode)
    }
    asked = {}
    if on_gpu(options.mode):  # before any time is measured
        asked = {(s, g): measure_of_memory(s, g) for g in options.grids for s in options.sizes}
        for one in asked.values():
            wait(one.values())
    for grid in options.grids:
        for size in options.sizes:
            found = asked.get((size, grid)) or measure_of_memory(size, grid)
            memory = {name: one.result() for name, one in found.items()}
            for name in [name for name, one in memory.items() if isinstance(one, str)]:
                say_left_out(name, memory.pop(name))
            times = time_case(size, grid, options, list(memory))
            cases.append(summarise(size, grid, times, memory))
            report["load"].append(os.getloadavg()[0])
            report["seconds"] = time.perf_counter() - began
            write(report, options.out)
            print_likeness(cases[-1])
            path_replay = cases[-1]["contenders"].get("prb_projective")
            times_raster = f"{path_replay['ratio']:.1f} times" if path_replay else "no path replay"
            print(
                f"{report['seconds']:4.0f} s  {size}, {grid}x{grid} vertices: {times_raster}",
                file=sys.stderr,
            )
    print_table(cases)
    print_end(report, options.out)
    if on_gpu(options.mode):
        print(page_table(report))


if __name__ == "__main__":
    cli(main)
