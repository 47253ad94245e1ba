"""How long OneFit takes to drape: a frame, its parts, and the same garment at four resolutions.

    python benchmarks/onefit_speed.py [--weights NAME] [--device cuda]

Milliseconds a frame, the median of repeated drapes of a motion of 90 frames in batches, without
rendering: all of ``Draper.drape``; the patches' deformations; the network alone, which is these and
the vertices, without ease; and post-processing. All of them for the T-shirt at about 1,000, 4,000,
16,000 and 64,000 vertices; last, the flesh that yields before a simulation. Cutting a garment into
patches comes once and stands apart. The clock shows what else the machine does; the least of the
repetitions is given beside the median, and the processor's time, of all threads together.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch

import onefit
from onefit.body import skinning
from onefit.contact import ContactSettings, Flesh
from onefit.draping.draper import BATCH, FPS
from onefit.network import DEFAULT
from onefit.objective import posed
from polyfit.errors import cli

FRAMES = 90


def timed(function, device, repeats=9):
    """Median and least milliseconds of ``function()`` by the clock, and the median of the
    processor's.
    """
    found, busy = [], []
    for k in range(repeats + 2):
        start, used = time.perf_counter(), time.process_time()
        function()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        if k >= 2:
            found.append(1e3 * (time.perf_counter() - start))
            busy.append(1e3 * (time.process_time() - used))
    return statistics.median(found), min(found), statistics.median(busy)


def network_alone(draper, garment, motion, vertices=True):
    """What the network alone makes, without ease: the embedding of the motion, the deformation of
    every patch in every frame, and, with ``vertices``, all vertices (T, N, 3) [m] of the cloth in
    the world.
    """
    body, patched = draper.model.body().to(draper.device), draper.patched(garment)
    weights = garment.blend_weights.to(draper.device)
    rest = garment.vertices.to(draper.device)[:, None]
    found = []
    with torch.inference_mode():
        embedding = draper.embedding(motion, body)
        maps = skinning.transforms(body, motion.poses, motion.translation)
        for part, some in zip(embedding.split(BATCH), maps.split(BATCH)):
            changes = patched.changes(draper.network.decoder(draper.codes(garment), part))
            if vertices:
                moved = rest + patched.displacement(changes)
                found.append(posed(moved, weights, some).transpose(0, 1))
    return torch.cat(found) if vertices else None


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--counts", type=int, nargs="+", default=[1000, 4000, 16_000, 64_000])
    parser.add_argument("-o", "--output", help="a folder for onefit_speed.json")
    args = parser.parse_args(argv)
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import onefit"], check=True)
    seconds = time.perf_counter() - start
    print(
        f"{torch.get_num_threads()} threads, {args.device}; a process that imports onefit and ends:"
        f" {seconds:.2f} s\n"
    )
    draper = onefit.load(args.weights, device=args.device)
    motion = onefit.Motion.generate("walk", seconds=FRAMES / FPS, seed=1).to(draper.device)
    shirt = draper.garment("tshirt")
    print(
        "| vertices | patches | cut and eased, once [s] | drape [ms a frame] | patches alone |"
        " network alone | post-processing |\n|---|---|---|---|---|---|---|"
    )
    rows = []
    for count in args.counts:
        garment = shirt if count == len(shirt) else shirt.remeshed(count)
        start = time.perf_counter()
        patched = draper.patched(garment)
        draper.ease(garment)
        cut = time.perf_counter() - start
        T = len(motion.poses)
        whole = [x / T for x in timed(lambda: draper.drape(garment, motion), args.device)]
        deformation, network = (
            [
                x / T
                for x in timed(
                    lambda: network_alone(draper, garment, motion, vertices), args.device
                )
            ]
            for vertices in (False, True)
        )
        drape = draper.drape(garment, motion, post=False)
        process = draper.post_processing(garment, drape.rest, draper.standard)
        post = [
            x / T
            for x in timed(
                lambda: process(drape.vertices, drape.body, FPS),
                args.device,
                3,
            )
        ]
        cells = [f"{len(garment)}", f"{len(patched)}", f"{cut:.1f}"] + [
            f"{a:.2f} ({b:.2f}; {c:.2f})" for a, b, c in (whole, deformation, network, post)
        ]
        print("| " + " | ".join(cells) + " |", flush=True)
        rows.append(
            dict(
                vertices=len(garment),
                patches=len(patched),
                cut=cut,
                drape=whole,
                patches_alone=deformation,
                network=network,
                post=post,
            )
        )
    bodies = draper.drape(shirt, motion, skinning_only=True).body
    flesh = Flesh(draper.model.body(), ContactSettings().room)
    yielding = [x / len(bodies) for x in timed(lambda: flesh(bodies), "cpu", 3)]
    print("\nflesh, before a simulation: {:.2f} ({:.2f}; {:.2f})".format(*yielding))
    if args.output:
        found = dict(threads=torch.get_num_threads(), device=args.device, rows=rows, flesh=yielding)
        path = Path(args.output) / "onefit_speed.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    cli(main)
