"""The whole objective of a frame to second order: its value, its gradient and a Gauss-Newton
curvature in the unknowns of the atlas.

This is what :mod:`polysft_mi.solvers.gauss_newton` minimises. :mod:`polysft_mi.objective.problem`
is the paper's objective, to first order, which Adam minimises. Import only after a Mitsuba variant
is set.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from polysft_mi.errors import BadFrame
from polysft_mi.images import Appearance, Evaluation, Registration
from polysft_mi.images.light import Light, residuals
from polysft_mi.surface import Atlas, Pattern, State, Surface, hinges, slides

from .assembly import Assembly, Normal
from .hidden import Hidden
from .joints import Joints


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
    before; ``explained``: the misfit up to which a frame is as good as iterations can make it;
    ``hold``: weight of the squared difference to the anchor, motion included; ``hidden``:
    what holds the parts that no pixel sees, None where all is seen.
    """

    frame: int
    anchor: State
    noise: float
    light: Light
    scales: dict
    explained: float = 0.0
    hold: float = 0.0
    hidden: Hidden | None = None

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

    ``atlas``: the template's :class:`polysft_mi.surface.atlas.Atlas`; ``images``: the
    :class:`polysft_mi.images.registration.Registration`; ``patterns``: number of unknowns of a
    vertex (2, or 3 with its relief) to the pattern of their blocks.
    """

    def __init__(self, problem):
        self.settings, self.rules = problem.settings, problem.rules
        template, count = problem.template, len(problem.template.vertices)
        self.images, self.atlas = Registration(problem), Atlas(template)
        faces = self.images.faces
        #: (H, N): bends of the heights at the inner edges
        across, self.bends = hinges(template.vertices / template.scale, faces)
        narrow = self.images.pattern
        # A hinge reaches a vertex beyond the neighbours. A sheet's normal equations have room for
        # it; around a tube they would take four times as long, and its curvature is bounded.
        wide = Pattern(faces, template.edges, count, across) if len(template) == 1 else narrow
        self.patterns = {2: narrow, 3: wide}
        self._assembly = Assembly(narrow, self.images.gather, self.atlas)
        #: differences of (Δu, Δv) along the edges, in the axes of the first end, (2E, 2N)
        self.slides = slides(template.edges, template.axes)
        self._joints = Joints(self.atlas)
        self._volume = problem.volume
        self._seen = Hidden.of(np.ones(count, dtype=bool), 1.0, self)
        self.lengths = np.array(problem.edge_lengths, dtype=np.float64)
        self.has_relief = self.settings.k_relief > 0 and count <= self.rules.relief_vertices
        #: the weight that holds a frame's jets and displacements to the frame before
        self.temporal = self.settings.k_tc * self.rules.temporal

    def hidden(self, state):
        """The :class:`polysft_mi.objective.hidden.Hidden` of a surface."""
        if self.rules.unseen == 1:
            return self._seen
        seen = self.images.seen_vertices(self.atlas.surface(state).vertices, self.rules.blurs[-1])
        return Hidden.of(seen, self.rules.unseen, self)

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
        vertices = self.atlas.surface(state).vertices
        return self.images.appearance(vertices, stage.blur, coefficients, shaded)

    def model(self, state, context, stage, scale, appearance=None, stiffness=None):
        """The :class:`Model` at a state, at a stage, under the robust ``scale``; ``stiffness``: in
        place of the stage's, and then edges do not give. Raises BadFrame where it is not finite.
        """
        s, rules, atlas = self.settings, self.rules, self.atlas
        surface = atlas.surface(state)
        seen = self.images.evaluate(surface.vertices, context.frame, stage.blur, scale, appearance)
        caution = rules.caution(context.noise)
        give = rules.give * (caution if rules.strain_caution else 1.0)
        if stiffness is not None:
            give = math.inf
        stiffness = s.k_mi * (stiffness or stage.stiffness) / atlas.template.scale**2
        d = 3 if self.has_relief and stage.relief and not context.is_first else 2
        shading, rows = self._shading(surface, context, stage, seen, appearance)
        normal, inextensibility = self._assembly.normal(
            surface,
            seen.images,
            self.lengths,
            stiffness,
            self.patterns[d],
            d,
            give,
            rows,
        )
        if self._volume:
            inextensibility += self._volume.add(normal, atlas, surface, s.k_volume)
        held, joined = self._hold(normal, surface, state, context)
        relief = s.k_relief * rules.relief * (caution if rules.relief_caution else 1.0)
        smoothness, temporal = self._smooth(normal, state, context, d, relief)
        terms = {
            "rgb": seen.photometric,
            "silhouette": seen.silhouette,
            "shading": shading,
            "inextensibility": inextensibility,
            "temporal": temporal + held,
            "smoothness": smoothness + joined,
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

    def _hold(self, normal, surface, state, context):
        """Add what ties the jets and the motions to the anchor's, the jets' bending, and what joins
        the patches; returns the energy of the first and that of the last.
        """
        anchor, s = context.anchor, self.settings
        patches, size = state.alpha.shape
        weight = np.full(size + 6, context.hold)
        weight[:size] += self.temporal
        moved = state.difference(anchor)
        pull = 2 * weight * moved
        held = context.hidden or self._seen
        for k in range(patches):
            bend = 2 * s.k_bend * held.patches[k] * self.atlas.bending
            pull[k, :size] += bend @ state.alpha[k]
            jet = slice(k * (size + 6), k * (size + 6) + size)
            normal.glob[jet, jet] += bend
        normal.glob += np.diag(np.tile(2 * weight, patches))
        normal.gradient += pull.ravel()
        joined = self._joints.add(normal, surface, self.rules.joint)
        return float((weight * moved**2).sum()), joined

    def _smooth(self, normal, state, context, d, relief):
        """Add the differences of neighbours' displacements, the relief's bends, and what ties the
        displacements to the anchor's; returns the energies (smoothness, temporal).
        """
        s, pattern, height = self.settings, self.patterns[d], state.offset[:, 2]
        slid, along = state.offset - context.anchor.offset, state.offset[:, :2].ravel()
        held, bending = context.hidden or self._seen, relief * self.rules.relief_bend
        apart, steps, bent = self.slides @ along, pattern.difference @ height, self.bends @ height
        pull = self.temporal * slid
        pull[:, :2] += s.k_uv * (self.slides.T @ (np.repeat(held.edges, 2) * apart)).reshape(-1, 2)
        pull[:, 2] += relief * (pattern.to_ends @ (held.edges * steps))
        pull[:, 2] += bending * (self.bends.T @ bent)
        normal.local_gradient += 2 * pull[:, :d]
        normal.local[:, :2, :2] += 2 * s.k_uv * held.slide_blocks[d]
        if d == 3:
            normal.local[:, 2, 2] += 2 * relief * held.relief_blocks
        for k in range(d):
            normal.local[pattern.diagonal, k, k] += 2 * self.temporal
        bend = ((state.alpha @ self.atlas.bending) * state.alpha).sum(1)
        smoothness = s.k_bend * float(held.patches @ bend)
        smoothness += s.k_uv * float(np.repeat(held.edges, 2) @ apart**2)
        smoothness += relief * float(held.edges @ steps**2) + bending * float(bent @ bent)
        return smoothness, self.temporal * float((slid**2).sum())
