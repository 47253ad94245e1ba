"""The parts of ``gpu.py``, each in a process of its own: ``gpu_parts.py PART ON SCRATCH ...``.

What a part finds goes, line by line, into the file that ``GPU_PART_TELLS`` names, so that a part
which ends its process has told what came before.
"""

import argparse
import contextlib
import json
import linecache
import os
import statistics
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter

import numpy as np

_EVERY = 0.004  # seconds between two looks at the stack
_STEP = 5e-5  # [m] of the central differences, a fraction of a texel
_APART = 0.15  # relative difference to them that is let pass: the texture is rough
_WAITS = ("np.array(", ".numpy(", "dr.sync", "dr.eval", "float(")
_TRACED = ("/drjit/", "/mitsuba/", "/render/", "images/pixels.py", "images/gather.py")


def tell(**entry):
    """Put down a check or figures; and show them."""
    print(entry.get("trace") or entry, flush=True)
    if path := os.environ.get("GPU_PART_TELLS"):
        with open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps(entry, default=float) + "\n")


class Wrong(Exception):
    """A check's result is not what it should be."""


@contextlib.contextmanager
def check(name):
    """A check: what is put into the list that it gives is told; an exception is a failure, after
    which the part goes on.
    """
    said, began = [], time.perf_counter()
    try:
        yield said
    except Exception as error:
        text = f"{type(error).__name__}: {error}".strip().splitlines()[0][:300]
        tell(check=name, ok=False, said=text, trace=traceback.format_exc())
    else:
        seconds = time.perf_counter() - began
        tell(check=name, ok=True, said=", ".join([*said, f"{seconds:.2f} s"]))


def near(found, wanted, tolerance=1e-6):
    """That numbers are those wanted, relative to the largest."""
    found, wanted = np.asarray(found, np.float64), np.asarray(wanted, np.float64)
    apart = np.abs(found - wanted).max() / max(np.abs(wanted).max(), 1e-30)
    if not apart <= tolerance:
        raise Wrong(f"relative difference {apart:.3g}, at most {tolerance:g} is right")
    return f"relative difference {apart:.1g}"


# ---- Dr.Jit without rays -------------------------------------------------------------------------


def arrays(on, scratch):
    """What the closed forms ask of a variant, without a ray: needs no OptiX."""
    with check("the variant, without a trial") as said:
        import mitsuba as mi

        mi.set_variant(on)
        said.append(mi.variant())
    import drjit as dr

    rng = np.random.default_rng(0)
    with check("sum of doubles") as said:
        x = rng.normal(size=100_000)
        said.append(near(np.array(dr.sum(mi.Float64(x)))[0], x.sum(), 1e-12))
    place = rng.integers(0, 1000, 100_000)
    for mode in ("Local", "Direct"):
        with check(f"atomic additions of doubles, {mode}") as said:
            total = dr.zeros(mi.Float64, 1000)
            at = mi.UInt32(place.astype(np.uint32))
            dr.scatter_add(total, mi.Float64(x), at, mode=getattr(dr.ReduceMode, mode))
            said.append(near(np.array(total), np.bincount(place, x, 1000), 1e-11))
    with check("atomic additions of signed numbers in UInt64, Local") as said:
        whole, total = rng.integers(-(2**40), 2**40, 100_000), dr.zeros(mi.UInt64, 1000)
        value = mi.UInt64(mi.Int64(whole))
        dr.scatter_add(total, value, at, mode=dr.ReduceMode.Local)
        wanted = np.zeros(1000, np.int64)
        np.add.at(wanted, place, whole)
        said.append(near(np.array(mi.Int64(total)), wanted, 0))
    with check("a recorded function with loops and scatters, launched again") as said:
        from polyfit.device import on_device
        from polysft_mi.images.gather import add
        from polysft_mi.images.pixels import packed
        from polysft_mi.render import frozen

        def sums(start, index, values):
            value = lambda k: [dr.gather(mi.Float64, values, 2 * k + c) for c in range(2)]
            found = add(start, index, value, 2)
            return packed(found, dr.arange(mi.UInt32, dr.width(start) - 1))

        recorded = frozen(sums)
        for most in (5, 5, 9, 2, 5):  # the lists' lengths change, not how many there are
            length = rng.integers(0, most, 1000)
            start = np.concatenate([[0], np.cumsum(length)])
            index, values = rng.integers(0, 500, start[-1]), rng.normal(size=(500, 2))
            found = recorded(
                on_device(start, mi.UInt32),
                on_device(index, mi.UInt32),
                on_device(values, mi.Float64),
            )
            wanted = np.zeros((1000, 2))
            np.add.at(wanted, np.repeat(np.arange(1000), length), values[index])
            said[:] = [near(np.array(found).reshape(-1, 2), wanted, 1e-12)]
    with check("a derivative inside a recording") as said:

        def slope(x):
            with dr.resume_grad():
                dr.enable_grad(x)
                dr.backward(dr.sin(x) * x)
                return dr.grad(x)

        recorded = frozen(slope)
        for count in (500, 500, 900):
            x = rng.normal(size=count).astype(np.float32)
            with dr.suspend_grad():
                found = np.array(recorded(mi.Float(x)))
            said[:] = [near(found, np.cos(x) * x + np.sin(x), 1e-5)]
    with check("texture") as said:
        values = rng.random((16, 16, 3)).astype(np.float32)
        texture = mi.Texture2f(mi.TensorXf(values))
        centre = (np.arange(16, dtype=np.float32) + 0.5) / 16
        y, x = np.meshgrid(centre, centre, indexing="ij")
        found = texture.eval(mi.Point2f(x.ravel(), y.ravel()))
        said.append(near(np.array(found).reshape(3, -1).T, values.reshape(-1, 3), 1e-2))


