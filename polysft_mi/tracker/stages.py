"""A frame from one start: stage after stage, coarse to fine, each minimised by the solver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from polysft_mi.objective import FrameContext, Objective, QuadraticModel, Stage
from polysft_mi.solvers import Report, Result, Solver
from polysft_mi.surface import State


@dataclass(frozen=True)
class Found:
    """Where a frame ended: the ``state``, the solver's ``result``, the ``model`` of the objective
    there (or one small step before; None where it has none), the robust ``scales`` by stage that
    fit the residuals, and whether more iterations gain nothing.
    """

    state: State
    result: Result
    model: QuadraticModel | None
    scales: dict[Stage, float] = field(default_factory=dict)
    more_is_vain: bool = False

    @property
    def misfit(self) -> float:
        """Of the surface, 0 to 1; NaN where the objective has no model."""
        return self.model.evaluation.misfit if self.model else math.nan


class Stages:
    """Minimises an ``objective`` for one frame by a ``solver``. ``report(iteration, total, terms)``
    is called after each evaluation; ``count``: how many there were.
    """

    def __init__(self, objective: Objective, solver: Solver, has_model: bool) -> None:
        self.objective, self.rules, self._solver = objective, objective.rules, solver
        self._has_model = has_model
        self.report: Report | None = None
        self.count = 0

    def minimise(
        self,
        contexts: Sequence[FrameContext],
        stage: Stage,
        states: Sequence[State],
        iterations: int | None = None,
    ) -> list[Found]:
        """The frames of a window together, at one stage: one :class:`Found` each."""
        frozen = self.objective.frozen(contexts, stage, states)
        result = self._solver.minimise(frozen, states, iterations=iterations, report=self._reported)
        models = result.models or (
            frozen.quadratic(result.states) if self._has_model else [None] * len(states)
        )
        return [
            Found(state, result, model, self._fitted(context, stage, model))
            for state, model, context in zip(result.states, models, contexts, strict=True)
        ]

    def _reported(self, _, total, terms):
        if self.report:
            self.report(self.count, total, terms)
        self.count += 1

    def descend(
        self,
        start: State,
        context: FrameContext,
        stages: Sequence[Stage],
        iterations: int | None = None,
    ) -> Found:
        """All ``stages`` from a start, then the fine ones again while they explain more of a frame
        that is not explained.

        Folds come gradually, and too few iterations leave each frame a little further behind. A
        frame counts as explained up to the misfit that such passes could not lower in a frame
        before.
        """
        rules, fine = self.rules, self.objective.usual[1:]
        best = self._through(start, context, stages, iterations)
        if not fine or not rules.fine_passes or self.objective.is_known(context):
            return best
        is_first = True
        while best.misfit > max(rules.margin, context.memory.explained):
            found = self._through(best.state, context, fine, iterations)
            gain, least = self.cost(best) - self.cost(found), rules.gain * best.model.measure
            if gain > 0:
                best = found
            if not gain > least:
                return replace(best, more_is_vain=is_first)
            is_first = False
        return best

    @staticmethod
    def cost(found: Found) -> float:
        """What results of a frame are compared by: the objective at the last stage, whose scales
        are the same for all of them.
        """
        assert found.model is not None  # asked for where all terms have one
        return found.model.total

    def _through(self, state, context, stages, iterations):
        scales: dict[Stage, float] = {}
        for stage in stages:
            (found,) = self.minimise([context], stage, [state], iterations)
            state, scales = found.state, scales | found.scales
        return replace(found, scales=scales)

    def _fitted(self, context, stage, model):
        """{stage: the robust scale at which a residual of 2/3 of it is the median, were the
        residuals' distribution only stretched}.
        """
        if model is None:
            return {}
        m = min(max(model.evaluation.outlier_share, 0.02), 0.98)
        stretched = self.objective.scale(context, stage) * math.sqrt(m / (1 - m) / 0.44)
        return {stage: max(stretched, self.rules.scale_least)}
