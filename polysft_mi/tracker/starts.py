"""Where a frame begins: at the frame before, where its motion leads, or, where that does not
explain the image, farther away or at the pose that features and tracks tell.
"""

import math
from dataclasses import replace

import numpy as np

from .relocate import TemplateFeatures, rigid_motion

_MOST = 60  # steps of a stage from a start that may be far off; it ends where one promises little


def motion_starts(start, history):
    """``start``, and where the motion from the last but one to the last state of ``history`` leads:
    half as far again, and as far again.
    """
    if len(history) < 2:
        return [start]
    return [start, *(history[-2].extrapolated(history[-1], factor) for factor in (0.5, 1.0))]


class Starts:
    """Chooses starts for :class:`polysft_mi.tracker.stages.Stages`."""

    def __init__(self, problem, stages):
        self._problem, self._stages, self._rules = problem, stages, stages.rules
        self._features = None

    def nearest(self, starts, frame, stage):
        """The start that explains the frame best at a stage."""
        objective = self._stages.objective
        misfits = [
            objective.data.misfit(objective.atlas.surface(state).vertices, frame, stage.blur)
            for state in starts
        ]
        return starts[int(np.argmin(misfits))]

    def solve(self, start, context, history, usual_misfits):
        """The frame from the nearest start; where it ends suspect, also from others:
        :class:`polysft_mi.tracker.stages.Found`.

        ``history``: states of the one or two frames before; ``usual_misfits``: of the frames
        before, oldest first.
        """
        stages, rules, frame = self._stages, self._rules, context.frame
        objective = stages.objective
        starts = motion_starts(start, history) if rules.motion_starts else [start]
        starts = [objective.atlas.posed(state, frame, start) for state in starts]
        if context.is_first and not objective.is_known(context):
            # a body's pose is far off, and no frame before says by how much
            all_of = objective.far, *objective.usual
            bodily = [replace(stage, bodily=True) for stage in all_of[:3]]
            return stages.descend(start, context, (*bodily, *all_of), _MOST)
        best = stages.descend(
            self.nearest(starts, frame, objective.usual[0]), context, objective.usual
        )
        limit = self._suspect_above(usual_misfits)
        far = objective.far, *objective.usual
        if best.misfit > limit:
            objective.data.prefetch(
                [frame], [objective.far.blur], self._problem.settings.compares_triangles
            )
        for other in (lambda: self.nearest(starts, frame, far[0]), lambda: self._rigid(frame)):
            if not best.misfit > limit:
                break
            if (other := other()) is None:
                continue
            found = stages.descend(other, context, far, _MOST)
            if stages.cost(found) < stages.cost(best):
                best = found
        return best

    def _suspect_above(self, usual):
        """The misfit above which a frame is suspect: infinite while those of the frames before are
        too few to tell.
        """
        usual = usual[-self._rules.usual_frames :]
        return np.median(usual) + self._rules.margin if len(usual) > 2 else math.inf

    def _rigid(self, frame):
        """The undeformed template in the pose that its features and tracks have in the frame; None
        where too few are found.
        """
        objective = self._stages.objective
        if objective.atlas.carrier is not None:  # nothing on a body is rigid
            return None
        if self._features is None:
            self._features = TemplateFeatures(objective.data)
        start = objective.atlas.start
        found = self._features.matches(self._problem.sequence.frame(frame))
        known = objective.matches(frame, objective.atlas.surface(start).vertices)
        points, pixels = map(np.concatenate, zip(found, known, strict=True))
        motion = rigid_motion(objective.data.camera, points, pixels)
        return None if motion is None else objective.atlas.moved(start, *motion)
