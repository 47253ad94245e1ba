"""Moving the template's texture to where the first frame shows it.

Where the template stands right but its texture does not lie where the image has it, the difference
would be taken for stretch, and for depth, in every frame.
"""

import numpy as np
from scipy.linalg import LinAlgError

from polysft_mi.errors import BadFrame

_ITERATIONS, _STIFFNESS, _DAMPING = 6, 1.0, 1e-3  # a stage's; a factor of k_mi: edges are loose


def fit_texture(problem, descent, context):
    """Slide the vertices of the undeformed template over it until its texture fits the first frame,
    and move the texture so, where that explains the frame much better and moves little.

    ``context``: a :class:`polysft_mi.objective.second_order.Context` of the first frame.
    """
    objective, rules = descent.objective, descent.rules
    images, atlas, finest = objective.images, objective.atlas, descent.usual[-1]
    state = context.anchor
    if len(atlas) > 1:  # texture coordinates with seams are no function of a chart
        return
    before = images.misfit(atlas.surface(state).vertices, 0, finest.blur)
    if before < rules.texture_misfit:
        return
    for stage in descent.usual[:2]:
        for _ in range(_ITERATIONS):
            try:
                model = descent.model(
                    state, context, stage, rules.first_scale, stiffness=_STIFFNESS
                )
                slide = descent.reduced(model.normal, _DAMPING).slide()
            except (BadFrame, LinAlgError):
                return
            state = state.after_step((np.zeros(len(model.normal.gradient)), slide))
    after = images.misfit(atlas.surface(state).vertices, 0, finest.blur)
    near = np.abs(state.offset).max() < rules.texture_farthest
    if after < rules.texture_gain * before and near:
        template = problem.template
        flat, unit = template.chart[:, 0], template.scale / template.radius[0]
        images.move_texture(flat, flat + unit * state.offset[:, :2])
