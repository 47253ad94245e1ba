"""Levenberg-Marquardt on the objective of a frame, coarse to fine, from several starts. Import only
after a Mitsuba variant is set.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from threadpoolctl import ThreadpoolController

from polysft_mi.errors import InputError
from polysft_mi.images.light import Light, areas, residuals
from polysft_mi.images.pyramid import Level
from polysft_mi.images.registration import SHADE, Appearance, Evaluation, Registration
from polysft_mi.objective.problem import BadFrame
from polysft_mi.surface.patch import Unknowns

from . import Solution
from .normal_equations import Blocks, Chart, Normal, Pattern, Reduced, State, Surface, hinges
from .relocate import Relocator

# width [pixels] of the sheet that the stages' blurs are given for; they grow with the sheet in the
# image
_SHEET = 225.0
_WINDOW = 8.0  # standard deviation of the window of the local statistics, likewise
_FIRST_SCALE, _SCALES = (
    0.3,
    (0.2, 1.0),
)  # robust scale at the start of a frame, and its bounds, in local standard deviations
_SMALL = 2e-3  # share of the objective that a step must promise for another one to follow
_GOING, _FARTHER = (
    0.1,
    3,
)  # a stage goes on, to so many times its iterations, while steps lower the objective by this share
# the least misfit so far, which is noise, below which images are clean enough for fine folds
_CLEAN = 0.08
# In clean images, a frame that ends with a misfit above so many times the least so far goes through
# the fine stages again, so many times at most, as long as that lowers its cost by this share: folds
# come gradually, and iterations that are too few leave each frame a little further behind.
_AGAIN_ABOVE, _AGAIN, _AGAIN_GAIN = 1.3, 8, 0.01
# A misfit is suspect that exceeds the noise (the least misfit so far) by so many times what the
# median of the frames before does, plus the margin.
_SUSPECT, _SUSPECT_MARGIN, _MEMORY = 1.25, 0.03, 5
_PATIENT = 18  # iterations a stage where a frame is suspect
_RAISE = 0.02  # share of the objective by which more coefficients must lower it to be taken
# the highest coefficients are kept where they are worth this many times what they would make of
# noise alone
_LOWER = 2.0
_DAMPING = {
    2: 1e-4,
    3: 3e-3,
    # at a stage's start, by the local unknowns of a vertex: with less, what no pixel holds is
    # thrown about
}
_UNDAMPED = 1e-9  # damping where a model is asked about, not followed
_JOINT = 3  # iterations of a whole window, each of whose frames has been solved
_ORDER_STEP = 2
# fitting the texture to the first frame: only above this misfit, if it falls by this factor, and no
# farther than this [chart units]
_TEXTURE_MISFIT, _TEXTURE_GAIN, _TEXTURE_FARTHEST = 0.15, 0.6, 0.08
_TEXTURE_ITERATIONS, _TEXTURE_STIFFNESS = 6, 1.0
# share of the pixels that see the sheet below which neither a stage nor another start may go: what
# none sees costs nothing
_SHOWN = 0.7
_FARTHEST_STEP = 2.0  # rotation [rad], translation and displacements [chart units]
# The mirror twin is tried where the sheet bulges by this share of its size, and again each time
# that it bulges so many times as much; it is taken where it costs this much less.
_BULGE, _BULGE_GROWTH, _TWIN_GAIN = 0.01, 1.4, 0.03
_FACTS = "misfit", "outlying", "order", "least_misfit", "bulge", "light"
# of the template, above which there is no relief: its wide system takes a second an iteration at
# 10,000
_RELIEF_VERTICES = 3000
_RELIEF_BEND = 3e-3  # of the relief's weight, for its bending
# Noise must not become ripples, which use up length. What noise there is, the least misfit of the
# frames so far tells, the first one aside, which the texture was taken from: at this misfit the
# relief's weight, and the strain at which edges give, have doubled, and they grow with that power
# of it, to so many times.
_NOISE_MISFIT, _NOISE_POWER, _NOISE_MOST = 0.05, 8, 1e3
_UNEXPLAINED, _UNEXPLAINED_FACTOR = (
    0.02,
    4.0,
)  # a misfit above this, and above so many times the least, is no noise: the jet does not follow
_GIVE = 0.002  # strain from which on a stretched edge hardly pulls harder, where images are clean
# misfit at a frame's start above which the sheet has moved far: lengths lead it there, and edges do
# not give in the coarse stages
_MOVED = 0.15
# of k_tc: it holds a frame to the one before, in a stiffer basis than the monomials of the paper's
# window
_TEMPORAL = 1e-3


def _cost(found):
    """What starts are compared by: unlike the objective, free of the robust scale."""
    terms = found[1]
    return terms["misfit"] + terms["inextensibility"] + terms["smoothness"]


def _check_step(step):
    """Raises LinAlgError where a step (global (G,), local (N, d)) is not finite, or goes farther
    than any model is good for.
    """
    g, local = step
    if not max(np.abs(g[-6:]).max(), np.abs(local).max()) < _FARTHEST_STEP:
        raise LinAlgError("the step is not finite, or too long")


@dataclass
class Model:
    """The objective to second order around a ``state`` whose vertices are of ``surface``: from the
    images' ``evaluation``, ``normal``. ``noise``: the variance of a residual; ``appearance``: the
    sheet's that it was found with; ``reduced``: ``normal`` without damping, made when it is wanted.
    """

    state: State
    surface: Surface
    evaluation: Evaluation
    normal: Normal
    noise: float
    appearance: Appearance | None = None
    reduced: Reduced | None = None


@dataclass(frozen=True)
class Stage:
    """``blur`` [pixels at a sheet of _SHEET], ``stiffness`` (the factor of k_mi), the
    ``iterations`` it usually has, and the least misfit so far below which the ``relief`` moves: the
    first number everywhere, the second where the frame before was not explained.
    """

    blur: float
    stiffness: float
    iterations: int
    relief: tuple = (0.0, 0.0)


# Soft edges first, so that the texture coordinates register to the image before lengths are
# enforced: in a stiff flat sheet that is compressed in the image, height has no first-order effect,
# and it would drift in depth instead of bending.
STAGES = (
    Stage(2.5, 1e2, 6, (0.0, _CLEAN)),
    Stage(1.5, 3e2, 4, (_CLEAN, _CLEAN)),
    Stage(1.0, 1e3, 3, (math.inf, math.inf)),
)
FAR = Stage(6.0, 1e2, 6)  # before the others where the sheet has moved far


class GaussNewton:
    """Second-order descent: Gauss-Newton curvatures of all terms, damped after Levenberg and
    Marquardt.

    A frame starts from the one before or from where its motion leads, whichever explains the image
    better. Where it ends with a misfit far above that of the frames before, other starts are tried:
    farther motion, and the rigid pose of the flat template by features. The order of the jet rises
    from the template's to at most ``order_max`` where the objective asks for it, and falls where it
    does not; a relief over the jet, a height of each vertex, holds folds that no jet can. In a
    window of several frames the newest is solved so, and then all together; ``revisit`` looks both
    ways from one frame.
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
        self._problem = None
        self._blas = (
            ThreadpoolController()
        )  # its own threads cost more than they bring on blocks this small, and wait for Dr.Jit's
        self._scales, self._fitting = {}, {}
        self._noise, self._unexplained = (
            math.nan,
            False,
            # of the frame at work: the least misfit before it, NaN in the first, where the template
            # has its shape
        )
        self._moved = False  # whether the frame at work starts far from its image
        self._light = Light.unknown()  # what the frames before say
        # weight of the difference to the anchor, motion included, where a frame is solved again
        self._hold = 0.0

    def solve(self, problem, window, frames, report=None, past=()):
        """Minimise over the last of ``frames``, then over all of them: :class:`Solution`.

        ``window``: their Unknowns, in a list; ``past``: of all frames before the last, oldest
        first, (arrays of ``Unknowns.to_numpy``, terms and facts); without it every frame of the
        window is new.
        """
        with self._blas.limit(limits=1, user_api="blas"):
            return self._solve(problem, window, frames, report, past)

    def _solve(self, problem, window, frames, report, past):
        if problem is not self._problem:
            self._prepare(problem)
        self._report, self._count = report, 0
        states = [self.chart.state(unknowns.to_numpy()) for unknowns in window]
        known = [terms for _, terms in past]
        before = [
            self.chart.state(arrays)
            for arrays, _ in past[: max(0, len(past) + 1 - len(frames))][-2:]
        ]
        self._fitting = self._scales_of(known[-1] if past else {})
        for k in range(len(frames) - 1 if past else 0, len(frames)):
            self._expect(frames[k])
            self._scales, self._fitting = self._fitting, {}
            least = self._remember(known)
            start = states[k] if past or k == 0 else states[k - 1]
            states[k], found = self._newest(start, frames[k], (before + states[:k])[-2:], known)
            found["least_misfit"] = self._least(least, found, frames[k]) if known else math.nan
            found["light"] = self._learned(found["model"], frames[k]).numbers()
            known.append(found)
        if len(frames) == 1:
            return self._solution(states, [found], found)
        orders = [int(terms.get("order") or found["order"]) for terms in known[-len(frames) :]]
        return self._solution(
            *self._joint(states, before[-1] if before else None, frames, orders), found
        )

    def revisit(self, problem, frame, before, after, terms, weight):
        """Solve a frame again, held to the middle of its neighbours: :class:`Solution`.

        ``before``, ``after``: arrays of ``Unknowns.to_numpy`` of the frames on either side;
        ``terms``: of the frame so far; ``weight``: of the squared difference to the middle.
        """
        with self._blas.limit(limits=1, user_api="blas"):
            return self._revisit(problem, frame, before, after, terms, weight)

    def _revisit(self, problem, frame, before, after, terms, weight):
        if problem is not self._problem:
            self._prepare(problem)
        self._report, self._count = None, 0
        self._scales, self._fitting, self._moved = self._scales_of(terms), {}, False
        least = self._remember([terms])
        a, b = self.chart.state(before), self.chart.state(after)
        middle = a.towards(b, -0.5)
        order = int(terms.get("order") or self.least)
        self._hold = weight
        try:
            state, found = self._descend(middle, middle, frame, order, STAGES)
        finally:
            self._hold = 0.0
        found["least_misfit"] = least
        found["light"] = self._light.numbers()
        return self._solution([state], [found], found)

    # -- preparation --------------------------------------------------------

    def _prepare(self, problem):
        self._problem = problem
        template = problem.template
        self.registration = Registration(problem)
        self.chart, self.least = Chart(template), template.fitted
        faces, count = self.registration.faces, len(template.vertices)
        across, bends = hinges(template.chart, faces)
        wide = Pattern(faces, template.edges, count, across)
        self.systems = {
            2: Blocks(self.registration.pattern),
            3: Blocks(wide, 3),
        }  # by the local unknowns of a vertex
        self.bends = bends
        self._has_relief = self.settings.k_relief > 0 and count <= _RELIEF_VERTICES
        self._relief_blocks = wide.laplacian + _RELIEF_BEND * wide.blocks_of(bends.T @ bends)
        self.lengths = np.array(problem.edge_lengths, dtype=np.float64)
        position, _ = problem.camera.project(template.vertices)
        unit = max(1.0, math.sqrt(areas(position, self.registration.faces).sum()) / _SHEET)
        self.levels = {}
        for stage in (FAR, *STAGES):
            sigma = stage.blur * unit
            self.levels[stage] = Level(
                sigma, max(1, int(0.8 * sigma)), max(_WINDOW * unit, 3 * sigma)
            )
        self._relocator = None
        self._report, self._count = None, 0
        self._noise, self._unexplained = math.nan, False
        if self.settings.texture_fit == "auto":
            self._fit_texture()

    def _fit_texture(self):
        """Where the template stands in the first frame but its texture does not lie where the image
        shows it, move the texture.

        Else the difference would be taken for stretch, and depth, in every frame.
        """
        chart, reg = self.chart, self.registration
        rest = chart.state(self._problem.patch.rest().to_numpy())
        self._expect(0)
        vertices = chart.surface(rest, 0).vertices
        before = reg.misfit(vertices, 0, self.levels[STAGES[-1]])
        if before < _TEXTURE_MISFIT:
            return
        state = rest
        for stage in STAGES[:2]:
            for _ in range(_TEXTURE_ITERATIONS):
                try:
                    normal, _terms = self._linearise(
                        state,
                        rest,
                        0,
                        self.least,
                        stage,
                        _FIRST_SCALE,
                        stiffness=_TEXTURE_STIFFNESS,
                    )
                    state = state.moved(
                        (np.zeros(len(normal.gradient)), self._reduced(normal, 1e-3).slide())
                    )
                except (BadFrame, LinAlgError):
                    return
        after = reg.misfit(chart.surface(state, 0).vertices, 0, self.levels[STAGES[-1]])
        if after < _TEXTURE_GAIN * before and np.abs(state.offset).max() < _TEXTURE_FARTHEST:
            reg.shift_texture(chart.template.chart, chart.template.chart + state.offset[:, :2])

    def _remember(self, known):
        """What the frames before (their terms) say of noise and light: sets them, and returns the
        least misfit, NaN where only the first is known."""
        misfit, least = (
            next((t[name] for t in reversed(known) if t.get(name) is not None), math.nan)
            for name in ("misfit", "least_misfit")
        )
        self._noise = misfit if math.isnan(least) else least
        self._unexplained = self._is_unexplained(misfit)
        self._light = Light.of(
            next((t["light"] for t in reversed(known) if t.get("light") is not None), None)
        )
        return least

    def _least(self, least, found, frame):
        """The least misfit after a frame whose terms are ``found``, of the texture as the template
        has it: what the camera's blur makes of it is no noise."""
        if found["misfit"] > least:
            return least
        return float(
            np.fmin(
                least,
                self.registration.misfit(
                    found["model"].surface.vertices, frame, self.levels[STAGES[-1]]
                ),
            )
        )

    def _expect(self, frame):
        """Have this frame and the next one read in a second thread."""
        for k in (frame, frame + 1):
            if k < len(self._problem.sequence):
                self.registration.expect(
                    [k],
                    [*(self.levels[s] for s in STAGES), *[SHADE] * (self.settings.k_shading > 0)],
                )

    def _learned(self, model, frame):
        """What is known of the light after a frame, whose last :class:`Model` this is."""
        if not self.settings.k_shading:
            return self._light
        return self._light.learned(
            self.registration.shade(
                model.surface.vertices, frame, model.evaluation.seen, model.appearance
            )
        )

    # -- one frame ----------------------------------------------------------

    def _newest(self, start, frame, history, past):
        """(state, terms) of a frame that starts at ``start``; ``history``: states of the one or two
        frames before.
        """
        anchor = history[-1] if history else start
        starts = [start]
        if len(history) > 1:
            starts += [history[-2].towards(history[-1], f) for f in (0.5, 1.0)]
        orders = [t["order"] for t in past if t.get("order") is not None]
        order = int(orders[-1]) if orders else self.least
        nearest, misfit = self._nearest(starts, frame, STAGES[0])
        self._moved = misfit > _MOVED
        best = self._descend(nearest, anchor, frame, order, STAGES)
        limit = self._suspect_above(past)
        if best[1]["misfit"] > limit:
            self.registration.expect([frame], [self.levels[FAR]])
            self._moved = True
            for other in (
                lambda: self._nearest(starts, frame, FAR)[0],
                lambda: self._relocate(frame),
            ):
                if (other := other()) is not None:
                    found = self._descend(other, anchor, frame, order, (FAR, *STAGES), _PATIENT)
                    if found[1]["pixels"] > _SHOWN * best[1]["pixels"]:
                        best = min(best, found, key=_cost)
                if best[1]["misfit"] <= limit:
                    break
        tried = past[-1].get("bulge") or 0.0 if past else 0.0
        best, bulge = self._turned_over(*best, frame, order, tried)
        state, terms = self._adapt_order(*best, anchor, frame)
        terms["bulge"] = bulge
        return self.chart.absorbed(state, self.least), terms

    def _suspect_above(self, past):
        """The misfit above which a frame is suspect, after those whose terms are ``past``: infinite
        while these are too few to tell.
        """
        usual = [t["misfit"] for t in past[-_MEMORY:] if t.get("misfit") is not None]
        if len(usual) < 3:
            return math.inf
        noise = min(self._noise, *usual)
        return noise + _SUSPECT * (np.median(usual) - noise) + _SUSPECT_MARGIN

    def _reduced(self, normal, damping, dtype=np.float64):
        return Reduced(self.systems[normal.local.shape[-1]], normal, damping, dtype)

    def _turned_over(self, state, terms, frame, order, tried):
        """(state, terms), or those of its mirror twin where that explains the frame better; and the
        greatest bulge at which the twin was ``tried``.

        Seen from afar, a bulge towards the camera looks like one away from it. Which way a sheet
        starts to bulge is a matter of chance, and only when it has gone far does the perspective
        tell; by then no small step leads to the other side.
        """
        bulge, twin = self._twin(state, order)
        if bulge < _BULGE:
            return (state, terms), 0.0
        if bulge < _BULGE_GROWTH * tried:
            return (state, terms), tried
        fitting = dict(self._fitting)
        found = self._stages(
            twin, twin, frame, order, STAGES
        )  # once: most twins are wrong, and no repetition mends them
        if (
            _cost(found) < (1 - _TWIN_GAIN) * _cost((state, terms))
            and found[1]["pixels"] > _SHOWN * terms["pixels"]
        ):
            return found, bulge
        self._fitting = fitting
        return (state, terms), bulge

    def _twin(self, state, order):
        """How far the sheet bulges, and the state that bulges the other way.

        The first: RMS of the depths less those of the template, laid over the sheet as a rigid
        body, over the template's unit of length. The second has the opposite differences, and its
        vertices along the same rays.
        """
        template, camera = self.chart.template, self._problem.camera
        vertices = self.chart.surface(state, 0).vertices
        centre, middle = template.vertices.mean(0), vertices.mean(0)
        motion, _ = Rotation.align_vectors(vertices - middle, template.vertices - centre)
        depth, flat = (
            camera.to_camera(x)[:, 2]
            for x in (vertices, motion.apply(template.vertices - centre) + middle)
        )
        turned = camera.origin + (vertices - camera.origin) * ((2 * flat - depth) / depth)[:, None]
        twin = self.chart.through(state, turned, order)
        if not self._has_relief:
            twin.offset[:, 2] = 0.0
        return float(np.sqrt(np.mean((depth - flat) ** 2))) / template.scale, twin

    def _nearest(self, starts, frame, stage):
        """The start that explains the frame best, and its misfit."""
        misfits = [
            self.registration.misfit(
                self.chart.surface(state, 0).vertices, frame, self.levels[stage]
            )
            for state in starts
        ]
        k = int(np.argmin(misfits))
        return starts[k], misfits[k]

    def _relocate(self, frame):
        """The flat template in the pose that its features have in the frame; None where too few are
        found.
        """
        if self._relocator is None:
            self._relocator = Relocator(self.registration)
        motion = self._relocator.pose(self._problem.sequence.frame(frame))
        if motion is None:
            return None
        rest = self.chart.state(self._problem.patch.rest().to_numpy())
        return State(rest.alpha, rest.offset, *self.chart.rigid(*motion))

    def _descend(self, state, anchor, frame, order, stages, iterations=None):
        """Stage after stage, each of its own or so many ``iterations``, more while they gain much;
        and where that leaves more than noise, the fine stages again, as long as they explain more,
        each time from where the last led and as far again: (state, terms).
        """
        state, terms = self._stages(state, anchor, frame, order, stages, iterations)
        start = state
        for _ in range(_AGAIN):
            if not (
                self._noise < _CLEAN
                and terms["misfit"] > max(_UNEXPLAINED, _AGAIN_ABOVE * self._noise)
            ):
                break
            fitting, before = dict(self._fitting), (state, terms)
            state, terms = self._stages(start, anchor, frame, order, STAGES[1:], iterations)
            gain = 1 - _cost((state, terms)) / _cost(before)
            if gain <= 0:
                self._fitting = fitting
                return before
            if gain < _AGAIN_GAIN:
                break
            start = before[0].towards(
                state, 1.0
            )  # as far again: what is behind comes closer by a like share each time
        return state, terms

    def _stages(self, state, anchor, frame, order, stages, iterations=None):
        """Stage after stage, each once: (state, terms)."""
        for stage in stages:
            state, terms = self._stage(
                state, anchor, frame, order, stage, iterations or stage.iterations
            )
        return state, terms

    def _is_unexplained(self, misfit):
        """Whether a misfit is more than noise: the surface, or its jet, does not follow what the
        frame shows.
        """
        return misfit > max(_UNEXPLAINED, _UNEXPLAINED_FACTOR * self._noise)

    def _stage(self, state, anchor, frame, order, stage, iterations):
        """Levenberg-Marquardt at one stage: (state, terms). Its robust scale is the one that fitted
        the frame before.
        """
        scale = self._scales.get(stage, _FIRST_SCALE)
        appearance = self._appearance(state, order, stage)
        normal, terms = self._linearise(state, anchor, frame, order, stage, scale, appearance)
        damping, least, gained = _DAMPING[normal.local.shape[-1]], _SHOWN * terms["pixels"], 0.0
        for k in range(_FARTHER * iterations):
            if k >= iterations and gained < _GOING * terms["total"]:
                break
            gained = 0.0
            try:
                step, promised = self._reduced(normal, damping, np.float32).step()
                _check_step(step)
            except LinAlgError:
                damping = max(10 * damping, 1e-4)
                continue
            if promised < _SMALL * terms["total"]:
                state = state.moved(step)
                break
            trial = state.moved(step)
            found = self._linearise(trial, anchor, frame, order, stage, scale, appearance)
            if found[1]["total"] < terms["total"] and found[1]["pixels"] > least:
                gained = terms["total"] - found[1]["total"]
                if gained > 0.5 * promised:
                    damping = max(damping / 5, 1e-7)
                state, (normal, terms) = trial, found
            else:
                damping *= 10
        self._fitting[stage] = self._robust_scale(terms["outlying"], scale)
        return state, terms

    # -- a window -----------------------------------------------------------

    def _joint(self, states, before, frames, orders):
        """Levenberg-Marquardt on all frames of a window together, at the last stage: (states, terms
        of each).

        ``before``: the state of the frame before the window, which stays, or None; ``orders``: of
        the frames' jets.
        """
        states, damping = list(states), 1e-4
        appearances = [self._appearance(state, n, STAGES[-1]) for state, n in zip(states, orders)]
        models = self._window(states, before, frames, orders, appearances)
        total = sum(terms["total"] for _, terms in models)
        for _ in range(_JOINT):
            try:
                steps, promised = self._window_step(models, damping)
            except LinAlgError:
                damping = max(10 * damping, 1e-4)
                continue
            trial = [state.moved(step) for state, step in zip(states, steps)]
            if promised < _SMALL * total:
                states, models = trial, self._window(trial, before, frames, orders, appearances)
                break
            found = self._window(trial, before, frames, orders, appearances)
            now = sum(terms["total"] for _, terms in found)
            if now < total:
                states, models, total, damping = trial, found, now, max(damping / 5, 1e-7)
            else:
                damping *= 10
        return states, [terms for _, terms in models]

    def _window(self, states, before, frames, orders, appearances):
        """(Normal, terms) of every frame: the whole gradient of the window, of its curvature what
        lies within a frame.

        What couples two frames counts among the terms of the later one, and pulls both.
        """
        stage = STAGES[-1]
        scale = self._scales.get(stage, _FIRST_SCALE)
        anchors = [before if before is not None else states[0], *states[:-1]]
        models = [
            self._linearise(s, a, f, n, stage, scale, x)
            for s, a, f, n, x in zip(states, anchors, frames, orders, appearances)
        ]
        temporal = 2 * self.settings.k_tc * _TEMPORAL
        for (earlier, _), (later, _), a, b, n in zip(
            models, models[1:], states, states[1:], orders
        ):
            size = self.chart.size(n)
            earlier.gradient[:size] -= temporal * (b.alpha - a.alpha)[:size]
            earlier.glob[:size, :size] += temporal * np.eye(size)
            d = earlier.local.shape[-1]
            earlier.local_gradient -= temporal * (b.offset - a.offset)[:, :d]
            # the displacements' coupling, weak beside the image, by its bound |a - b|^2 <= 2 |a|^2
            # + 2 |b|^2: the local blocks stay apart
            diagonal = self.systems[d].pattern.diagonal
            for k in range(d):
                earlier.local[diagonal, k, k] += 2 * temporal
                later.local[diagonal, k, k] += temporal
        return models

    def _window_step(self, models, damping):
        """The steps of all frames, and the decrease that they promise. The global unknowns are
        coupled from frame to frame: a block-banded system.
        """
        reduced = [self._reduced(normal, damping) for normal, _ in models]
        start = np.cumsum([0] + [len(r.right) for r in reduced])
        matrix = block_diag(*(r.schur for r in reduced))
        temporal = 2 * self.settings.k_tc * _TEMPORAL
        for k in range(len(reduced) - 1):
            both = np.arange(min(len(reduced[k].right), len(reduced[k + 1].right)) - 6)
            matrix[start[k] + both, start[k + 1] + both] -= temporal
            matrix[start[k + 1] + both, start[k] + both] -= temporal
        g = -cho_solve(
            cho_factor(matrix, check_finite=False),
            np.concatenate([r.right for r in reduced]),
            check_finite=False,
        )
        parts = np.split(g, start[1:-1])
        steps = [(part, r.following(part)) for part, r in zip(parts, reduced)]
        for step in steps:
            _check_step(step)
        return steps, sum(r.promised(part) for r, part in zip(reduced, parts))

    # -- one stage ----------------------------------------------------------

    @staticmethod
    def _scales_of(terms):
        """The robust scale of each stage that a frame left behind."""
        return {
            stage: terms.get(f"scale_{k}") or _FIRST_SCALE for k, stage in enumerate((FAR, *STAGES))
        }

    @staticmethod
    def _robust_scale(outlying, scale):
        """The scale at which a residual of 2/3 of it is the median, were the residuals'
        distribution only stretched.
        """
        m = min(max(outlying, 0.02), 0.98)
        return float(np.clip(scale * math.sqrt(m / (1 - m) / 0.44), *_SCALES))

    def _appearance(self, state, order, stage):
        """The :class:`polysft_mi.images.registration.Appearance` of the sheet in a stage that
        begins at ``state``; None where the sheet has yet to move far."""
        if stage is FAR:
            return None
        lit = (
            self.registration.normalise and self._light.frames
        )  # colours as they are say that there is no light
        light = self._light.coefficients(len(self.registration.faces)) if lit else None
        shaded = self.settings.k_shading > 0 and stage is STAGES[-1]
        return self.registration.appearance(
            self.chart.surface(state, order).vertices, self.levels[stage], light, shaded
        )

    def _linearise(
        self,
        state,
        anchor,
        frame,
        order,
        stage,
        scale,
        appearance=None,
        stiffness=None,
        evaluation=None,
    ):
        """(Normal, terms) of the whole objective at a state, whose ``evaluation`` may be known.
        Raises BadFrame where it is not finite.
        """
        s, chart = self.settings, self.chart
        surface = chart.surface(state, order)
        known = evaluation is not None
        if not known:
            evaluation = self.registration.evaluate(
                surface.vertices, frame, self.levels[stage], scale, appearance
            )
        caution = 1 + min(
            (np.nan_to_num(self._noise) / _NOISE_MISFIT) ** _NOISE_POWER, _NOISE_MOST
        )  # before what may be noise
        give = (
            math.inf
            if stiffness is not None or (self._moved and stage in (FAR, STAGES[0]))
            else _GIVE * caution
        )
        stiffness = (
            s.k_mi * (stage.stiffness if stiffness is None else stiffness) / chart.template.scale**2
        )
        d = 3 if self._has_relief and self._noise < stage.relief[self._unexplained] else 2
        relief = s.k_relief * caution
        pattern = self.systems[d].pattern
        wide = pattern if d == 3 else None
        shading, rows = 0.0, None
        if (
            s.k_shading > 0 and stage is STAGES[-1] and self._light.frames
        ):  # before, lengths are soft, and shading would bend what they should
            shade = self.registration.shade(surface.vertices, frame, evaluation.seen, appearance)
            shading, *rows = residuals(shade, self._light, s.k_shading)
        normal, inextensibility = self.registration.assembly.normal(
            surface, evaluation.images, self.lengths, stiffness, wide, give, rows
        )
        a = self.chart.size(order)
        bend = 2 * s.k_bend * chart.bending
        moved, slid = state.alpha - anchor.alpha, state.offset - anchor.offset
        temporal = s.k_tc * _TEMPORAL + self._hold
        normal.glob[:a, :a] += bend[:a, :a] + 2 * temporal * np.eye(a)
        normal.gradient[:a] += (bend @ state.alpha + 2 * temporal * moved)[:a]
        motion = np.concatenate(
            [
                (state.rotation * anchor.rotation.inv()).as_rotvec(),
                state.translation - anchor.translation,
            ]
        )
        normal.glob[a:, a:] += 2 * self._hold * np.eye(6)
        normal.gradient[a:] += 2 * self._hold * motion
        # neighbours' differences, of the relief its bends too
        apart, bent = pattern.difference @ state.offset, self.bends @ state.offset[:, 2]
        weights = np.array([s.k_uv, s.k_uv, relief])
        pull = weights * (pattern.to_ends @ apart)
        pull[:, 2] += relief * _RELIEF_BEND * (self.bends.T @ bent)
        normal.local_gradient += 2 * (pull + s.k_tc * _TEMPORAL * slid)[:, :d]
        for k, blocks in enumerate((pattern.laplacian, pattern.laplacian, self._relief_blocks)[:d]):
            normal.local[:, k, k] += 2 * weights[k] * blocks
            normal.local[pattern.diagonal, k, k] += 2 * s.k_tc * _TEMPORAL
        terms = {
            "rgb": evaluation.photometric,
            "silhouette": evaluation.silhouette,
            "shading": shading,
            "inextensibility": inextensibility,
            "temporal": (
                temporal * float((moved**2).sum())
                + s.k_tc * _TEMPORAL * float((slid**2).sum())
                + self._hold * float((motion**2).sum())
            ),
            "smoothness": (
                s.k_bend * float(state.alpha @ chart.bending @ state.alpha)
                + float((weights * apart**2).sum() + relief * _RELIEF_BEND * (bent**2).sum())
            ),
        }
        total = sum(terms.values())
        if not math.isfinite(total):
            raise BadFrame(frame, total)
        if not known:
            if self._report:
                self._report(self._count, total, terms)
            self._count += 1
        # what the residuals' own size says of their noise; pixels closer than the blur are no
        # evidence of their own
        level = self.levels[stage]
        noise = (
            2
            * evaluation.photometric
            / (3 * max(evaluation.pixels, 1.0))
            * max(1.0, 4 * math.pi * level.sigma**2)
        )
        facts = {
            "misfit": evaluation.misfit,
            "outlying": evaluation.outlying,
            "pixels": evaluation.pixels,
            "order": order,
        }
        facts["model"] = Model(state, surface, evaluation, normal, noise, appearance)
        return normal, {**terms, "total": total, **facts}

    # -- order --------------------------------------------------------------

    def _adapt_order(self, state, terms, anchor, frame):
        """Raise the order where the model says that it pays, lower it where it does not, and go on
        from there: (state, terms).
        """
        s, order = self.settings, int(terms["order"])
        return (
            (order < s.capacity and self._raised(state, terms, anchor, frame, order))
            or (order > self.least and self._lowered(state, terms, anchor, frame, order))
            or (state, terms)
        )

    def _raised(self, state, terms, anchor, frame, order):
        """(state, terms) with more coefficients; None where they do not pay."""
        stage, model, top = (
            STAGES[-1],
            terms["model"],
            min(order + _ORDER_STEP, self.settings.capacity),
        )
        wide, _ = self._linearise(
            model.state,
            anchor,
            frame,
            top,
            stage,
            self._scales.get(stage, _FIRST_SCALE),
            model.appearance,
            evaluation=model.evaluation,
        )
        try:
            reduced = self._reduced(wide, _UNDAMPED)
            model.reduced = reduced.lower(self.chart.size(order))
            promised = reduced.decrease() - model.reduced.decrease()
        except LinAlgError:
            return None
        if promised <= _RAISE * terms["total"]:
            return None
        found = self._descend(state, anchor, frame, top, STAGES[1:])
        return found if found[1]["total"] < (1 - 0.5 * _RAISE) * terms["total"] else None

    def _lowered(self, state, terms, anchor, frame, order):
        """(state, terms) without the highest coefficients; None where they are worth their
        place.
        """
        lower = max(order - _ORDER_STEP, self.least)
        size = self.chart.size(lower)
        worth = _LOWER * terms["model"].noise * (self.chart.size(order) - size)
        try:
            reduced = self._undamped(terms["model"])
            g, expected = reduced.without(size, state.alpha)
        except LinAlgError:
            return None
        if expected > worth:
            return None
        state = state.moved((g, reduced.following(g) - reduced.slide()))
        state.alpha[size:] = 0.0
        found = self._stage(state, anchor, frame, lower, STAGES[-1], STAGES[-1].iterations)
        return found if found[1]["total"] < terms["total"] + worth else None

    def _undamped(self, model):
        model.reduced = model.reduced or self._reduced(model.normal, _UNDAMPED)
        return model.reduced

    # -- results ------------------------------------------------------------

    def _solution(self, states, found, newest):
        """:class:`Solution` of a window: its states, the terms of each, and those of its newest
        frame when it was solved.
        """
        names = [name for name in found[0] if name not in (*_FACTS, "pixels", "model", "total")]
        terms = {name: float(np.mean([f[name] for f in found])) for name in names}
        facts = {name: newest.get(name, math.nan) for name in _FACTS}
        facts |= {
            f"scale_{k}": self._fitting.get(stage, _FIRST_SCALE)
            for k, stage in enumerate((FAR, *STAGES))
        }
        window = [Unknowns.from_numpy(self.chart.arrays(state)) for state in states]
        return Solution(
            window,
            sum(terms.values()),
            terms,
            self._count,
            facts,
            [self._sigma(f["model"]) for f in found],
        )

    def _sigma(self, model):
        """Standard deviation (N,) [m, float32] of each vertex along its ray, from the curvatures of
        the whole objective: NaN where they are singular.
        """
        surface = model.surface
        ray = surface.vertices - self._problem.camera.origin
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        by_global = np.column_stack(
            [
                (ray @ surface.up)[:, None] * surface.basis,
                np.einsum("nk,nkm->nm", ray, surface.by_motion),
            ]
        )
        try:
            by_local = np.einsum("nk,nka->na", ray, surface.by_offset)[
                :, : model.normal.local.shape[-1]
            ]
            variance = self._undamped(model).variance(by_local, by_global)
        except (LinAlgError, np.linalg.LinAlgError):
            variance = np.full(len(ray), np.nan)
        return np.sqrt(model.noise * variance).astype(np.float32)
