"""What is frozen while a frame is solved: how strictly it is compared, and what the frames before
say of it. NumPy only, but for the light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from polysft_mi.images import Level, Light

if TYPE_CHECKING:
    from polysft_mi.scene import Rules, Settings
    from polysft_mi.surface import State

    from .visibility import VisibilityWeights


@dataclass(frozen=True)
class Stage:
    """How strictly a frame is compared: the ``blur`` of the images [pixels, on a sheet of 225
    pixels; or a level], the ``stiffness`` (a share of k_mi, 1 in the last stage), how many
    ``iterations`` are usual, whether the ``relief`` moves, whether the stage is the ``last``, where
    shading counts, whether stretched edges may give (``gives``), and whether nothing moves but the
    body (``bodily``).
    """

    blur: float | Level
    stiffness: float = 1.0
    iterations: int = 1
    relief: bool = True
    last: bool = True
    gives: bool = True
    bodily: bool = False


def stages_of(settings: Settings, rules: Rules) -> tuple[Stage, tuple[Stage, ...]]:
    """(far, stages): the stage for a sheet that moved far, and the usual ones, coarse to fine; one
    alone where ``settings.blur`` says how images are blurred.

    Soft edges come first, so that the texture coordinates register to the image before lengths are
    enforced: in a stiff flat sheet that is compressed in the image, height has no first-order
    effect, and the sheet would drift in depth instead of bending. On a body, edges are stiff from
    the beginning: it brings the garment near, and soft sleeves would slip by a stripe.
    """
    if settings.blur >= 0:
        only = Stage(Level(settings.blur), 1.0, sum(rules.iterations))
        return only, (only,)
    stiffness = (1.0,) * len(rules.stiffness) if settings.body else rules.stiffness
    numbers = zip(rules.blurs, stiffness, rules.iterations, strict=True)
    last = len(rules.blurs) - 1
    usual = tuple(Stage(*three, relief=k > 0, last=k == last) for k, three in enumerate(numbers))
    far = Stage(rules.far_blur, stiffness[0], rules.iterations[0], False, False)
    return far, usual


@dataclass(frozen=True)
class FrameMemory:
    """What a frame that was solved tells those that follow.

    ``misfit``: of its surface, 0 to 1; ``outlier_share``; ``least_misfit``: of the frames so far,
    but for the first one, which the texture was taken from; ``explained``: the highest misfit that
    more iterations could not lower; ``light``: what is known of it, None where it is not learned;
    ``scales``: the robust scale by stage that fits the residuals; ``nat``: what one unit of
    log-likelihood of the images costs, were the colours of a pixel independent, and ``colours``:
    how many of them count as one; ``noises``: of the other kinds of evidence, what their
    residuals say of their noise, by name. NaN is what is not known. ``bold``: whether what the
    misfit has above the noise is taken for folds, as in a second pass.
    """

    misfit: float = math.nan
    outlier_share: float = math.nan
    least_misfit: float = math.nan
    explained: float = 0.0
    light: Light | None = None
    scales: dict[Stage, float] = field(default_factory=dict)
    nat: float = math.nan
    colours: float = 1.0
    noises: dict[str, float] = field(default_factory=dict)
    bold: bool = False

    @classmethod
    def of(cls, past: list[FrameMemory | None]) -> FrameMemory:
        """What is known after these frames, oldest first; None is one that was lost."""
        known = [memory for memory in past if memory is not None]
        if not known:
            return cls()
        last = known[-1]
        return last if past[-1] is last else replace(last, scales={})

    def scale(self, stage: Stage, first: float) -> float:
        """The robust scale of a stage's residuals, ``first`` where none is known."""
        return self.scales.get(stage, first)

    @property
    def noise(self) -> float:
        """The misfit that is noise; NaN where nothing is known, as in the first frame."""
        return self.misfit if math.isnan(self.least_misfit) else self.least_misfit

    @property
    def distrust(self) -> float:
        """The noise that caution goes by: all of it, or, where the misfit has grown and that is
        taken for folds, the less the more it has. NaN where nothing is known.
        """
        noise = self.noise
        return noise * noise / self.misfit if self.bold and self.misfit > noise else noise


@dataclass(frozen=True)
class FrameContext:
    """What is held fixed while a frame is solved.

    ``frame``: its number in the selection; ``anchor``: the state that it is tied to, that of the
    frame before, or None; ``memory``: of the frames before; ``visibility``: weights of what no
    pixel sees, None where all counts as seen; ``hold``: weight of the squared difference to the
    anchor, motion included; ``tie``: a factor of k_tc.
    """

    frame: int
    anchor: State | None = None
    memory: FrameMemory = field(default_factory=FrameMemory)
    visibility: VisibilityWeights | None = None
    hold: float = 0.0
    tie: float = 1.0

    @property
    def is_first(self) -> bool:
        """Whether nothing is known of the noise: the first frame, where the template has its
        shape.
        """
        return math.isnan(self.memory.noise)

    def light(self, rules: Rules) -> Light:
        """What is known of the light."""
        return self.memory.light or Light.unknown(rules)
