"""What happens to a frame: what is known of it before, where it begins, coarse to fine, and what it
tells the frames after it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from polysft_mi import solvers
from polysft_mi.errors import InputError
from polysft_mi.objective import FrameContext, FrameMemory, Objective
from polysft_mi.solvers import Report, Solver
from polysft_mi.surface import State

from .branches import mirrored, plane_of
from .rims import Rim
from .sigma import along_rays, score
from .stages import Found, Stages
from .starts import Starts
from .texture_fit import fit_texture

if TYPE_CHECKING:
    from polysft_mi.objective import Problem

#: a frame that was solved: its state, and what it tells; None where it was lost
Past = Sequence[tuple[State, FrameMemory | None]]


@dataclass(frozen=True)
class Solution:
    """Frames as they were solved: ``states``, the mean of their ``terms``, ``evaluations`` of the
    objective; the ``memory`` of the newest, None where nothing is learned; ``certainty``: of each,
    the standard deviation of each vertex along its ray and its score, (2, N) [m], or None where the
    objective has no quadratic model.
    """

    states: list[State]
    terms: dict[str, float]
    evaluations: int
    memory: FrameMemory | None
    certainty: list[np.ndarray] | None


class FrameTracker:
    """Solves the frames of a ``problem``, window by window, by a ``solver``, or by the one that the
    settings name.

    A frame starts from the one before or, with ``starts`` = auto, from where its motion leads,
    whichever explains the image better; where it ends with a misfit far above that of the frames
    before, other starts are tried. In a window of several frames the newest is solved so, and then
    all together. With ``starts`` = previous it is the paper's: all together, from the frame before
    (supplement, "Adaptive Window Optimization"). :meth:`revisit` looks both ways from one frame,
    and :meth:`retry` solves it from another frame's surface. Raises InputError where the solver
    cannot minimise the objective.
    """

    def __init__(self, problem: Problem, solver: Solver | None = None) -> None:
        self.problem, self.settings = problem, problem.settings
        self.objective = Objective(problem)
        self._check_body()
        self.solver = solver or solvers.create(self.objective)
        self._check_settings()
        # what frames are compared by, and how sure they are, needs the closed form
        self._learns = self.objective.without_block is None
        self._stages = Stages(self.objective, self.solver, self._learns)
        self._starts = Starts(problem, self._stages)
        self._atlas, self._is_prepared = problem.atlas, False

    def _check_body(self):
        """Raise InputError where the poses of a body cannot be corrected."""
        s, path = self.settings, self.problem.experiment.path
        if s.body and (reason := self.objective.without_block):
            raise InputError(
                f"{path}: setting body = {s.body} needs a quadratic model of each term, and"
                f" {reason}"
            )
        if s.body and (s.window > 1 or s.solver == "adam"):
            raise InputError(
                f"{path}: setting body = {s.body}: its poses are corrected frame by frame; solver ="
                " gauss-newton and window = 1 are needed"
            )

    def _check_settings(self):
        s, path = self.settings, self.problem.experiment.path
        for name in ("smooth", "sweeps"):
            value = getattr(s, name)
            if value > 0 and s.window > 1:
                raise InputError(
                    f"{path}: setting {name} = {value:g} with window = {s.window}; frames are gone"
                    f" over one by one: window = 1, or {name} = 0, is needed"
                )
            if value > 0 and (reason := self.objective.without_block):
                raise InputError(
                    f"{path}: setting {name} = {value:g} compares surfaces by the terms' quadratic"
                    f" models, and {reason}, or {name} = 0"
                )

    def solve(
        self,
        window: Sequence[State],
        frames: Sequence[int],
        past: Past = (),
        report: Report | None = None,
    ) -> Solution:
        """Minimise over the last of ``frames``, then over all of them.

        ``window``: their states; ``past``: all frames before the last, oldest first; without it
        every frame of the window is new.
        """
        self._prepare(report)
        states = [self._atlas.posed(x, frame, x) for x, frame in zip(window, frames, strict=True)]
        known = [memory for _, memory in past]
        before = [state for state, _ in past[: max(0, len(past) + 1 - len(frames))]][-2:]
        found = context = None
        alone = range(len(frames) - 1 if past else 0, len(frames))
        for k in alone if self.settings.starts == "auto" and self._learns else ():
            start = states[k] if past or k == 0 else states[k - 1]
            history = (before + states[:k])[-2:]
            found, context = self._newest(start, frames[k], history, known)
            states[k] = self._atlas.with_relief_in_jets(found.state)
            known.append(self._memory(found, context, known))
        results = [found] if found else []
        if len(frames) > 1 or not found:
            context = context or self._context(frames[-1], states[0], known)
            contexts = [replace(context, frame=frame, anchor=None) for frame in frames]
            if before and self.settings.tc_ties == "before":
                contexts[0] = replace(contexts[0], anchor=before[-1])
            results = self._stages.minimise(contexts, self.objective.usual[-1], states)
            states = [result.state for result in results]
            if not found:
                known.append(self._memory(results[-1], context, known))
        return self._solution(states, results, known[-1])

    def revisit(
        self, frame: int, before: State, after: State, memory: FrameMemory | None, weight: float
    ) -> Solution:
        """Solve a frame again, held to the middle of the states ``before`` and ``after`` it;
        ``memory``: of the frame so far; ``weight``: of the squared difference to the middle.
        """
        self._prepare(None)
        middle = self._atlas.posed(before.extrapolated(after, -0.5), frame, after)
        context = replace(self._context(frame, middle, [memory]), hold=weight)
        found = self._stages.descend(middle, context, self.objective.usual)
        return self._solution([found.state], [found], self._same_noise(found, context, memory))

    def retry(
        self,
        frame: int,
        start: State,
        state: State,
        memory: FrameMemory | None,
        past: Past,
        report: Report | None = None,
    ) -> Solution | None:
        """Solve a frame anew from another frame's surface; None where it costs no less than the
        surface that the frame has.

        ``start``, ``state``: of the other frame, and of the frame so far; ``memory``: of the frame
        so far. Both surfaces are compared by the last stage's objective, held to the frame before.
        """
        self._prepare(report)
        self._expect(frame)
        context = self._context(frame, past[-1][0], [memory for _, memory in past])
        start = self._atlas.posed(start, frame, state)
        found = self._stages.descend(start, context, self.objective.usual)
        new = self._atlas.with_relief_in_jets(found.state)
        if self._cost(new, context) >= self._cost(state, context):
            return None
        return self._solution([new], [found], self._same_noise(found, context, memory))

    @property
    def _tries(self):
        """Whether other surfaces are tried where a frame is solved: frames are solved one by one,
        and surfaces are compared. On a body nothing is: its drape leads.
        """
        s = self.settings
        alone = s.window == 1 and s.starts == "auto"
        return self._learns and alone and self._atlas.carrier is None

    @property
    def mirrors(self) -> bool:
        """Whether :meth:`mirror` may find something: a closed surface has no mirror image."""
        wanted = self.objective.rules.mirror_share > 0
        return self._tries and wanted and len(self._atlas) == 1

    def mirror(
        self,
        frame: int,
        state: State,
        certainty: np.ndarray,
        past: Past,
        report: Report | None = None,
    ) -> tuple[Solution | None, float]:
        """Solve a frame anew from the mirror image of its surface. Returns the solution, None where
        it is the same surface, or explains the frame less well; and by what share of the cost of
        the frame's own surface it costs more.

        ``state``, ``certainty`` (2, N) [m]: of the frame so far.
        """
        self._prepare(report)
        self._expect(frame)
        known = [memory for _, memory in past]
        context = self._context(frame, past[-1][0], known)
        vertices = self._atlas.surface(state).vertices
        own_cost = self._cost(state, context)
        light = context.light(self.objective.rules)
        if light.is_known:  # learned from surfaces that this one takes to be mirror images
            middle, normal = plane_of(vertices)
            brightness = self.objective.data.brightness
            distance = (middle - brightness.centre) @ normal / brightness.unit
            known[-1] = replace(context.memory, light=light.mirrored(normal, distance))
            context = replace(context, memory=known[-1])
        image, excess = mirrored(vertices, self.problem.camera.origin), 0.0
        for _, found, apart in self._stage_by_stage(image, state, context):
            if not np.median(apart / certainty[0]) > 1:  # most often where the sheet is flat
                return None, excess
            excess = self._cost(found.state, context) / own_cost - 1
        if excess > self.objective.rules.mirror_share:
            return None, excess
        new = self._atlas.with_relief_in_jets(found.state)
        return self._solution([new], [found], self._memory(found, context, known)), excess

    def doubts(
        self, totals: Sequence[dict[str, float]], memories: Sequence[FrameMemory | None]
    ) -> bool:
        """Whether the same surfaces would have cost less by what another pass must gain, had the
        frames been bold. ``totals``: of each frame of a video, its terms; ``memories``: of each.
        """
        rules, saved, whole = self.objective.rules, 0.0, 0.0
        if not (self._tries and rules.second_pass < 1):
            return False
        for k, terms in enumerate(totals):
            before = FrameMemory.of(list(memories[:k]))
            bold = replace(before, bold=True)
            less = 1 - rules.caution(bold.distrust) / rules.caution(before.distrust)
            saved += less * (terms.get("relief") or 0.0)
            whole += sum(x for x in terms.values() if x is not None)
        return saved > rules.gain * whole

    @functools.cached_property
    def rim(self) -> Rim | None:
        """The rim that :meth:`unfold` continues; None where there is none, or none is asked for."""
        share = self.objective.rules.rim if self._tries else 0.0
        return Rim(self.problem.template, self.objective.inputs.operators.bends, share) or None

    def unfold(
        self,
        frame: int,
        memory: FrameMemory | None,
        state: State,
        certainty: np.ndarray,
        past: Past,
        report: Report | None = None,
    ) -> tuple[Solution | None, float]:
        """Solve a frame anew from its surface with the rim continued from the inside. Returns the
        solution, None where it is the same surface, or gains less than another pass must; and by
        what share of the cost of the frame's own surface it costs more.

        ``memory``, ``state``, ``certainty`` (2, N) [m]: of the frame so far.
        """
        assert self.rim is not None
        self._prepare(report)
        self._expect(frame)
        context = self._context(frame, past[-1][0], [memory for _, memory in past])
        vertices = self._atlas.surface(state).vertices
        continued, rays = self.rim.continued(vertices), vertices - self.problem.camera.origin
        along = np.einsum("ij,ij->i", continued - vertices, rays) / np.linalg.norm(rays, axis=1)
        before, behind = (sign * along > certainty[0] for sign in (-1, 1))
        parts = [*self.rim.parts(before), *self.rim.parts(behind)]
        if not parts:
            return None, 0.0
        for stage, found, apart in self._stage_by_stage(continued, state, context):
            apart /= certainty[0]
            if not any(np.median(apart[part]) > 1 for part in parts):
                return None, 0.0
            excess = self._stages.cost(found) / self._cost(state, context, stage) - 1
            if excess > self.objective.rules.mirror_share:
                return None, excess
        new = self._atlas.with_relief_in_jets(found.state)
        excess = self._cost(new, context) / self._cost(state, context) - 1
        if excess > -self.objective.rules.gain:
            return None, excess
        return self._solution([new], [found], self._same_noise(found, context, memory)), excess

    def _stage_by_stage(self, vertices, state, context):
        """Yields each stage, what ``vertices`` (N, 3) [m, world] lead to there, :class:`Found`, and
        how far (N,) [m] that is from the ``state``.
        """
        own = self._atlas.surface(state).vertices
        new = self._atlas.with_relief_in_jets(self._atlas.reaching(vertices, state))
        for stage in self.objective.usual:
            (found,) = self._stages.minimise([context], stage, [new])
            new = found.state
            yield stage, found, np.linalg.norm(self._atlas.surface(new).vertices - own, axis=1)

    def _cost(self, state, context, stage=None):
        """The cost of a state at a stage, the last one by default."""
        frozen = self.objective.frozen([context], stage or self.objective.usual[-1], [state])
        (model,) = frozen.quadratic([state])
        return self._stages.cost(Found(state, None, model))

    def observe(self, frame: int, state: State) -> None:
        """Take in the state of a frame that was solved; frames come in their order."""
        self.objective.observe(frame, self._atlas.surface(state).vertices)

    # -- a frame ---------------------------------------------------------------

    def _prepare(self, report):
        if not self._is_prepared:
            self._is_prepared = True
            if self.settings.texture_fit == "auto" and self._learns:
                self._expect(0)
                start = self._context(0, self._atlas.start, [])
                fit_texture(self.problem, self.objective, start)
        self._stages.report, self._stages.count = report, 0

    def _newest(self, start, frame, history, known):
        """(found, context) of a frame after those whose memory is ``known``."""
        self._expect(frame)
        context = self._context(frame, history[-1] if history else start, known)
        usual = [memory.misfit for memory in known if memory is not None]
        return self._starts.solve(start, context, history, usual), context

    def _expect(self, frame):
        """Have this frame and the next one read in a second thread."""
        if self._learns:
            frames = [k for k in (frame, frame + 1) if k < len(self.problem.sequence)]
            blurs = [stage.blur for stage in self.objective.usual]
            self.objective.data.prefetch(frames, blurs, self.settings.compares_triangles)

    def _context(self, frame, anchor, known):
        """The :class:`FrameContext` of a frame after those whose memory is ``known``."""
        visibility = None
        if self._learns and anchor is not None:
            visibility = self.objective.visibility(self._atlas.posed(anchor, frame, anchor))
        return FrameContext(frame, anchor, FrameMemory.of(known), visibility)

    def _memory(self, found, context, known):
        """What the frames that follow want to know of this one; None where nothing is learned."""
        if found.model is None:
            return None
        model, before = found.model, context.memory
        light = context.light(self.objective.rules)
        if self.settings.k_shading > 0:
            vertices, seen = model.surface.vertices, model.evaluation.seen
            shade = self.objective.data.shade(vertices, context.frame, seen, model.appearance)
            light = light.updated(shade)
        nat, colours = self.objective.nat_and_colours(context, model)
        if not nat:  # nothing was compared
            nat, colours = math.nan, 1.0
        return FrameMemory(
            misfit=found.misfit,
            outlier_share=model.evaluation.outlier_share,
            least_misfit=self._least_misfit(found, context, known),
            explained=found.misfit if found.more_is_vain else before.explained,
            light=light,
            scales=found.scales,
            nat=nat,
            colours=colours,
            noises=self.objective.noises(context, model.surface.vertices),
            bold=before.bold,
        )

    def _same_noise(self, found, context, memory):
        """The memory of a frame that is solved again; noise and light stay those of ``memory``,
        where it was not lost.
        """
        new = self._memory(found, context, [memory])
        if memory is None:
            return new
        least = new.least_misfit if math.isnan(memory.least_misfit) else memory.least_misfit
        return replace(new, least_misfit=least, light=memory.light)

    def _least_misfit(self, found, context, known):
        """The least misfit of the frames so far, the first one aside, of the texture as the
        template has it: what the camera's blur makes of it is no noise. Of a surface of several
        patches, less what its slant accounts for, which is large at its rims. NaN in the first
        frame.
        """
        if not known:
            return math.nan
        least = FrameMemory.of(known).least_misfit
        if found.misfit > least:
            return least
        blur, vertices = self.objective.usual[-1].blur, found.model.surface.vertices
        bare = self.objective.data.misfit(vertices, context.frame, blur)
        appearance = found.model.appearance
        slant = appearance.misfit if appearance and len(self._atlas) > 1 else 0.0
        return float(np.fmin(least, max(found.misfit, bare - slant) if slant else bare))

    def _solution(self, states, results: Sequence[Found], memory):
        """The :class:`Solution` of a window, with the memory of its newest frame."""
        certainty = None
        if self._learns:
            certainty = [self._certainty(result.model, memory) for result in results]
        terms = results[-1].result.terms
        return Solution(states, terms, self._stages.count, memory, certainty)

    def _certainty(self, model, memory):
        """(2, N) of :class:`Solution`."""
        nat = memory.nat * memory.colours
        sigma = along_rays(self.objective, model, nat, self.problem.camera.origin)
        return np.stack([sigma, score(self.objective, model.surface.vertices, sigma)])
