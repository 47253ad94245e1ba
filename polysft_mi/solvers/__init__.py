"""Solvers, by the name that the setting ``solver`` takes.

A solver is built from :class:`polysft_mi.settings.Settings` and has ``solve(problem, window, frames, report) -> (window, total, terms, iterations)``;
it sees :class:`polysft_mi.problem.Problem` only through its methods. To add one: a module here, its name in ``create`` and in the setting's choices.
"""


def create(settings):
    """The solver that ``settings.solver`` names. Import only after a Mitsuba variant is set."""
    if settings.solver == "adam":
        from .adam import Adam

        return Adam(settings)
    raise ValueError(f"no solver {settings.solver!r}")
