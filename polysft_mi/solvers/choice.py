"""The solver of an objective. Import only after a Mitsuba variant is set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .adam import Adam
from .gauss_newton import GaussNewton
from .solver import Solver

if TYPE_CHECKING:
    from polysft_mi.objective import Objective


def create(objective: Objective) -> Solver:
    """The solver that the settings of an ``objective`` name: of ``auto``, gauss-newton where each
    term has a quadratic model. Raises InputError where it cannot minimise the objective, or does
    not read a setting that was chosen.
    """
    name = objective.settings.solver
    if name == "auto":
        name = "gauss-newton" if objective.without_block is None else "adam"
    if name == "gauss-newton":
        solver: Solver = GaussNewton(objective.rules)
    else:
        solver = Adam(objective.settings)
    experiment = objective.problem.experiment
    experiment.settings.check_read(name, experiment.path)
    solver.check(objective)
    return solver
