"""``python benchmarks/iteration.py [scene.xml]``: the parts of an iteration of the tracker, in
milliseconds, and what the one whose kernels are recorded (``dr.freeze``) would take if they were
traced anew each time, in turns.

The template as the scene has it, moved a little, in the video's second frame, at the last stage.
Each time is a median.
"""

import argparse
import os
import time

import numpy as np
from sequences import SCENES

from polysft_mi.commands import add_define_argument, definitions
from polysft_mi.errors import cli


def main(arguments=None):
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("scene", nargs="?", default=os.path.join(SCENES, "demo.xml"))
    add_define_argument(p)
    p.add_argument("--turns", type=int, default=30)
    options = p.parse_args(arguments)

    from polyfit.backend import set_variant

    set_variant()
    rows = measured(options.scene, definitions(options.define), options.turns)
    print("| part | milliseconds |\n|---|---|")
    for name, milliseconds in rows.items():
        print(f"| {name} | {milliseconds:.2f} |")
    return rows


def measured(path, overrides, turns):
    """{part: milliseconds}."""
    import drjit as dr
    import mitsuba as mi
    from threadpoolctl import threadpool_limits

    from polysft_mi.objective import Objective, Problem
    from polysft_mi.objective.quadratic import Assembly, EdgeRows
    from polysft_mi.scene import experiment as scene
    from polysft_mi.solvers.linear import Reduced

    experiment = scene.load(path, {**overrides, "solver": "gauss-newton"})
    problem = Problem(experiment, experiment.sequence())
    objective = Objective(problem)
    atlas, images = objective.atlas, objective.data
    level = images.level(objective.usual[-1].blur)
    d, patterns = 3 if objective.has_relief else 2, objective.inputs.operators.patterns
    rest = atlas.state(problem.patch.rest().to_numpy())
    rest.translation += 0.005
    surface = atlas.surface(rest)
    vertices, at = surface.vertices, images._frames.level(1, level)
    with dr.suspend_grad():
        view = images.view(vertices, level)
        given = (
            *images._residual_arguments(view, 1, level, images.appearance(vertices, level)),
            dr.opaque(mi.Float, 0.3),
        )
        table, figures = images._sums(*given)
        outline = None
        if at.mask is not None:
            crossings = images._raster.crossings(view, outline=True)
            outline = view.seen(), crossings, at.mask, at.distance, images._corner_of
        pairs = images._outline(*outline)[1] if outline else None
        sums = table, figures, vertices, 1.0, 1.0, at.area, level.stride, pairs
        gathered = [(images.gather.images(*sums), images.gather.camera)]
        assembly = Assembly(images.pattern, images.gather, atlas)
        edges = EdgeRows(np.ones(len(problem.template.edges)), 1.0)
        normal, _ = assembly.normal(surface, gathered, edges, None, patterns[d], d)
        reduced = Reduced.of(patterns, normal, 1e-3, np.float32)
    recorded = assembly._in_unknowns

    def look():
        images._last = None
        images.view(vertices, level)

    def traced():
        assembly._in_unknowns = recorded.__wrapped__
        equations()
        assembly._in_unknowns = recorded

    def equations():
        return assembly.normal(surface, gathered, edges, None, patterns[d], d)

    def silhouette():
        if outline:
            images._raster.crossings(view, outline=True)
            dr.eval(images._outline(*outline))

    parts = {
        "surface of the unknowns": lambda: atlas.surface(rest),
        "visibility: the mesh put into the scene, a ray a pixel": look,
        "residuals, derivatives, sums over triangles": lambda: dr.eval(images._sums(*given)),
        "silhouette": silhouette,
        "sums at the vertices": lambda: dr.eval(images.gather.images(*sums)),
        "normal equations": equations,
        "normal equations, traced": traced,
        "elimination": lambda: Reduced.of(patterns, normal, 1e-3, np.float32),
        "step": reduced.step,
    }
    times = {name: [] for name in parts}
    with dr.suspend_grad(), threadpool_limits(limits=1, user_api="blas"):  # as the tracker does
        for turn in range(turns + 3):
            for name, run in parts.items():
                dr.sync_thread()
                began = time.perf_counter()
                run()
                dr.sync_thread()
                if turn >= 3:  # the first compile kernels
                    times[name].append(1e3 * (time.perf_counter() - began))
    return {name: float(np.median(x)) for name, x in times.items()}


if __name__ == "__main__":
    cli(main)
