"""The photometric term: the rendering against the frame (paper, section "PolySfT", Losses; there as
in φ-SfT).

What the paper leaves open are options, here and nowhere else (``docs/conventions.md`` repeats it):
the norm (``rgb_norm``), what light does (``brightness``), the blur, and which pixels count
(``rgb_region``). Images are linear RGB. The sum over pixels is divided by the area of the surface
in the image (the target mask's, or the rendered interior's where there are no masks), so that
neither the background nor the resolution weighs in. ``rgb_norm`` = ``phi-sft`` does as that paper's
program: pixel values as they are stored, and a mean over the image. Import only after a Mitsuba
variant is set.
"""

import math

import drjit as dr
import mitsuba as mi

from polysft_mi.images import differentiable

from .term import Term

_SMALL = 1e-6  # residual below which ``l1`` is smooth
_INTERIOR = 0.999  # alpha above which a pixel counts as filled by the surface


class Photometric(Term):
    """k_rgb / area times the sum over pixels of rho(|I - T|^2 / 3)."""

    name, setting = "rgb", "k_rgb"

    def __init__(self, inputs):
        super().__init__(inputs)
        s, self._inputs = inputs.settings, inputs
        self._norm, self._brightness, self._region = s.rgb_norm, s.brightness, s.rgb_region
        self._scale = s.rgb_scale
        self._count = math.prod(inputs.placed.size)

    def energy(self, at):
        (rgb, cut), level = at.image, self._inputs.level(at.stage)
        target, mask, area = at.target.image, at.target.mask, at.target.area
        inside, weight, covered = interior(cut.array), 1, mask
        if mask is None:
            # both cut out alike, else a band inside the silhouette would compare with the
            # background
            weight, area = inside, dr.maximum(dr.sum(inside), 1)
            cut = covered = mi.TensorXf(inside, cut.shape)
            rgb, target = _times(rgb, cut), _times(target, cut)
        if self._region == "sheet":
            weight = inside
            if mask is not None:
                weight = inside * dr.select(mask.array > 0.5, mi.Float(1), 0)
            a = differentiable.compared(rgb, cut, level, self._brightness == "local")
            b = differentiable.compared(target, covered, level, self._brightness == "local")
        else:
            a, b = (differentiable.blur(x, level.sigma) for x in (rgb, target))
            if self._brightness == "local":
                a = differentiable.normalised(a, cut, level.window)
                b = differentiable.normalised(b, covered, level.window)
        if self._norm == "phi-sft":
            a, b, area = differentiable.srgb(a), differentiable.srgb(b), self._count
        a, b = _channels(a), _channels(b)
        if self._brightness == "gain":
            g = gain([dr.detach(x) for x in a], b, inside)
            a = [g * x for x in a]
        if self._norm == "phi-sft":
            rho = sum(dr.abs(x - y) for x, y in zip(a, b)) / 3
            return self.weight * dr.sum(weight * rho) / area
        squared = sum(dr.square(x - y) for x, y in zip(a, b)) / 3
        scale = at.context.memory.scale(at.stage, self._scale)
        rho = robust(squared, self._norm, scale)
        return self.weight * dr.sum(weight * rho) / area

    def add(self, at):
        return at.evaluation.photometric

    @property
    def without_block(self):
        for name, value, known in (
            ("rgb_norm", self._norm, ("cauchy",)),
            ("brightness", self._brightness, ("local", "none")),
            ("rgb_region", self._region, ("sheet",)),
        ):
            if value not in known:
                return f"{name} = {value}; {' or '.join(known)} is needed"
        return None


def _channels(tensor):
    index = dr.arange(mi.UInt32, dr.width(tensor.array) // 3) * 3
    return [
        dr.gather(mi.Float, tensor.array, index + c, mode=dr.ReduceMode.Permute) for c in range(3)
    ]


def robust(squared, norm, scale):
    """rho of squared residuals r^2: r^2 (``l2``), |r| (``l1``), or, r^2 near 0, 2 scale^2 (sqrt(1 +
    r^2/scale^2) - 1) (``charbonnier``), scale^2 log(1 + r^2/scale^2) (``cauchy``).
    """
    if norm == "l2":
        return squared
    if norm == "l1":
        return dr.sqrt(squared + _SMALL**2) - _SMALL
    if norm == "charbonnier":
        return 2 * scale * scale * (dr.sqrt(1 + squared / (scale * scale)) - 1)
    return scale * scale * dr.log(1 + squared / (scale * scale))


def interior(alpha):
    """1 where the surface fills the pixel, else 0, detached; Float of P."""
    return dr.select(dr.detach(alpha) > _INTERIOR, mi.Float(1), 0)


def gain(render, target, weight):
    """The gain g (Float of 1, detached) for which g render fits target best in the least-squares
    sense where weight is 1.
    """
    with dr.suspend_grad():
        top = sum(dr.sum(weight * a * b) for a, b in zip(render, target))
        bottom = sum(dr.sum(weight * a * a) for a in render)
        return dr.clip(top / dr.maximum(bottom, 1e-12), 0.25, 4)


def _times(image, weight):
    """An image (H, W, C) times a weight (H, W, 1)."""
    channels = image.shape[2]
    at = dr.arange(mi.UInt32, channels * dr.width(weight.array)) // channels
    return mi.TensorXf(image.array * dr.gather(mi.Float, weight.array, at), image.shape)
