"""What a surface costs. In: unknowns of a jet patch, and what the images say of its surface. Out:
the paper's objective and its gradient (:mod:`~polysft_mi.objective.problem`), or the tracker's, to
second order (:mod:`~polysft_mi.objective.second_order`). Import only after a Mitsuba variant is
set.
"""
