"""What a term of the objective is, and what it is made of. Import only after a Mitsuba variant is
set.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.images import POOL, Level, differentiable

if TYPE_CHECKING:
    from polysft_mi.images import Appearance, DataTerm
    from polysft_mi.render import Crop, PlacedMesh
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
    ``mask`` (H, W, 1), its ``area`` [pixels] and ``box`` (x, y, x, y) [pixels], or None.
    """

    image: mi.TensorXf
    mask: mi.TensorXf | None = None
    area: float | None = None
    box: tuple[float, float, float, float] | None = None

    def cut(self, crop: Crop) -> Target:
        """Its part in a crop."""
        mask = None if self.mask is None else crop.cut(self.mask)
        return replace(self, image=crop.cut(self.image), mask=mask)


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
            image, mask = self.sequence.frame(frame), self.sequence.mask(frame)
            if mask is None:
                found = Target(_tensor(image))
            else:
                area, mask = max(1.0, float(mask.sum())), mask[..., None]
                found = Target(_tensor(image * mask), _tensor(mask), area, _box(mask[..., 0] > 0))
            dr.eval(found.image, found.mask)
            self._targets[frame] = found
            while len(self._targets) > _CACHED_FRAMES:
                self._targets.popitem(last=False)
        return self._targets[frame]

    def blur(self, stage: Stage) -> float:
        """Standard deviation [pixels of the video] of the images' blur at a stage."""
        return self.level(stage).sigma

    def level(self, stage: Stage) -> Level:
        """How images are compared at a stage."""
        return stage.blur if isinstance(stage.blur, Level) else self.data.level(stage.blur)

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


def _tensor(image):
    return mi.TensorXf(on_device(image, mi.Float), image.shape)


def _box(mask):
    """(x, y, x, y) [pixels] of a mask (H, W) of bool; None where it is empty."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    return (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) if len(rows) else None


class DeviceFrame:
    """A frame's surface on the device, attached to its ``unknowns``, and what it is compared with:
    what energies are computed of. It is rendered once, where a term asks for it; ``look`` tells its
    :attr:`appearance`.
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
        self.seed, self._inputs, self._look = seed, inputs, look

    @property
    def appearance(self) -> Appearance | None:
        """How the sheet looks where the stage begins."""
        return self._look()

    @cached_property
    def crop(self) -> Crop:
        """The part of the image that surface and mask lie in, as far as they are blurred to."""
        inputs, box = self._inputs, self._inputs.target(self.context.frame).box
        blur = max(inputs.blur(self.stage), inputs.settings.mask_blur)
        vertices = np.array(dr.detach(self.vertices)).T
        margin = differentiable.reach(blur)
        # what is pooled is pooled as in the whole image
        return inputs.placed.crop(vertices, [box] if box else [], margin, POOL)

    @cached_property
    def target(self) -> Target:
        """The frame, in the :attr:`crop`."""
        return self._inputs.target(self.context.frame).cut(self.crop)

    @cached_property
    def image(self) -> tuple[mi.TensorXf, mi.TensorXf]:
        """The rendering in the :attr:`crop`: rgb (H, W, 3), linear, over black, and alpha
        (H, W, 1).
        """
        spp = self._inputs.settings.spp
        return self._inputs.placed.image(self.vertices, self.seed, spp, self.crop)


class Term:
    """A weighted energy of a frame.

    ``name``: of its figure in logs and reports; ``setting``: its weight's, where 0 leaves the term
    out. A term has its :meth:`energy` on Dr.Jit arrays, for any solver that takes gradients. Where
    it is also known in closed form to second order, it has :meth:`add`, and :meth:`rows` for what
    acts on vertices; the tests hold both forms together. ``is_noise``: most of its energy is noise
    that no step lowers, so what a step gains is no share of it.
    """

    name: ClassVar[str]
    setting: ClassVar[str]
    is_noise: ClassVar[bool] = False

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

    def matches(self, frame: int, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (P, 3) [m] of a surface (N, 3) [m, world] whose place in a frame is known, and
        where, (P, 2) [pixels]; none for most terms.
        """
        return np.zeros((0, 3)), np.zeros((0, 2))

    def noise(self, context: FrameContext, vertices: np.ndarray, stage: Stage) -> dict[str, float]:
        """What the residuals say of their noise at the surface (N, 3) [m, world] that was found of
        a frame: numbers by name, for :attr:`polysft_mi.objective.context.FrameMemory.noises`.
        """
        return {}

    def fit(self, surfaces: np.ndarray, stage: Stage) -> dict[str, float]:
        """How evidence beside the images fits the surfaces (T, N, 3) [m, world] that were found, by
        names of metrics.json; empty for other terms.
        """
        return {}

    @property
    def without_block(self) -> str | None:
        """Why there is no :meth:`add` under these settings, in words; None where there is one."""
        return None
