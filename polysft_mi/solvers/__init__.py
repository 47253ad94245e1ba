"""Solvers, by the name that the setting ``solver`` takes: images of a window of frames in, unknowns
that explain them out.

A solver is built from :class:`polysft_mi.scene.settings.Settings`. It has ``solve(problem, window,
frames, report=None, past=())``, which returns a :class:`polysft_mi.solvers.solution.Solution`. To
add one, write a module here, and put its name into :func:`create` and the setting's choices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from .solution import Solution

if TYPE_CHECKING:
    from polysft_mi.objective import Problem
    from polysft_mi.scene import Settings
    from polysft_mi.surface import Unknowns

__all__ = ["Solution", "Solver", "create"]


class Solver(Protocol):
    """What minimises a :class:`polysft_mi.objective.problem.Problem` over a window of frames."""

    def solve(
        self,
        problem: Problem,
        window: list[Unknowns],
        frames: list[int],
        report: Callable[[int, float, dict], None] | None = None,
        past: Sequence[tuple[dict, dict]] = (),
    ) -> Solution:
        """From the Unknowns ``window`` of ``frames``; ``past``: arrays, and facts, of the frames
        before. ``report(iteration, total, terms)`` is called after each evaluation.
        """


def create(settings: Settings) -> Solver:
    """The solver that ``settings.solver`` names. Import only after a Mitsuba variant is set."""
    if settings.solver == "gauss-newton":
        from .gauss_newton import GaussNewton

        return GaussNewton(settings)
    if settings.solver == "adam":
        from .adam import Adam

        return Adam(settings)
    raise ValueError(f"no solver {settings.solver!r}")
