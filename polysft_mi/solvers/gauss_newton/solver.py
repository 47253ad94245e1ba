"""The second-order solver of a window of frames: what happens to a frame, in order."""

import math
from dataclasses import replace

import numpy as np
from threadpoolctl import ThreadpoolController

from polysft_mi.errors import InputError
from polysft_mi.images import Light
from polysft_mi.objective import Context, SecondOrder
from polysft_mi.solvers.solution import Solution
from polysft_mi.surface import Unknowns

from .descent import Descent
from .sigma import along_rays
from .starts import Starts
from .texture_fit import fit_texture
from .window import Window


def _last(past, name):
    """The last value of a fact that the frames before left, or None."""
    return next((facts[name] for facts in reversed(past) if facts.get(name) is not None), None)


class GaussNewton:
    """Gauss-Newton curvatures of all terms, damped after Levenberg and Marquardt.

    A frame starts from the one before or from where its motion leads, whichever explains the image
    better. Where it ends with a misfit far above that of the frames before, other starts are tried.
    A relief over the jet, a height of each vertex, holds folds that no jet can. In a window of
    several frames the newest is solved so, and then all together; :meth:`revisit` looks both ways
    from one frame, and :meth:`retry` solves it from another frame's surface.
    """

    def __init__(self, settings):
        self.settings = settings
        if settings.brightness == "gain":
            raise InputError(
                "setting brightness = 'gain' with solver = gauss-newton; auto, local or none is"
                " needed"
            )
        if settings.smooth > 0 and settings.width > 1:
            raise InputError(
                f"setting smooth = {settings.smooth:g} with window = {settings.width}; one of them"
                " looks both ways: window = 1, or smooth = 0, is needed"
            )
        if settings.sweeps > 0 and settings.width > 1:
            raise InputError(
                f"setting sweeps = {settings.sweeps} with window = {settings.width}; frames are"
                " gone over one by one: window = 1, or sweeps = 0, is needed"
            )
        self._problem = None
        # BLAS's own threads cost more than they bring on blocks this small, and wait for Dr.Jit's
        self._blas = ThreadpoolController()

    def solve(self, problem, window, frames, report=None, past=()):
        """Minimise over the last of ``frames``, then over all of them: a
        :class:`polysft_mi.solvers.Solution`.

        ``window``: their Unknowns, in a list; ``past``: of all frames before the last, oldest
        first, (arrays of ``Unknowns.to_numpy``, terms and facts); without it every frame of the
        window is new.
        """
        with self._blas.limit(limits=1, user_api="blas"):
            self._prepare(problem, report)
            states = [self._atlas.state(unknowns.to_numpy()) for unknowns in window]
            known = [facts for _, facts in past]
            outside = past[: max(0, len(past) + 1 - len(frames))][-2:]
            before = [self._atlas.state(arrays) for arrays, _ in outside]
            for k in range(len(frames) - 1 if past else 0, len(frames)):
                start = states[k] if past or k == 0 else states[k - 1]
                history = (before + states[:k])[-2:]
                found, context = self._newest(start, frames[k], history, known)
                states[k] = self._atlas.with_relief_in_jets(found.state)
                known.append(self._facts(found, context, known))
            results = [found]
            if len(frames) > 1:
                contexts = [replace(context, frame=frame, anchor=None) for frame in frames]
                if before:
                    contexts[0] = replace(contexts[0], anchor=before[-1])
                results = Window(self._descent, contexts).solve(states)
                states = [result.state for result in results]
            return self._solution(states, results, known[-1])

    def revisit(self, problem, frame, before, after, terms, weight):
        """Solve a frame again, held to the middle of its neighbours: a
        :class:`polysft_mi.solvers.Solution`.

        ``before``, ``after``: arrays of ``Unknowns.to_numpy`` of the frames on either side;
        ``terms``: terms and facts of the frame so far; ``weight``: of the squared difference to the
        middle.
        """
        with self._blas.limit(limits=1, user_api="blas"):
            self._prepare(problem, None)
            a, b = self._atlas.state(before), self._atlas.state(after)
            middle = a.extrapolated(b, -0.5)
            context = replace(self._context(frame, middle, [terms]), hold=weight)
            found = self._descent.descend(middle, context, self._descent.usual)
            return self._solution([found.state], [found], self._same_noise(found, context, terms))

    def retry(self, problem, frame, start, state, terms, past, report=None):
        """Solve a frame anew from another frame's surface: a
        :class:`polysft_mi.solvers.Solution`, or None where it costs no less than the surface that
        the frame has.

        ``start``, ``state``: arrays of ``Unknowns.to_numpy`` of the other frame, and of the frame
        so far; ``terms``: terms and facts of the frame so far; ``past``, ``report``: as in
        :meth:`solve`. Both surfaces are compared by the last stage's objective, held to the frame
        before.
        """
        with self._blas.limit(limits=1, user_api="blas"):
            self._prepare(problem, report)
            self._expect(frame)
            before = self._atlas.state(past[-1][0])
            context = self._context(frame, before, [facts for _, facts in past])
            found = self._descent.descend(self._atlas.state(start), context, self._descent.usual)
            new = self._atlas.with_relief_in_jets(found.state)
            if self._cost(new, context) >= self._cost(self._atlas.state(state), context):
                return None
            return self._solution([new], [found], self._same_noise(found, context, terms))

    def _cost(self, state, context):
        """The cost of a state at the last stage."""
        stage = self._descent.usual[-1]
        scale = context.scales.get(stage, self._descent.rules.first_scale)
        appearance = self._descent.objective.appearance(state, stage, context.light)
        return self._descent.model(state, context, stage, scale, appearance).cost

    # -- a frame ---------------------------------------------------------------

    def _prepare(self, problem, report):
        if problem is not self._problem:
            self._problem = problem
            self._descent = Descent(SecondOrder(problem))
            self._images, self._atlas = (
                self._descent.objective.images,
                self._descent.objective.atlas,
            )
            self._starts = Starts(problem, self._descent)
            if self.settings.texture_fit == "auto":
                rest = self._atlas.state(problem.patch.rest().to_numpy())
                self._expect(0)
                fit_texture(problem, self._descent, self._context(0, rest, []))
        self._descent.report, self._descent.count = report, 0

    def _newest(self, start, frame, history, known):
        """(found, context) of a frame after those whose facts are ``known``."""
        self._expect(frame)
        context = self._context(frame, history[-1] if history else start, known)
        usual = [facts["misfit"] for facts in known if facts.get("misfit") is not None]
        return self._starts.solve(start, context, history, usual), context

    def _expect(self, frame):
        """Have this frame and the next one read in a second thread."""
        frames = [k for k in (frame, frame + 1) if k < len(self._problem.sequence)]
        self._images.prefetch(frames, [stage.blur for stage in self._descent.usual])

    def _context(self, frame, anchor, known):
        """The :class:`polysft_mi.objective.second_order.Context` of a frame after those whose facts
        are ``known``.
        """
        misfit, least = (_last(known, name) for name in ("misfit", "least_misfit"))
        noise = math.nan if misfit is None else misfit
        if least is not None and not math.isnan(least):
            noise = least
        last, first = known[-1] if known else {}, self._descent.rules.first_scale
        stages = self._descent.far, *self._descent.usual
        scales = {stage: last.get(f"scale_{k}") or first for k, stage in enumerate(stages)}
        light = Light.of(_last(known, "light"), self._descent.rules)
        hidden = self._descent.objective.hidden(anchor)
        explained = _last(known, "explained") or 0.0
        return Context(frame, anchor, noise, light, scales, explained, hidden=hidden)

    def _facts(self, found, context, known):
        """What the frames that follow want to know of this one.

        ``misfit``, ``outlier_share``; ``least_misfit``: of the frames so far, the first one aside,
        which the texture was taken from; ``explained``: the highest misfit that more iterations
        could not lower; ``light``: its numbers; ``scale_k``: robust scale of stage k.
        """
        model, frame = found.model, context.frame
        stages = self._descent.far, *self._descent.usual
        first = self._descent.rules.first_scale
        facts = {f"scale_{k}": found.scales.get(stage, first) for k, stage in enumerate(stages)}
        facts |= {"misfit": found.misfit, "outlier_share": model.evaluation.outlier_share}
        facts["least_misfit"] = self._least_misfit(found, context, known)
        facts["explained"] = found.misfit if found.more_is_vain else context.explained
        light = context.light
        if self.settings.k_shading > 0:
            vertices, seen = model.surface.vertices, model.evaluation.seen
            light = light.updated(self._images.shade(vertices, frame, seen, model.appearance))
        facts["light"] = light.numbers()
        return facts

    def _same_noise(self, found, context, terms):
        """The facts of a frame that is solved again; noise and light stay those of ``terms``, where
        it was not lost.
        """
        facts, kept = self._facts(found, context, [terms]), ("least_misfit", "light")
        return facts | {name: terms[name] for name in kept if terms.get(name) is not None}

    def _least_misfit(self, found, context, known):
        """The least misfit of the frames so far, the first one aside, of the texture as the
        template has it: what the camera's blur makes of it is no noise. Of a surface of several
        patches, less what its slant accounts for, which is large at its rims. NaN in the first
        frame.
        """
        if not known:
            return math.nan
        least = _last(known, "least_misfit")
        least = math.nan if least is None else least
        if found.misfit > least:
            return least
        blur, vertices = self._descent.usual[-1].blur, found.model.surface.vertices
        bare, appearance = (
            self._images.misfit(vertices, context.frame, blur),
            found.model.appearance,
        )
        slant = appearance.misfit if appearance and len(self._atlas) > 1 else 0.0
        return float(np.fmin(least, max(found.misfit, bare - slant) if slant else bare))

    def _solution(self, states, results, facts):
        """:class:`Solution` of a window: its states, the mean of their terms, and the facts of its
        newest frame when it was solved.
        """
        names = results[0].model.terms
        terms = {name: float(np.mean([r.model.terms[name] for r in results])) for name in names}
        window = [Unknowns.from_numpy(self._atlas.arrays(state)) for state in states]
        origin = self._problem.camera.origin
        sigma = [along_rays(self._descent, result.model, origin) for result in results]
        return Solution(window, sum(terms.values()), terms, self._descent.count, facts, sigma)
