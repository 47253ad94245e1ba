"""The objective: the sum of the terms that have a weight, over a frame or a window of frames.

:class:`Objective` knows the terms; :class:`FrozenObjective` is what a solver minimises: the
objective of some frames at a stage, all scales frozen. Any solver takes it: it has value and
gradient by Dr.Jit's automatic differentiation through Mitsuba (:meth:`FrozenObjective.evaluate`),
and, where all of its terms have one, a quadratic model in closed form
(:meth:`FrozenObjective.quadratic`). Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from polysft_mi.errors import BadFrame
from polysft_mi.render import Occluder

from .context import FrameContext, Stage, stages_of
from .quadratic import Assembly, EdgeRows, Linearisation, QuadraticModel
from .terms import TERMS, Cameras, DeviceFrame, Inputs, Temporal, Term
from .visibility import VisibilityWeights

if TYPE_CHECKING:
    from polysft_mi.images import Appearance, DataTerm
    from polysft_mi.images.light import Light
    from polysft_mi.surface import State

    from .problem import Problem


_POSE_ERROR = 0.02  # [m] by which a body's limbs may stand elsewhere


class Objective:
    """The terms of a :class:`polysft_mi.objective.problem.Problem`.

    The problem's ``patch`` may be anything that makes vertices of unknowns; then the terms of jets
    must have no weight. Raises InputError where a term does not fit the template.
    """

    def __init__(self, problem: Problem) -> None:
        self.settings, self.rules = problem.settings, problem.rules
        self.problem, self.atlas = problem, problem.atlas
        p = problem
        sheet, where = (p.template, p.patch, p.atlas), (p.placed, p.sequence, p.experiment.path)
        self.inputs = Inputs(p.settings, p.rules, *sheet, *where)
        chosen = [kind for kind in TERMS if kind.is_used(self.settings)]
        self.terms: list[Term] = [kind(self.inputs) for kind in chosen]
        #: the stage for a sheet that moved far, and the usual ones, coarse to fine
        self.far, self.usual = stages_of(self.settings, self.rules)
        #: all of them
        self.stages = tuple(dict.fromkeys((self.far, *self.usual)))
        few = len(problem.template.vertices) <= self.rules.relief_vertices
        self.has_relief = self.settings.k_relief > 0 and few
        self._assembly: Assembly | None = None
        self._occluders: list[Occluder] | None = None

    @property
    def data(self) -> DataTerm:
        """The frames against the baked texture, in closed form."""
        return self.inputs.data

    @property
    def temporal(self) -> Temporal | None:
        """The term that ties frames to each other, where there is one."""
        return next((term for term in self.terms if isinstance(term, Temporal)), None)

    @property
    def cameras(self) -> Cameras | None:
        """The term of the cameras beside the scene's own, where there are some."""
        return next((term for term in self.terms if isinstance(term, Cameras)), None)

    @property
    def without_block(self) -> str | None:
        """The first term that has no quadratic model, and why, in words; None where all have."""
        if not self.problem.placed.is_raster:
            name = self.problem.experiment.renderer.class_name()
            return f"rgb is rendered by {name}; raster is needed"
        for term in self.terms:
            if reason := term.without_block:
                return f"{term.name} has {reason}"
        return None

    def d(self, context: FrameContext, stage: Stage) -> int:
        """Local unknowns of a vertex: 3 where its relief moves, or 2."""
        moves = self.has_relief and stage.relief and not self.is_known(context)
        return 3 if moves else 2

    def is_known(self, context: FrameContext) -> bool:
        """Whether the surface has the template's shape in a frame: the first, but on a body."""
        return context.is_first and self.atlas.carrier is None

    def _place_body(self, state):
        """Let the body that carries a state hide the surface, in all cameras."""
        carrier = self.atlas.carrier
        if carrier is None or state.pose is None:
            return
        vertices, faces = carrier.body(state.pose), carrier.skin[2]
        views = [self.inputs, *(self.cameras.views if self.cameras else ())]
        if self._occluders is None:
            self._occluders = [Occluder(faces, len(vertices), x.placed.sensor) for x in views]
        for view, occluder in zip(views, self._occluders, strict=True):
            depth = occluder.depth(vertices)
            away = np.linalg.norm(vertices.mean(0) - view.placed.camera.origin)
            reach = _POSE_ERROR * view.placed.camera.focal / away
            view.data.hide(depth, state.pose.frame, reach)

    def visibility(self, state: State) -> VisibilityWeights:
        """The weights of what no pixel sees of a surface."""
        self._place_body(state)
        operators = self.inputs.operators
        if self.rules.unseen == 1:
            return operators.all_seen
        vertices = self.atlas.surface(state).vertices
        return VisibilityWeights.of(self.seen(vertices), self.rules.unseen, operators)

    def seen(self, vertices: np.ndarray) -> np.ndarray:
        """Which vertices (N, 3) [m, world] of a surface some camera sees, (N,) bool."""
        views = [self.inputs, *(self.cameras.views if self.cameras else ())]
        blur = self.usual[-1].blur
        return np.any([view.data.seen_vertices(vertices, blur) for view in views], axis=0)

    def move_texture(self, chart: np.ndarray, displaced: np.ndarray) -> None:
        """Show what lies at ``chart`` (N, 2) at ``displaced`` (N, 2) instead, in all cameras."""
        for view in [self.inputs, *(self.cameras.views if self.cameras else ())]:
            view.data.move_texture(chart, displaced)

    def appearance(self, state: State, stage: Stage, light: Light) -> Appearance | None:
        """How a sheet looks at the start of a stage, under a ``light``; None where the sheet has
        yet to move far.
        """
        if stage.blur == self.rules.far_blur or not self.rules.appearance:
            return None
        # colours as they are say that there is no light
        lit = self.data.normalise and light.is_known
        coefficients = light.coefficients(len(self.data.faces)) if lit else None
        shaded = self.settings.compares_triangles and stage.last
        vertices = self.atlas.surface(state).vertices
        found = self.data.appearance(vertices, stage.blur, coefficients, shaded)
        if self.cameras:
            found.others = self.cameras.looks(vertices, stage)
        return found

    def quadratic(
        self, state: State, context: FrameContext, stage: Stage, appearance: Appearance | None
    ) -> QuadraticModel:
        """The :class:`QuadraticModel` of one frame at a state. Raises BadFrame where it is not
        finite.
        """
        s, surface = self.settings, self.atlas.surface(state)
        scale = self.scale(context, stage)
        evaluation = self.data.evaluate(
            surface.vertices, context.frame, stage.blur, scale, appearance, s.k_rgb, s.k_silhouette
        )
        operators, d = self.inputs.operators, self.d(context, stage)
        if self._assembly is None:  # its tables take a while
            self._assembly = Assembly(self.data.pattern, self.data.gather, self.atlas)
        no_edges = EdgeRows(np.ones(len(self.problem.template.edges)))
        diagonal = operators.patterns[d].diagonal
        at = Linearisation(
            state, surface, context, stage, d, diagonal, evaluation, no_edges, appearance
        )
        at.images.append((evaluation.images, self.data.gather.camera))
        for term in self.terms:
            term.rows(at)
        at.normal, at.edge_energy = self._assembly.normal(
            surface, at.images, at.edges, at.triangles, operators.patterns[d], d, at.at_rest
        )
        terms = {term.name: term.add(at) for term in self.terms}
        total = sum(terms.values())
        if not math.isfinite(total):
            raise BadFrame(context.frame, total)
        measure = sum(terms[term.name] for term in self.terms if not term.is_noise)
        equations = at.normal, terms, total, measure
        return QuadraticModel(state, surface, evaluation, *equations, appearance)

    def scale(self, context: FrameContext, stage: Stage) -> float:
        """The robust scale of a frame's residuals: the one that fitted the frame before, or the
        setting's.
        """
        return context.memory.scale(stage, self.settings.rgb_scale)

    def nat_and_colours(self, context: FrameContext, model: QuadraticModel) -> tuple[float, float]:
        """By the residuals of a frame at the last stage: what one unit of log-likelihood of the
        images costs, were the colours of a pixel independent, from the residuals' size and how many
        numbers of a colour count as one; and how many of a pixel's three colours do, 1 to 3.
        """
        vertices, blur = model.surface.vertices, self.usual[-1].blur
        alike, colours = self.data.numbers_as_one(vertices, context.frame, blur, model.appearance)
        return model.evaluation.noise * alike, colours

    def frozen(
        self, contexts: Sequence[FrameContext], stage: Stage, start: Sequence[State]
    ) -> FrozenObjective:
        """What a solver minimises from the states ``start`` on: the objective of the frames of
        ``contexts`` at a stage.
        """
        for state in start:
            self._place_body(state)
        return FrozenObjective(self, contexts, stage, start)

    def observe(self, frame: int, vertices: np.ndarray) -> None:
        """Take in the surface (N, 3) [m, world] of a frame that was solved; frames come in their
        order.
        """
        for term in self.terms:
            term.observe(frame, vertices)

    def matches(self, frame: int, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (P, 3) [m] of a surface (N, 3) [m, world], and where evidence has them in a frame,
        (P, 2) [pixels].
        """
        known = [term.matches(frame, vertices) for term in self.terms]
        points, pixels = zip((np.zeros((0, 3)), np.zeros((0, 2))), *known, strict=True)
        return np.concatenate(points), np.concatenate(pixels)

    def noises(self, context: FrameContext, vertices: np.ndarray) -> dict[str, float]:
        """What the surface (N, 3) [m, world] that was found of a frame says of the noise of each
        kind of evidence beside the images.
        """
        found: dict[str, float] = {}
        for term in self.terms:
            found |= term.noise(context, vertices, self.usual[-1])
        return found

    def fits(self, surfaces: np.ndarray) -> dict[str, dict[str, float]]:
        """How each kind of evidence beside the images fits the surfaces (T, N, 3) [m, world] that
        were found, by the names of the terms.
        """
        found = {term.name: term.fit(surfaces, self.usual[-1]) for term in self.terms}
        return {name: figures for name, figures in found.items() if figures}

    def check_gradient(self) -> None:
        """Raise RuntimeError where the renderer cannot be differentiated; Mitsuba tells only when
        it is.
        """
        unknowns = self.inputs.surface.rest()
        dr.enable_grad(unknowns)
        rest = self.atlas.state(unknowns.to_numpy())
        frozen = self.frozen([FrameContext(0)], self.usual[-1], [rest])
        frozen.evaluate([unknowns], backward=True)


class FrozenObjective:
    """The objective of a window of frames at a ``stage``: the mean of the frames' terms, and of
    what ties each frame to the one before it. What is frozen stands in ``contexts``, and in how
    the sheets look at ``start``; the first frame's anchor is the frame before the window, where
    there is one, the others' are the frames of the window.
    """

    def __init__(
        self,
        objective: Objective,
        contexts: Sequence[FrameContext],
        stage: Stage,
        start: Sequence[State],
    ) -> None:
        count, outside = len(contexts), contexts[0].anchor is not None
        #: a mean over the ties, where frames are averaged, too
        self._tie = count / max(count - 1 + outside, 1)
        self.contexts = [replace(context, tie=self._tie) for context in contexts]
        self.objective, self.stage = objective, stage
        self.atlas, self._start = objective.atlas, list(start)

    @cached_property
    def appearances(self) -> list[Appearance | None]:
        """Of the frames' sheets as they are where the stage begins."""
        rules = self.objective.rules
        return [
            self.objective.appearance(state, self.stage, context.light(rules))
            for state, context in zip(self._start, self.contexts, strict=True)
        ]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its terms."""
        return tuple(term.name for term in self.objective.terms)

    @property
    def d(self) -> int:
        """Local unknowns of a vertex: 3 where the relief moves, or 2."""
        return self.objective.d(self.contexts[0], self.stage)

    # -- to first order, by automatic differentiation ---------------------------

    def evaluate(
        self, window: Sequence[Any], *, backward: bool = False, seed: int = 0
    ) -> tuple[float, dict[str, float]]:
        """(total, terms) at the :class:`polysft_mi.surface.patch.Unknowns` of each frame; with
        ``backward``, the gradients are added to them.

        Each frame's graph is traversed and freed before the next. Raises BadFrame where a frame's
        part is not finite.
        """
        sums = dict.fromkeys(self.names, 0.0)
        count = len(window)
        for k, unknowns in enumerate(window):
            values = {
                name: value / count
                for name, value in self._energies(unknowns, k, seed + 2 * k).items()
            }
            self._finish(values, backward, sums, self.contexts[k].frame)
        temporal = self.objective.temporal
        if temporal is not None and count > 1:
            for k in range(1, count):
                value = self._tie / count * temporal.between(window[k - 1], window[k])
                self._finish({temporal.name: value}, backward, sums, self.contexts[k].frame)
        return sum(sums.values()), sums

    def _energies(self, unknowns, k, seed):
        """The weighted terms of frame ``k``, name to Float of 1, attached."""
        inputs, context = self.objective.inputs, self.contexts[k]
        look = lambda: self.appearances[k]
        frame = DeviceFrame(inputs, unknowns, context, self.stage, look, seed)
        found = {term.name: term.energy(frame) for term in self.objective.terms}
        if not inputs.placed.is_raster:
            # path replay traces the scene once more for its gradient, and a term may have moved it
            inputs.placed.place(frame.vertices)
        return found

    @staticmethod
    def _finish(terms, backward, sums, frame):
        loss = sum(terms.values())
        values = {name: dr.detach(value) for name, value in terms.items()}
        dr.schedule(values)
        if backward and dr.grad_enabled(loss):  # a weight of zero detaches
            dr.backward(loss)
        dr.eval()
        for name, value in values.items():
            sums[name] += float(value[0])
        total = sum(float(value[0]) for value in values.values())
        if not math.isfinite(total):
            raise BadFrame(frame, total)

    # -- to second order, in closed form ----------------------------------------

    def quadratic(self, states: Sequence[State]) -> list[QuadraticModel]:
        """The quadratic models of all frames: the whole gradient of the window; of its curvature
        what lies within a frame (:meth:`coupling` is the rest). They are those of the sum over the
        frames, not of the mean. Raises BadFrame where one is not finite.
        """
        first = self.contexts[0]
        anchors = [first.anchor, *states[:-1]]
        models = [
            self.objective.quadratic(state, replace(context, anchor=anchor), self.stage, look)
            for state, anchor, context, look in zip(
                states, anchors, self.contexts, self.appearances, strict=True
            )
        ]
        for earlier, later in itertools.pairwise(models):
            self._couple(earlier, later)
        return models

    @property
    def coupling(self) -> np.ndarray:
        """Minus what couples the coefficients of a frame to those of the next in the curvature,
        (K A, K A); :func:`jet_unknowns` says where they stand.
        """
        temporal, count = self.objective.temporal, len(self.atlas)
        size = len(self.atlas.to_monomials)
        form = np.zeros((size, size)) if temporal is None else temporal.weight * temporal.form
        return np.kron(np.eye(count), 2 * self._tie * form)

    def _couple(self, earlier, later):
        """Add what holds the later frame to the earlier one to the equations of that."""
        normal, weight = earlier.normal, 2 * self._tie * self.objective.settings.k_tc
        jets, a, b = jet_unknowns(earlier.state), earlier.state, later.state
        coupling = self.coupling
        normal.gradient[jets] -= coupling @ (b.alpha - a.alpha).ravel()
        normal.glob[np.ix_(jets, jets)] += coupling
        d = normal.local.shape[-1]
        normal.local_gradient -= weight * (b.offset - a.offset)[:, :d]
        # the displacements' coupling, weak beside the image, by its bound
        # |a - b|^2 <= 2 |a|^2 + 2 |b|^2: the local blocks stay apart
        diagonal = self.objective.inputs.operators.patterns[d].diagonal
        for k in range(d):
            normal.local[diagonal, k, k] += 2 * weight
            later.normal.local[diagonal, k, k] += weight


def jet_unknowns(state: State) -> np.ndarray:
    """Which of a frame's global unknowns are coefficients, (K A,)."""
    patches, size = state.alpha.shape
    return (np.arange(patches)[:, None] * (size + 6) + np.arange(size)).ravel()