# ---- the renderer and the closed forms -----------------------------------------------------------


def forms(on, scratch):
    """The demo's surface: pictures, gradients, normal equations; kept for the other variant."""
    kept = {}
    try:
        _forms(on, kept)
    finally:
        np.savez(os.path.join(scratch, f"forms-{on}.npz"), **kept)


def _forms(on, kept):
    with check("the variant") as said:
        from polyfit.backend import set_variant

        said.append(set_variant(on))
    import drjit as dr
    import mitsuba as mi
    from sequences import scene_of

    from polysft_mi.objective import Problem
    from polysft_mi.scene import experiment as scenes

    with check("a scene and its rays"):
        experiment = scenes.load(scene_of("demo"), {})
        problem = Problem(experiment, experiment.sequence())
        problem.check_start()
    params = mi.traverse(experiment.scene)
    key = next(k for k in params.keys() if k.endswith("vertex_positions"))
    rest = np.array(params[key]).reshape(-1, 3).astype(np.float64)
    raster = mi.load_dict({"type": "raster"})

    def image(vertices, integrator=raster, attached=False):
        positions = mi.Float(np.ascontiguousarray(vertices, np.float32).ravel())
        if attached:
            dr.enable_grad(positions)
        params[key] = positions
        params.update()
        return positions, integrator.render(experiment.scene, 0)

    with check("raster: a picture") as said:
        kept["picture"] = np.array(image(rest)[1])
        said.append(f"mean alpha {kept['picture'][..., 3].mean():.4f}")
    target = mi.Float(np.array(image(rest + [0.01, 0.004, 0.02])[1]).ravel())

    def loss(vertices):
        with dr.suspend_grad():
            return float(dr.sum(mi.Float64(dr.square(image(vertices)[1].array - target)))[0])

    with check("raster: its gradient"):
        positions, shown = image(rest, attached=True)
        dr.backward(dr.sum(dr.square(shown.array - target)))
        kept["gradient"] = np.array(dr.grad(positions)).reshape(-1, 3).astype(np.float64)
    x, y, _ = (rest - rest.mean(0)).T
    shape = np.zeros_like(rest)
    shape[:, 2] = np.sin(8 * x) * np.cos(6 * y)
    directions = {axis: np.eye(3)[[k]] + 0 * rest for k, axis in enumerate("xyz")}
    for name, direction in {**directions, "bend": shape}.items():
        with check(f"raster: gradient along {name}, against finite differences") as said:
            slope = float((kept["gradient"] * direction).sum())
            ends = [loss(rest + sign * _STEP * direction) for sign in (1, -1)]
            difference = (ends[0] - ends[1]) / (2 * _STEP)
            said.append(f"{slope:.5g}, {difference:.5g}")
            near(slope, difference, _APART)
    for name, options in {
        "aovs": {"aovs": "depth,normal,uv,triangle"},
        "lit by the scene's emitters": {"shading": "bsdf"},
        "4 samples a pixel": {},
    }.items():
        with check(f"raster: {name}"):
            integrator = mi.load_dict({"type": "raster", **options})
            samples = 4 if name.startswith("4") else 1
            kept[name] = np.array(integrator.render(experiment.scene, 0, spp=samples))
            if not np.isfinite(kept[name][..., :4]).all():
                raise Wrong("not finite")
    with check("path replay through mi.render: picture and gradient") as said:
        integrator = mi.load_dict({"type": "prb_projective", "max_depth": 2, "sppi": 0})
        positions = mi.Float(rest.astype(np.float32).ravel())
        dr.enable_grad(positions)
        params[key] = positions
        params.update()
        shown = mi.render(experiment.scene, params, integrator=integrator, spp=16, seed=1)
        dr.backward(dr.mean(dr.square(shown.array)))
        gradient = np.array(dr.grad(positions))
        if not (np.isfinite(gradient).all() and gradient.any()):
            raise Wrong("gradient zero or not finite")
        said.append(f"mean colour {np.array(shown)[..., :3].mean():.4f}")
    _closed_forms(problem, kept)
    with check("the stage of OneFit's videos"):
        from polyfit.pictures import stage

        mesh = rest[None] - rest.mean(0), problem.template.faces, (0.5, 0.3, 0.2)
        if len(rest) != len(problem.template.vertices):
            raise Wrong("the demo's texture has seams")
        kept["stage"] = next(stage.render([mesh], size=(96, 128), spp=4))


