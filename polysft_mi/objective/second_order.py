"""The whole objective of a frame to second order: its value, its gradient and a Gauss-Newton
curvature in the unknowns of the jet patch.

This is what :mod:`polysft_mi.solvers.gauss_newton` minimises. :mod:`polysft_mi.objective.problem`
is the paper's objective, to first order, which Adam minimises. Import only after a Mitsuba variant
is set.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from polysft_mi.errors import BadFrame
from polysft_mi.images.light import Light, residuals
from polysft_mi.images.registration import Appearance, Evaluation, Registration
from polysft_mi.surface.bending import hinges
from polysft_mi.surface.chart import Chart, State, Surface
from polysft_mi.surface.pattern import Pattern

from .assembly import Assembly, Normal


@dataclass(frozen=True)
class Stage:
    """How strictly a frame is compared: the ``blur`` [pixels, on a sheet of 225 pixels] of the
    images, the ``stiffness`` (a factor of k_mi), how many ``iterations`` are usual, whether the
    ``relief`` moves, and whether the stage is the ``last``, where shading counts.
    """

    blur: float
    stiffness: float
    iterations: int
    relief: bool = False
    last: bool = False


def stages_of(rules):
    """(far, stages): the stage for a sheet that moved far, and the usual ones, coarse to fine.

    Soft edges come first, so that the texture coordinates register to the image before lengths are
    enforced: in a stiff flat sheet that is compressed in the image, height has no first-order
    effect, and the sheet would drift in depth instead of bending.
    """
    numbers = zip(rules.blurs, rules.stiffness, rules.iterations, strict=True)
    usual = tuple(Stage(*three, relief=k > 0) for k, three in enumerate(numbers))
    usual = (*usual[:-1], replace(usual[-1], last=True))
    return Stage(rules.far_blur, rules.stiffness[0], rules.iterations[0]), usual


@dataclass(frozen=True)
class Context:
    """What is known of a frame before it is solved.

    ``frame``: its number; ``anchor``: the state that it is held to (of the frame before);
    ``noise``: the least misfit so far, NaN in the first frame, where the template has its shape;
    ``light``: what the frames before say of it; ``scales``: robust scale by stage, of the frame
    before; ``hold``: weight of the squared difference to the anchor, motion included.
    """

    frame: int
    anchor: State
    noise: float
    light: Light
    scales: dict
    hold: float = 0.0

    @property
    def is_first(self):
        """Whether nothing is known of the noise: the first frame, where the template has its
        shape.
        """
        return math.isnan(self.noise)

    def with_anchor(self, anchor):
        """The same, held to another state."""
        return replace(self, anchor=anchor)


@dataclass
class Model:
    """The objective around a ``state`` whose vertices are of ``surface``.

    ``terms``: name to energy, as in the paper's objective; ``total``: their sum; ``evaluation``: of
    the images; ``normal``: the equations of a step; ``appearance``: the sheet's that was used.
    """

    state: State
    surface: Surface
    evaluation: Evaluation
    normal: Normal
    terms: dict
    total: float
    appearance: Appearance | None = None

    @property
    def cost(self):
        """What starts are compared by: unlike ``total``, free of the robust scale."""
        terms = self.terms
        return self.evaluation.misfit + terms["inextensibility"] + terms["smoothness"]


class SecondOrder:
    """The objective of a :class:`polysft_mi.objective.problem.Problem` to second order.

    ``chart``: the template's :class:`polysft_mi.surface.chart.Chart`; ``images``: the
    :class:`polysft_mi.images.registration.Registration`; ``patterns``: number of unknowns of a
    vertex (2, or 3 with its relief) to the pattern of their blocks.
    """

    def __init__(self, problem):
        self.settings, self.rules = problem.settings, problem.rules
        template, count = problem.template, len(problem.template.vertices)
        self.images, self.chart = Registration(problem), Chart(template)
        faces = self.images.faces
        across, self._bends = hinges(template.chart, faces)
        wide = Pattern(faces, template.edges, count, across)
        self.patterns = {2: self.images.pattern, 3: wide}
        self._assembly = Assembly(self.images.pattern, self.images.gather)
        bends = wide.blocks_of(self._bends.T @ self._bends)
        self._relief_blocks = wide.laplacian + self.rules.relief_bend * bends
        self._lengths = np.array(problem.edge_lengths, dtype=np.float64)
        self.has_relief = self.settings.k_relief > 0 and count <= self.rules.relief_vertices
        #: the weight that holds a frame's jet and displacements to the frame before
        self.temporal = self.settings.k_tc * self.rules.temporal

    def appearance(self, state, stage, light):
        """The :class:`polysft_mi.images.registration.Appearance` of a sheet at the start of a
        stage, under a ``light``; None where the sheet has yet to move far.
        """
        if stage.blur == self.rules.far_blur or not self.rules.appearance:
            return None
        # colours as they are say that there is no light
        lit = self.images.normalise and light.frames
        coefficients = light.coefficients(len(self.images.faces)) if lit else None
        shaded = self.settings.k_shading > 0 and stage.last
        vertices = self.chart.surface(state).vertices
        return self.images.appearance(vertices, stage.blur, coefficients, shaded)

    def model(self, state, context, stage, scale, appearance=None, stiffness=None):
        """The :class:`Model` at a state, at a stage, under the robust ``scale``; ``stiffness``: in
        place of the stage's, and then edges do not give. Raises BadFrame where it is not finite.
        """
        s, rules, chart = self.settings, self.rules, self.chart
        surface = chart.surface(state)
        seen = self.images.evaluate(surface.vertices, context.frame, stage.blur, scale, appearance)
        caution = rules.caution(context.noise)
        give = rules.give * (caution if rules.strain_caution else 1.0)
        if stiffness is not None:
            give = math.inf
        stiffness = s.k_mi * (stiffness or stage.stiffness) / chart.template.scale**2
        d = 3 if self.has_relief and stage.relief and not context.is_first else 2
        shading, rows = self._shading(surface, context, stage, seen, appearance)
        normal, inextensibility = self._assembly.normal(
            surface,
            seen.images,
            self._lengths,
            stiffness,
            self.patterns[3] if d == 3 else None,
            give,
            rows,
        )
        held = self._hold(normal, state, context)
        relief = s.k_relief * (caution if rules.relief_caution else 1.0)
        smoothness, temporal = self._smooth(normal, state, context, d, relief)
        terms = {
            "rgb": seen.photometric,
            "silhouette": seen.silhouette,
            "shading": shading,
            "inextensibility": inextensibility,
            "temporal": temporal + held,
            "smoothness": smoothness,
        }
        total = sum(terms.values())
        if not math.isfinite(total):
            raise BadFrame(context.frame, total)
        return Model(state, surface, seen, normal, terms, total, appearance)

    def _shading(self, surface, context, stage, seen, appearance):
        """Energy of the shading, and its rows for the normal equations; at the last stage alone:
        before, lengths are soft, and shading would bend what they should.
        """
        s = self.settings
        if not (s.k_shading > 0 and stage.last and context.light.frames):
            return 0.0, None
        shade = self.images.shade(surface.vertices, context.frame, seen.seen, appearance)
        energy, *rows = residuals(shade, context.light, s.k_shading)
        return energy, rows

    def _hold(self, normal, state, context):
        """Add what ties the jet and the motion to the anchor's, and the jet's bending; returns the
        energy of the first.
        """
        anchor, weight = context.anchor, self.temporal + context.hold
        size = len(state.alpha)
        bend = 2 * self.settings.k_bend * self.chart.bending
        moved = state.alpha - anchor.alpha
        turn = (state.rotation * anchor.rotation.inv()).as_rotvec()
        motion = np.concatenate([turn, state.translation - anchor.translation])
        normal.glob[:size, :size] += bend + 2 * weight * np.eye(size)
        normal.gradient[:size] += bend @ state.alpha + 2 * weight * moved
        normal.glob[size:, size:] += 2 * context.hold * np.eye(6)
        normal.gradient[size:] += 2 * context.hold * motion
        return weight * float((moved**2).sum()) + context.hold * float((motion**2).sum())

    def _smooth(self, normal, state, context, d, relief):
        """Add the differences of neighbours' displacements, the relief's bends, and what ties the
        displacements to the anchor's; returns the energies (smoothness, temporal).
        """
        s, pattern = self.settings, self.patterns[d]
        apart, bent = pattern.difference @ state.offset, self._bends @ state.offset[:, 2]
        slid = state.offset - context.anchor.offset
        weights, bending = np.array([s.k_uv, s.k_uv, relief]), relief * self.rules.relief_bend
        pull = weights * (pattern.to_ends @ apart)
        pull[:, 2] += bending * (self._bends.T @ bent)
        normal.local_gradient += 2 * (pull + self.temporal * slid)[:, :d]
        blocks = pattern.laplacian, pattern.laplacian, self._relief_blocks
        for k in range(d):
            normal.local[:, k, k] += 2 * weights[k] * blocks[k]
            normal.local[pattern.diagonal, k, k] += 2 * self.temporal
        smoothness = s.k_bend * float(state.alpha @ self.chart.bending @ state.alpha)
        smoothness += float((weights * apart**2).sum() + bending * (bent**2).sum())
        return smoothness, self.temporal * float((slid**2).sum())
