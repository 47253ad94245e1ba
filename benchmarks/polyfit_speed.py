"""How long PolyFit takes: batches of patches, and a whole mesh.

    python benchmarks/polyfit_speed.py [--threads 2] [--device cuda]

Batches of 512 patches of 256 points by jets of order 4, milliseconds a patch: the fit alone, the
PCA frame and the fit, and both with the spatial transformer; forward, and forward and backward.
Then a mesh of 100,000 vertices cut into 400 patches, fitted, its boundaries moved. The median of
repeated runs by the clock, and the least processor time (which a busy machine disturbs less); the
peak of the process's memory (of the device's, on a GPU) is that after all of them.
"""

import argparse
import json
import os
import resource
import statistics
import time
from pathlib import Path

import numpy as np

from polyfit import errors

BATCH, POINTS, ORDER = 512, 256, 4
MESH, PATCHES = (317, 317), 400


def timed(function, device, repeats=30):
    """Median milliseconds of ``function()`` by the clock, and the least milliseconds of processor
    time (of all threads).
    """
    import torch

    wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    found = []
    for k in range(repeats + 5):
        start = time.perf_counter(), time.process_time()
        function()
        wait()
        if k >= 5:
            found.append(
                (1e3 * (time.perf_counter() - start[0]), 1e3 * (time.process_time() - start[1]))
            )
    return statistics.median(wall for wall, _ in found), min(cpu for _, cpu in found)


def batches(device):
    """Name to milliseconds a patch."""
    import torch

    from polyfit import CanonicalFrame, jets
    from polyfit.network import PolyFit, SpatialTransformer

    generator = torch.Generator().manual_seed(0)
    uv = 2 * torch.rand(BATCH, POINTS, 2, generator=generator) - 1
    alpha = 0.3 * torch.randn(BATCH, jets.size_of(ORDER), generator=generator)
    x = (0.7 * jets.point(alpha, uv)).to(device)
    model = PolyFit(ORDER, SpatialTransformer()).to(device)
    frame = CanonicalFrame.from_points(x)
    chart = frame.to_chart(x)

    def pca():
        frame = CanonicalFrame.from_points(x)
        return jets.fit(frame.to_chart(x), ORDER).alpha

    def backward(function):
        function().square().sum().backward()

    leaf = chart.clone().requires_grad_()
    with torch.no_grad():
        forward = {
            "fit": timed(lambda: jets.fit(chart, ORDER), device),
            "PCA frame, fit": timed(pca, device),
            "PCA frame, transformer, fit": timed(lambda: model(x), device),
        }
    forward["fit, with backward"] = timed(
        lambda: backward(lambda: jets.fit(leaf, ORDER).alpha), device
    )
    forward["PCA frame, transformer, fit, with backward"] = timed(
        lambda: backward(lambda: model(x).jet.alpha), device
    )
    return {name: [ms / BATCH for ms in found] for name, found in forward.items()}


def bumpy_tube():
    """A closed band of 100,489 vertices (N, 3) [m] and its faces, 0.7 m long, with waves of two
    sizes.
    """
    n, m = MESH
    a, z = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.linspace(-0.35, 0.35, m), indexing="ij")
    r = 0.15 + 0.01 * np.sin(5 * a + 8 * z) + 0.004 * np.sin(60 * z)
    V = np.stack([r * np.cos(a), r * np.sin(a), z], -1).reshape(-1, 3)
    i = np.arange(n * m).reshape(n, m)
    j = np.roll(i, -1, axis=0)
    p, q, s, t = i[:, :-1].ravel(), j[:, :-1].ravel(), i[:, 1:].ravel(), j[:, 1:].ravel()
    return V, np.concatenate([np.stack([p, q, s], 1), np.stack([q, t, s], 1)])


def whole_mesh(device):
    from polyfit import PatchedSurface, Patches

    V, F = bumpy_tube()
    PatchedSurface.from_mesh(
        V[: 40 * MESH[1]], F[(40 * MESH[1] > F).all(1)], 20
    )  # everything is imported and warm
    steps, clocks = (
        {"cut": lambda: Patches.cut(V, F, PATCHES)},
        (time.perf_counter, time.process_time),
    )
    patches = steps["cut"]()
    steps["fit"] = lambda: PatchedSurface.fit(patches, ORDER, device=device)
    steps["cut, fit, moved boundaries"] = lambda: PatchedSurface.from_mesh(
        V, F, PATCHES, ORDER, device=device
    )
    found = {}
    for name, step in steps.items():
        start = [clock() for clock in clocks]
        step()
        found[name] = [clock() - since for clock, since in zip(clocks, start)]
    return found


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("-o", "--output", default="out/benchmarks")
    args = parser.parse_args(argv)
    import torch

    torch.set_num_threads(args.threads)
    on = f"{args.device}, {args.threads} threads, load {os.getloadavg()[0]:.1f}"
    print(f"torch {torch.__version__} on {on}")
    report = {"on": on, "ms_a_patch": batches(args.device), "seconds": whole_mesh(args.device)}
    for name, (wall, cpu) in report["ms_a_patch"].items():
        print(f"{name:>44}: {wall:.4f} ms a patch; processor time {cpu:.4f} ms")
    for name, (wall, cpu) in report["seconds"].items():
        print(f"{name:>44}: {wall:.2f} s a mesh; processor time {cpu:.2f} s")
    report["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if args.device.startswith("cuda"):
        report["peak_device_mb"] = torch.cuda.max_memory_allocated() / 2**20
    print({k: round(v) for k, v in report.items() if k.startswith("peak")})
    Path(args.output).mkdir(parents=True, exist_ok=True)
    path = Path(args.output) / "polyfit_speed.json"
    path.write_text(json.dumps(report, indent=1))
    print(f"written: {path}")


if __name__ == "__main__":
    errors.cli(main)