def _closed_forms(problem, kept):
    import drjit as dr

    from polysft_mi.objective import FrameContext, FrameMemory, Objective
    from polysft_mi.surface import Unknowns

    with check("the objective: set up"):
        objective = Objective(problem)
        images, atlas = objective.data, objective.atlas
    with dr.suspend_grad():
        rest = atlas.state(problem.patch.rest().to_numpy())
        rest.translation += 0.003
        surface = atlas.surface(rest)
        with check("images against a surface: the same bits each time, launched again") as said:
            runs = []
            for _ in range(4):
                images._last = None
                found = images.evaluate(surface.vertices, 1, 1.0, 0.3)
                runs.append(np.concatenate([np.array(found.images.gradient), [found.photometric]]))
            kept["images: gradient"], kept["images: curvature"] = (
                np.array(x) for x in (found.images.gradient, found.images.second)
            )
            kept["images: energies"] = np.array([found.photometric, found.silhouette])
            said.append(f"energies {found.photometric:.6g}, {found.silhouette:.6g}")
            if not all(np.array_equal(runs[0], r) for r in runs):
                apart = max(np.abs(r - runs[0]).max() for r in runs)
                raise Wrong(f"runs differ by {apart:.3g} of {np.abs(runs[0]).max():.3g}")
    context = FrameContext(1, rest, FrameMemory(0.05))
    frozen = objective.frozen([context], objective.usual[-1], [rest])
    with check("normal equations") as said:
        (model,) = frozen.quadratic([rest])
        said.append(f"total {model.total:.6g}")
        for name in ("local", "cross", "glob", "local_gradient", "gradient"):
            kept[f"normal equations: {name}"] = getattr(model.normal, name)
    with check("the same objective by automatic differentiation") as said:
        unknowns = Unknowns.from_numpy(atlas.arrays(rest))
        dr.enable_grad(unknowns)
        total, _ = frozen.evaluate([unknowns], backward=True)
        said.append(f"total {total:.6g}")
        kept["automatic differentiation: total"] = np.array([total])
        kept["automatic differentiation: slope"] = np.array(dr.grad(unknowns.translation))
        if not np.isfinite(kept["automatic differentiation: slope"]).all():
            raise Wrong("gradient not finite")


# ---- the tracker ---------------------------------------------------------------------------------


class Sampler:
    """Looks at the main thread's stack again and again: the seconds since the last look go to what
    stands there.
    """

    def __init__(self):
        self.kinds, self.places, self._stop = Counter(), Counter(), threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self):
        self._of = threading.get_ident()
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()

    def _look(self):
        last = time.perf_counter()
        while not self._stop.wait(_EVERY):
            frame, now = sys._current_frames().get(self._of), time.perf_counter()
            stack = []
            while frame is not None:
                stack.append((frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_name))
                frame = frame.f_back
            kind, place = classified(stack)
            self.kinds[kind] += now - last
            self.places[place] += now - last
            last = now


def classified(stack):
    """What a stack, (file, line, function) from the innermost on, is at: a kind, and the place in
    this project.
    """
    own = next((s for s in stack if "/polysft_mi/" in s[0] or "/polyfit/" in s[0]), stack[0])
    place = f"{os.path.basename(os.path.dirname(own[0]))}/{os.path.basename(own[0])}: {own[2]}"
    line = linecache.getline(own[0], own[1])
    if any("/solvers/linear/" in s[0] for s in stack):
        return "linear algebra of the host", place
    if own[0].endswith("render/device.py"):
        return "recorded functions", place
    if own[0].endswith("polyfit/device.py"):
        return "copies, and waiting for the device", place
    if own[0] != stack[0][0] and any(x in stack[0][0] for x in ("/drjit/", "/mitsuba/")):
        return "tracing", place
    if "scipy" not in stack[0][0] and any(x in line for x in _WAITS):
        return "copies, and waiting for the device", place
    if any(x in own[0] for x in _TRACED):
        return "tracing", place
    if own[0].endswith("objective/quadratic.py"):
        return "assembly of the host", place
    return "other work of the host", place


