"""What a term of the objective is, and what it is made of. Import only after a Mitsuba variant is
set.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.render import on_device

if TYPE_CHECKING:
    from polysft_mi.images import Appearance, DataTerm
    from polysft_mi.render import PlacedMesh
    from polysft_mi.scene import Rules, Sequence, Settings
    from polysft_mi.surface import Atlas, Template, Unknowns

    from ..context import FrameContext, Stage
    from ..operators import Operators
    from ..quadratic import Linearisation

_CACHED_FRAMES = 8
_USUAL_NOISE = 0.1  # of a photometric residual, in local standard deviations


@dataclass
class Target:
    """A frame on the device: ``image`` (H, W, 3), linear, cut out by its mask where there is one;
    ``mask`` Float of H W and ``area`` [pixels], or None.
    """

    image: mi.TensorXf
    mask: mi.Float | None
    area: float | None


@dataclass
class Inputs:
    """What terms are made of.

    ``surface``: makes vertices (Point3f of N [m, world]) of unknowns, as
    :class:`polysft_mi.surface.patch.JetAtlas` does; ``atlas``: the same on the host; ``data``: the
    frames against the baked texture, in closed form; ``where``: the scene's path, for messages.
    """

    settings: Settings
    rules: Rules
    template: Template
    surface: Any
    atlas: Atlas
    placed: PlacedMesh
    sequence: Sequence
    where: str
    _targets: OrderedDict[int, Target] = field(default_factory=OrderedDict, repr=False)

    @cached_property
    def data(self) -> DataTerm:
        from polysft_mi.images import DataTerm

        normalise = self.settings.brightness == "local"
        start = self.template.vertices
        if self.atlas.carrier is not None:
            start = self.atlas.surface(self.atlas.start).vertices
        return DataTerm(self.placed, self.template, start, self.sequence, self.rules, normalise)

    def target(self, frame: int) -> Target:
        """The :class:`Target` of a frame; the last ones are kept."""
        if frame not in self._targets:
            image, mask, area = self.sequence.frame(frame), self.sequence.mask(frame), None
            if mask is not None:
                image, area = image * mask[..., None], max(1.0, float(mask.sum()))
                mask = on_device(mask, mi.Float)
            found = Target(mi.TensorXf(on_device(image, mi.Float), image.shape), mask, area)
            dr.eval(found.image, found.mask)
            self._targets[frame] = found
            while len(self._targets) > _CACHED_FRAMES:
                self._targets.popitem(last=False)
        return self._targets[frame]

    def blur(self, stage: Stage) -> float:
        """Standard deviation [pixels of the video] of the images' blur at a stage."""
        return self.data.level(stage.blur).sigma

    def nat(self, context: FrameContext) -> float:
        """What one unit of log-likelihood costs in the objective: as the images of the frame before
        say it, whose photometric residuals have the variance of their noise. Before that is known,
        a tenth of the local deviations is taken for their standard deviation.
        """
        known = context.memory.nat
        return self.usual_nat if math.isnan(known) else known

    @cached_property
    def usual_nat(self) -> float:
        """:meth:`nat` where nothing is known."""
        sigma = self.data.level(self.rules.blurs[-1]).sigma
        independent = self.data.area / max(1.0, 4 * math.pi * sigma**2)
        return 2 * _USUAL_NOISE**2 / (3 * independent)

    @cached_property
    def operators(self) -> Operators:
        from ..operators import Operators

        data = self.data
        return Operators(self.atlas, data.faces, data.pattern, self.rules.relief_bend)


class DeviceFrame:
    """A frame's surface on the device, attached to its ``unknowns``: what energies are computed
    of. It is rendered once, where a term asks for it; ``look`` tells its :attr:`appearance`.
    """

    def __init__(
        self,
        inputs: Inputs,
        unknowns: Unknowns,
        context: FrameContext,
        stage: Stage,
        look: Callable[[], Appearance | None],
        seed: int,
    ) -> None:
        self.unknowns, self.context, self.stage = unknowns, context, stage
        self.vertices = inputs.surface.vertices(unknowns)
        self._placed, self.seed, self._spp = inputs.placed, seed, inputs.settings.spp
        self._look = look

    @property
    def appearance(self) -> Appearance | None:
        """How the sheet looks where the stage begins."""
        return self._look()

    @cached_property
    def image(self) -> tuple[mi.TensorXf, mi.Float]:
        """(rgb (H, W, 3), linear, over black, and alpha, Float of H W)."""
        return self._placed.image(self.vertices, self.seed, self._spp)


class Term:
    """A weighted energy of a frame.

    ``name``: of its figure in logs and reports; ``setting``: its weight's, where 0 leaves the term
    out. A term has its :meth:`energy` on Dr.Jit arrays, for any solver that takes gradients. Where
    it is also known in closed form to second order, it has :meth:`add`, and :meth:`rows` for what
    acts on vertices; the tests hold both forms together.
    """

    name: ClassVar[str]
    setting: ClassVar[str]

    def __init__(self, inputs: Inputs) -> None:
        self.weight = getattr(inputs.settings, self.setting)

    @classmethod
    def is_used(cls, settings: Settings) -> bool:
        """Whether the objective has the term under these settings."""
        return getattr(settings, cls.setting) > 0

    def energy(self, at: DeviceFrame) -> mi.Float:
        """The weighted energy, a Float of 1, attached."""
        raise NotImplementedError

    def rows(self, at: Linearisation) -> None:
        """Set what edges or triangles cost in ``at``."""

    def add(self, at: Linearisation) -> float:
        """Add gradient and curvature to ``at.normal``; returns the weighted energy."""
        raise NotImplementedError

    def observe(self, frame: int, vertices: np.ndarray) -> None:
        """Take in the surface (N, 3) [m, world] of a frame that was solved; frames come in their
        order.
        """

    def noise(self, context: FrameContext, vertices: np.ndarray, stage: Stage) -> dict[str, float]:
        """What the residuals say of their noise at the surface (N, 3) [m, world] that was found of
        a frame: numbers by name, for :attr:`polysft_mi.objective.context.FrameMemory.noises`.
        """
        return {}

    @property
    def without_block(self) -> str | None:
        """Why there is no :meth:`add` under these settings, in words; None where there is one."""
        return None
