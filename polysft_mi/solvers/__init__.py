"""Solvers, by the name that the setting ``solver`` takes.

A solver is built from :class:`polysft_mi.scene.settings.Settings` and has ``solve(problem, window,
frames, report=None, past=()) -> Solution``; it sees :class:`polysft_mi.objective.problem.Problem`
only through its methods. To add one: a module here, its name in ``create`` and in the setting's
choices.
"""

from dataclasses import dataclass, field


@dataclass
class Solution:
    """``window``: list of Unknowns; ``total`` and ``terms``: the objective there; ``iterations``:
    evaluations that it took; ``facts``: other numbers, and lists of them, that the solver wants to
    see again in ``past``; ``sigma``: for each frame of the window the standard deviation (N,) [m]
    of each vertex along its ray, or None where the solver has none."""

    window: list
    total: float
    terms: dict
    iterations: int
    facts: dict = field(default_factory=dict)
    sigma: list | None = None


def create(settings):
    """The solver that ``settings.solver`` names. Import only after a Mitsuba variant is set."""
    if settings.solver == "gauss-newton":
        from .gauss_newton import GaussNewton

        return GaussNewton(settings)
    if settings.solver == "adam":
        from .adam import Adam

        return Adam(settings)
    raise ValueError(f"no solver {settings.solver!r}")
