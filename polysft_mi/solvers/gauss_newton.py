"""Gauss-Newton curvatures, damped after Levenberg and Marquardt. Import only after a Mitsuba
variant is set.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve

from polysft_mi.errors import InputError
from polysft_mi.objective import jet_unknowns

from .linear import Reduced
from .solver import Result

if TYPE_CHECKING:
    from polysft_mi.scene import Rules

_FARTHEST_STEP = 2.0  # rotation [rad], translation and displacements [of the template's scale]
_LEAST_DAMPING, _RAISED_DAMPING = 1e-7, 1e-4
_BODILY_GAIN = 1e-6  # share that a step of a pose alone must promise, in place of ``gain``


class GaussNewton:
    """Levenberg-Marquardt on the quadratic models of an objective. A frame's vertices are
    eliminated first; what is left is dense and, in a window, coupled from frame to frame.
    """

    name = "gauss-newton"

    def __init__(self, rules: Rules) -> None:
        self.rules = rules

    def check(self, objective):
        """Raise InputError where a term has no quadratic model."""
        if reason := objective.without_block:
            raise InputError(
                f"{objective.problem.experiment.path}: solver gauss-newton needs a quadratic model"
                f" of each term, and {reason}, or solver = adam"
            )

    def minimise(self, objective, start, *, iterations=None, report=None):
        """As :meth:`polysft_mi.solvers.Solver.minimise` says. A step is kept where it lowers the
        objective; one that promises little, of a pose alone next to nothing, is taken unseen, and
        ends it.
        """
        states, count = list(start), 0

        def evaluate(at):
            nonlocal count
            models = objective.quadratic(at)
            if report:
                report(count, _mean(m.total for m in models), _terms(models))
            count += 1
            return models, sum(m.total for m in models)

        models, total = evaluate(states)
        least = _BODILY_GAIN if objective.stage.bodily else self.rules.gain
        damping = self.rules.damping[objective.d - 2]
        for _ in range(iterations or objective.stage.iterations):
            try:
                steps, promised = self._steps(objective, models, damping)
            except LinAlgError:
                damping = max(10 * damping, _RAISED_DAMPING)
                continue
            trial = [state.after_step(step) for state, step in zip(states, steps, strict=True)]
            if promised < least * sum(m.measure for m in models):
                states = trial
                break
            found, now = evaluate(trial)
            if now < total:
                if total - now > 0.5 * promised:
                    damping = max(damping / 5, _LEAST_DAMPING)
                states, models, total = trial, found, now
            else:
                damping *= 10
        return Result(states, _mean(m.total for m in models), _terms(models), count, models)

    def _steps(self, objective, models, damping):
        """The steps of all frames, and the decrease that they promise. Raises LinAlgError where the
        equations are singular, or a step is too long.
        """
        if objective.stage.bodily:
            return _bodily(models, damping)
        # single precision will do for a step, which is tried and then kept or not
        patterns = objective.objective.inputs.operators.patterns
        reduced = [Reduced.of(patterns, m.normal, damping, np.float32) for m in models]
        start = np.cumsum([0] + [len(r.right) for r in reduced])
        matrix = block_diag(*(r.schur for r in reduced))
        if len(models) > 1:  # a block-banded system
            jets, coupling = jet_unknowns(models[0].state), objective.coupling
            for a, b in itertools.pairwise(start[:-1]):
                matrix[np.ix_(a + jets, b + jets)] -= coupling
                matrix[np.ix_(b + jets, a + jets)] -= coupling
        right = np.concatenate([r.right for r in reduced])
        g = -cho_solve(cho_factor(matrix, check_finite=False), right, check_finite=False)
        parts = np.split(g, start[1:-1])
        steps = [(part, r.following(part)) for part, r in zip(parts, reduced, strict=True)]
        for step in steps:
            check_step(step, models[0].state.alpha.shape)
        return steps, sum(r.promised(part) for r, part in zip(reduced, parts, strict=True))


def _bodily(models, damping):
    """As :meth:`GaussNewton._steps`, of the bodies' poses alone."""
    steps, promised = [], 0.0
    for model in models:
        normal, count = model.normal, model.surface.by_pose.shape[2]
        form, pull = normal.glob[-count:, -count:], normal.gradient[-count:]
        form = form + damping * np.diag(np.diag(form))
        g = np.zeros(len(normal.gradient))
        g[-count:] = -cho_solve(cho_factor(form), pull)
        steps.append((g, np.zeros_like(normal.local_gradient)))
        promised -= 0.5 * float(g[-count:] @ pull)
    return steps, promised


def check_step(step, shape):
    """Raise LinAlgError where a step (global (G,), local (N, d)) is not finite, or goes farther
    than any model is good for; ``shape``: (K, A), patches and coefficients of each.
    """
    (g, local), (patches, size) = step, shape
    jets, pose = np.split(g, [patches * (size + 6)])
    motion = jets.reshape(patches, -1)[:, -6:]
    if not all(np.abs(x).max(initial=0) < _FARTHEST_STEP for x in (motion, local, pose)):
        raise LinAlgError("the step is not finite, or too long")


def _mean(values):
    return float(np.mean(list(values)))


def _terms(models):
    """The mean of the frames' terms."""
    return {name: _mean(m.terms[name] for m in models) for name in models[0].terms}
