"""Solvers, by the name that the setting ``solver`` takes. In: an objective whose scales are frozen,
and where to begin. Out: the states where it is least. Any solver takes any objective; what is
remembered between frames, windows, other starts and coarse to fine are the tracker's. Import only
after a Mitsuba variant is set.

To add one, write a class with :meth:`polysft_mi.solvers.solver.Solver.minimise`, and put its name
into :func:`create` and the setting's choices.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "adam": ["Adam"],
        "choice": ["create"],
        "gauss_newton": ["GaussNewton"],
        "linear": ["Reduced"],
        "solver": ["Report", "Result", "Solver"],
    },
)
