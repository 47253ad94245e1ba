"""Levenberg-Marquardt for one frame, stage after stage, from one start."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError

from polysft_mi.objective import Model, SecondOrder, stages_of
from polysft_mi.solvers.linear import Blocks, Reduced
from polysft_mi.surface import State

_FARTHEST_STEP = 2.0  # rotation [rad], translation and displacements [of the template's scale]
_LEAST_DAMPING, _RAISED_DAMPING = 1e-7, 1e-4


@dataclass(frozen=True)
class Found:
    """Where a descent ended: the ``state``, the last ``model`` on the way (one small step before
    it at most), the robust ``scales`` by stage that fit the residuals there, and whether more
    iterations gain nothing.
    """

    state: State
    model: Model
    scales: dict
    more_is_vain: bool = False

    @property
    def misfit(self):
        return self.model.evaluation.misfit

    @property
    def cost(self):
        return self.model.cost


def check_step(step, patches):
    """Raise LinAlgError where a step (global (G,), local (N, d)) of so many ``patches`` is not
    finite, or goes farther than any model is good for.
    """
    g, local = step
    motion = g.reshape(patches, -1)[:, -6:]
    if not max(np.abs(motion).max(), np.abs(local).max()) < _FARTHEST_STEP:
        raise LinAlgError("the step is not finite, or too long")


class Descent:
    """Minimises ``objective`` (a :class:`polysft_mi.objective.second_order.SecondOrder`) for one
    frame. ``report(iteration, total, terms)`` is called after each evaluation; ``count``: how many
    there were.
    """

    def __init__(self, objective: SecondOrder):
        self.objective, self.rules = objective, objective.rules
        self.far, self.usual = stages_of(objective.rules)
        self._blocks = {d: Blocks(pattern, d) for d, pattern in objective.patterns.items()}
        self.report, self.count = None, 0

    def reduced(self, normal, damping, dtype=np.float64):
        """The :class:`polysft_mi.solvers.linear.Reduced` of normal equations."""
        return Reduced(self._blocks[normal.local.shape[-1]], normal, damping, dtype)

    def model(self, state, context, stage, scale, appearance=None, stiffness=None):
        """As :meth:`polysft_mi.objective.second_order.SecondOrder.model`, reported and counted."""
        model = self.objective.model(state, context, stage, scale, appearance, stiffness)
        if self.report:
            self.report(self.count, model.total, model.terms)
        self.count += 1
        return model

    def descend(self, start, context, stages, iterations=None):
        """All ``stages`` from a start, then the fine ones again while they explain more of a frame
        that is not explained: :class:`Found`.

        Folds come gradually, and too few iterations leave each frame a little further behind. A
        frame counts as explained up to the misfit that such passes could not lower in a frame
        before.
        """
        rules = self.rules
        best = self._stages(start, context, stages, iterations)
        for count in range(rules.fine_passes):
            if context.is_first or best.misfit <= max(rules.explained, context.explained):
                break
            found = self._stages(best.state, context, self.usual[1:], iterations)
            gain = 1 - found.cost / best.cost
            if gain > 0:
                best = found
            if gain < rules.fine_gain:
                return replace(best, more_is_vain=count == 0)
        return best

    def _stages(self, state, context, stages, iterations):
        scales, found = {}, None
        for stage in stages:
            found = self.stage(state, context, stage, iterations or stage.iterations)
            state, scales = found.state, scales | found.scales
        return Found(state, found.model, scales)

    def stage(self, state, context, stage, iterations):
        """Levenberg-Marquardt at one stage: :class:`Found`. The robust scale is the one that fitted
        the frame before.
        """
        rules = self.rules
        scale = context.scales.get(stage, rules.first_scale)
        appearance = self.objective.appearance(state, stage, context.light)
        model = self.model(state, context, stage, scale, appearance)
        damping = rules.damping[model.normal.local.shape[-1] - 2]
        for _ in range(iterations):
            try:
                step, promised = self.reduced(model.normal, damping, np.float32).step()
                check_step(step, len(state.alpha))
            except LinAlgError:
                damping = max(10 * damping, _RAISED_DAMPING)
                continue
            trial = state.after_step(step)
            if promised < rules.small_step * model.total:
                state = trial
                break
            found = self.model(trial, context, stage, scale, appearance)
            if found.total < model.total:
                if model.total - found.total > 0.5 * promised:
                    damping = max(damping / 5, _LEAST_DAMPING)
                state, model = trial, found
            else:
                damping *= 10
        fitted = self._robust_scale(model.evaluation.outlier_share, scale)
        return Found(state, model, {stage: fitted})

    def _robust_scale(self, outlier_share, scale):
        """The scale at which a residual of 2/3 of it is the median, were the residuals'
        distribution only stretched.
        """
        m = min(max(outlier_share, 0.02), 0.98)
        stretched = scale * math.sqrt(m / (1 - m) / 0.44)
        return float(np.clip(stretched, *self.rules.scale_bounds))
