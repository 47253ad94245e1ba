"""Adam with the paper's step sizes (section "Experiments", PolySfT). Import only after a Mitsuba
variant is set.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import mitsuba as mi

from polysft_mi.errors import InputError
from polysft_mi.render import interruptible
from polysft_mi.surface import Unknowns

from .solver import Result

if TYPE_CHECKING:
    from polysft_mi.scene import Settings

_SEED_STEP = 7919  # between iterations: path replay's noise is another each time


class Adam:
    """First-order descent on gradients through Mitsuba's renderer, until it stops improving.

    ``patience`` iterations without a new minimum, or ``period`` iterations, end it (supplement,
    "Adaptive Window Optimization"). The best unknowns seen are kept. Moments start at zero each
    time, so that a window depends on nothing but its start.
    """

    name = "adam"

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def check(self, objective):
        """Raise InputError where the renderer gives no gradients."""
        name = objective.problem.experiment.renderer.class_name()
        try:
            with interruptible():
                objective.check_gradient()
        except FloatingPointError:
            pass  # the image is to blame, which the tracker tells
        except RuntimeError as error:
            cause = str(error).strip().splitlines()[0][:120]
            raise InputError(
                f"{objective.problem.experiment.path}: integrator {name} gives no gradients;"
                f" raster or prb_projective is needed ({cause})"
            ) from None

    def minimise(self, objective, start, *, iterations=None, report=None):
        """As :meth:`polysft_mi.solvers.Solver.minimise` says."""
        s, atlas, count = self.settings, objective.atlas, len(start)
        steps = {
            "delta_alpha": s.lr_alpha,
            "delta_u": s.lr_uv,
            "delta_v": s.lr_uv,
            "rotation": s.lr_rigid,
            "translation": s.lr_rigid,
        }
        if objective.d == 3:
            steps["delta_w"] = s.lr_uv
        window = [Unknowns.from_numpy(atlas.arrays(state)) for state in start]
        optimizer = mi.ad.Adam(lr=s.lr_uv)
        for k, unknowns in enumerate(window):
            for name in steps:
                optimizer[f"{k}.{name}"] = mi.Float(getattr(unknowns, name))
        optimizer.set_learning_rate(
            {f"{k}.{name}": steps[name] for k in range(count) for name in steps}
        )

        best, best_total, best_terms, since, iteration = list(window), math.inf, {}, 0, 0
        period = min(s.period, iterations or s.period)
        while True:
            current = [
                dataclasses.replace(unknowns, **{n: optimizer[f"{k}.{n}"] for n in steps})
                for k, unknowns in enumerate(window)
            ]
            seed = (s.seed + _SEED_STEP * iteration) % 2**31
            total, terms = objective.evaluate(current, backward=True, seed=seed)
            if total < best_total:
                best, best_total, best_terms, since = [w.copy() for w in current], total, terms, 0
            else:
                since += 1
            if report:
                report(iteration, total, terms)
            iteration += 1
            if since >= s.patience or iteration >= period:
                states = [atlas.state(unknowns.to_numpy()) for unknowns in best]
                return Result(states, best_total, best_terms, iteration)
            optimizer.step()
