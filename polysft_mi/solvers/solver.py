"""What a solver is, and what it answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from polysft_mi.objective import FrozenObjective, Objective, QuadraticModel
    from polysft_mi.surface import State

#: called after each evaluation: (iteration, total, terms)
Report = Callable[[int, float, dict[str, float]], None]


@dataclass(frozen=True)
class Result:
    """Where a minimisation ended.

    ``states``: one a frame; ``total``, ``terms``: the objective there, or one small step before;
    ``evaluations``: how many it took; ``models``: the last quadratic models, one a frame, of
    solvers that make them.
    """

    states: list[State]
    total: float
    terms: dict[str, float]
    evaluations: int
    models: list[QuadraticModel] = field(default_factory=list)


class Solver(Protocol):
    """What minimises a :class:`polysft_mi.objective.objective.FrozenObjective`; ``name``: as the
    setting has it.
    """

    name: str

    def minimise(
        self,
        objective: FrozenObjective,
        start: Sequence[State],
        *,
        iterations: int | None = None,
        report: Report | None = None,
    ) -> Result:
        """From the states ``start``, one a frame; ``iterations``: at most, in place of the usual
        number. BadFrame passes through.
        """

    def check(self, objective: Objective) -> None:
        """Raise InputError where the solver cannot minimise the objective."""