def track(on, scratch, scene, define, frames, history=""):
    """Track a sequence, without pictures; with ``history`` each kernel is timed by Dr.Jit."""
    from polyfit.backend import set_variant

    began = time.perf_counter()
    set_variant(on)
    import drjit as dr

    from polysft_mi import tracker
    from polysft_mi.objective import Problem
    from polysft_mi.render import threads
    from polysft_mi.results.evaluation import score
    from polysft_mi.scene import experiment as scenes

    overrides = dict([define.split("=", 1)] if define else [], last=int(frames) - 1)
    experiment = scenes.load(scene, overrides)
    sequence = experiment.sequence()
    problem = Problem(experiment, sequence)
    problem.check_start()
    frames_of, ends, surfaces = tracker.FrameTracker(problem), [], []
    kernels = Counter()
    if history:
        dr.set_flag(dr.JitFlag.KernelHistory, True)
        dr.kernel_history_clear()

    def solved(k, vertices):
        ends.append(time.perf_counter())
        surfaces.append(vertices)
        for entry in dr.kernel_history() if history else ():
            if k > 0:  # the first frame compiles
                kind = str(entry["type"]).rpartition(".")[2]
                kernels[f"{kind}: seconds"] += 1e-3 * entry["execution_time"]
                kernels[f"{kind}: launches"] += 1

    started = time.perf_counter()
    tell(**{"start [s]": started - began})
    share = threads(0.5) if frames_of.solver.name == "gauss-newton" else None
    with (
        Sampler() as sampler,
        share or contextlib.nullcontext(),
        tempfile.TemporaryDirectory() as out,
    ):
        done = tracker.track(frames_of, len(sequence.indices), out, solved=solved)
    seconds = np.diff([started, *ends])
    tell(
        **{
            "first frame [s]": seconds[0],
            "a later frame [s]": float(np.mean(seconds[1:])),
            "a later frame, median [s]": float(np.median(seconds[1:])),
            "iterations a frame": float(np.mean(done.iterations)),
            "frames lost": len(done.lost),
        }
    )
    whole = sum(sampler.kinds.values())
    tell(**{f"share: {k}": v / whole for k, v in sampler.kinds.most_common()})
    for place, spent in sampler.places.most_common(25):
        print(f"{spent:8.2f} s  {place}")
    if history:
        later = float(seconds[1:].sum())
        tell(**{f"later frames: {k}": v for k, v in kernels.items()}, **{"later frames [s]": later})
    folder = overrides.get("data") or os.path.join(os.path.dirname(scene), "demo")
    if os.path.exists(os.path.join(folder, "gt.npz")):
        surface = {
            "vertices": problem.camera.to_camera(np.stack(surfaces)),
            "faces": problem.template.faces,
            "frames": np.asarray(sequence.indices),
        }
        found = score(surface, folder)
        tell(**{k: found[k] for k in ("rmse_mm", "e3d", "en_deg") if k in found})


# ---- OneFit --------------------------------------------------------------------------------------


def drape(on, scratch):
    """A T-shirt in a walk of 3 seconds, and the network alone."""
    import torch
    from onefit_speed import FPS, FRAMES, network_alone, timed

    import onefit

    draper = onefit.load(device=on)
    motion = onefit.Motion.generate("walk", seconds=FRAMES / FPS, seed=1).to(draper.device)
    shirt = draper.garment("tshirt")
    for name, function in {
        "the network alone [ms a frame]": lambda: network_alone(draper, shirt, motion),
        "without post-processing [ms a frame]": lambda: draper.drape(shirt, motion, post=False),
        "drape [ms a frame]": lambda: draper.drape(shirt, motion),
    }.items():
        with check(name):
            tell(**{name: timed(function, on, 3)[0] / FRAMES})
    with check("the same drape as on the CPU") as said, torch.inference_mode():
        other = onefit.load(device="cpu").drape(shirt, motion.to("cpu"), post=False).vertices
        own = draper.drape(shirt, motion, post=False).vertices.cpu()
        apart = float((own - other).norm(dim=-1).max())
        said.append(f"vertices within {1e3 * apart:.3g} mm")
        if not apart < 1e-3:
            raise Wrong(said[0])


def train(on, scratch):
    """Steps of OneFit's training on one garment."""
    from onefit import train as command
    from onefit.training.loop import OneFitTraining

    seconds, update = [], OneFitTraining.update

    def timed(self):
        began = time.perf_counter()
        found = update(self)  # its figures are numbers of the host: it has waited for the device
        seconds.append(time.perf_counter() - began)
        return found

    OneFitTraining.update = timed
    out = os.path.join(scratch, f"train-{on}")
    words = "--epochs 1 --epoch-steps 12 --seeds 1 --shapes 4 --batch 20000".split()
    command.main(["tshirt", "-o", out, "--device", on, *words])
    tell(**{"step [s]": statistics.median(seconds[2:]), "first step [s]": seconds[0]})


PARTS = {f.__name__: f for f in (arrays, forms, track, drape, train)}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    PARTS[options.part](*options.arguments)
