"""What a surface costs. In: unknowns of a jet patch, and what the images say of its surface. Out:
the paper's objective and its gradient (:mod:`~polysft_mi.objective.problem`), or the tracker's, to
second order (:mod:`~polysft_mi.objective.second_order`). Import only after a Mitsuba variant is
set.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "problem": ["Problem", "TERMS"],
        "second_order": ["Context", "Model", "SecondOrder", "stages_of"],
    },
)
