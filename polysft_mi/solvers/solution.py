"""What a solver answers."""

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
