"""The second-order tracker: Levenberg-Marquardt on the objective of a frame, coarse to fine.

In: a problem, the frames of a window and what is known of the frames before. Out: a
:class:`polysft_mi.solvers.Solution`. A frame goes through these files once, in this order:
``solver`` (the story), ``texture_fit`` (the first frame alone), ``starts`` (where to begin),
``descent`` (stage after stage), ``window`` (several frames together), ``sigma`` (how sure).
Import only after a Mitsuba variant is set.
"""

from .solver import GaussNewton

__all__ = ["GaussNewton"]
