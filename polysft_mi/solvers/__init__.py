"""Solvers, by the name that the setting ``solver`` takes: images of a window of frames in, unknowns
that explain them out.

A solver is built from :class:`polysft_mi.scene.settings.Settings`. It has ``solve(problem, window,
frames, report=None, past=())``, which returns a :class:`polysft_mi.solvers.solution.Solution`. To
add one, write a module here, and put its name into :func:`create` and the setting's choices.
"""

from .solution import Solution

__all__ = ["Solution", "create"]


def create(settings):
    """The solver that ``settings.solver`` names. Import only after a Mitsuba variant is set."""
    if settings.solver == "gauss-newton":
        from .gauss_newton import GaussNewton

        return GaussNewton(settings)
    if settings.solver == "adam":
        from .adam import Adam

        return Adam(settings)
    raise ValueError(f"no solver {settings.solver!r}")
