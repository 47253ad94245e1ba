"""Adam with the paper's step sizes (section "Experiments", PolySfT). Import only after a Mitsuba
variant is set.
"""

import dataclasses
import math

import mitsuba as mi

from polysft_mi.errors import InputError

from .solution import Solution


class Adam:
    """First-order descent on the objective of a window, until it stops improving.

    ``patience`` iterations without a new minimum, or ``period`` iterations, end it (supplement,
    "Adaptive Window Optimization"). The best unknowns seen are kept. Moments start at zero in every
    window, so that a window depends on nothing but its start.
    """

    def __init__(self, settings):
        if settings.sweeps > 0:
            raise InputError(
                f"setting sweeps = {settings.sweeps} with solver = adam; sweeps = 0, or solver ="
                " gauss-newton, is needed"
            )
        self.settings = settings

    def solve(self, problem, window, frames, report=None, past=()):
        """Minimise ``problem`` over ``window`` (list of Unknowns) for ``frames``: a
        :class:`Solution`; ``past`` is not used.

        ``report(iteration, total, terms)`` is called after each evaluation. BadFrame passes
        through.
        """
        s = self.settings
        optimizer = mi.ad.Adam(lr=s.lr_uv)
        steps = {
            "delta_alpha": s.lr_alpha,
            "delta_u": s.lr_uv,
            "delta_v": s.lr_uv,
            "rotation": s.lr_rigid,
            "translation": s.lr_rigid,
        }
        for k, unknowns in enumerate(window):
            for name in steps:  # the paper has no relief: it stays as it is
                optimizer[f"{k}.{name}"] = mi.Float(getattr(unknowns, name))
        optimizer.set_learning_rate(
            {f"{k}.{name}": steps[name] for k in range(len(window)) for name in steps}
        )

        best, best_total, best_terms, since, iteration = (
            [w.copy() for w in window],
            math.inf,
            {},
            0,
            0,
        )
        while True:
            current = [
                dataclasses.replace(unknowns, **{n: optimizer[f"{k}.{n}"] for n in steps})
                for k, unknowns in enumerate(window)
            ]
            total, terms = problem.evaluate(
                current, frames, backward=True, seed=(s.seed + 7919 * iteration) % 2**31
            )
            if total < best_total:
                best, best_total, best_terms, since = [w.copy() for w in current], total, terms, 0
            else:
                since += 1
            if report:
                report(iteration, total, terms)
            iteration += 1
            if since >= s.patience or iteration >= s.period:
                return Solution(best, best_total, best_terms, iteration)
            optimizer.step()
