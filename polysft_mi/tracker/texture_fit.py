"""Moving the template's texture to where the first frame shows it.

Where the template stands right but its texture does not lie where the image has it, the difference
would be taken for stretch, and for depth, in every frame.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError

from polysft_mi.errors import BadFrame
from polysft_mi.solvers import Reduced

_ITERATIONS, _STIFFNESS, _DAMPING = 6, 1e-3, 1e-3  # a stage's; a share of k_mi: edges are loose


def fit_texture(problem, objective, context):
    """Slide the vertices of the undeformed template over it until its texture fits the first frame,
    and move the texture so, where that explains the frame much better.

    ``context``: a :class:`polysft_mi.objective.context.FrameContext` of the first frame.
    """
    data, atlas, rules = objective.data, objective.atlas, objective.rules
    state, finest = context.anchor, objective.usual[-1]
    if len(atlas) > 1:  # texture coordinates with seams are no function of a chart
        return
    misfit = lambda state: data.misfit(atlas.surface(state).vertices, 0, finest.blur)
    if (before := misfit(state)) < rules.margin:
        return
    for stage in objective.usual[:2]:
        loose = replace(stage, stiffness=_STIFFNESS, gives=False)
        for _ in range(_ITERATIONS):
            try:
                model = objective.quadratic(state, context, loose, None)
                patterns = objective.inputs.operators.patterns
                slide = Reduced.of(patterns, model.normal, _DAMPING).slide()
            except (BadFrame, LinAlgError):
                return
            state = state.after_step((np.zeros(len(model.normal.gradient)), slide))
    if misfit(state) < rules.texture_gain * before:
        template = problem.template
        flat, unit = template.chart[:, 0], template.scale / template.radius[0]
        objective.move_texture(flat, flat + unit * state.offset[:, :2])
