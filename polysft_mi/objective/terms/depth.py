"""Depth images, of a sensor or guessed by a network. Import only after a Mitsuba variant is set."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.images import DepthData, DepthNoise

from ..quadratic import TriangleForms
from .term import Term

_TOLERANCE = 2.5  # standard deviations from which on a pixel counts less and less
# standard deviation of a pixel, before it is known: so much, and such a share of the depth; and the
# factor by which it may turn out otherwise
_FIRST, _SHARE, _BOUNDS = 2e-3, 2e-3, (0.3, 10.0)
_MEDIAN = 0.6745  # of the size of a normal variable
# pixels that count as one, for neighbours err alike: before it is known, and its range
_PATCH, _PATCHES = 9.0, (1.0, 100.0)
_FEWEST = 100  # pixels that tell a noise, or a scale and a shift


class Depth(Term):
    """k_depth e / 2 times the sum over pixels of c^2 log(1 + r^2 / c^2) / (m s^2): r the surface's
    depth less the image's [m], s its standard deviation, e what one unit of log-likelihood costs
    (:meth:`polysft_mi.objective.terms.term.Inputs.nat`); neighbours err alike, and m pixels count
    as one.

    Pixels count that the surface fills, and the mask, where there is one. s is 2 mm and 0.2 % of
    the depth, times a factor, that of the residuals in the frame before, whose correlation rho of
    neighbours says m = ((1 + rho) / (1 - rho))^2. The norm (Cauchy's) turns
    robust at c, 2.5 s and as far as images are blurred: what stands before the sheet, or behind it,
    hardly pulls at the last stage. Depth that is known up to a scale and a shift is fitted to the
    surface at every step; where it does not go along with the surface at all, it says nothing.
    """

    name, setting, is_noise = "depth", "k_depth", True
    _patch = "depth_patch"  # the name of m among the noises

    def __init__(self, inputs):
        super().__init__(inputs)
        self._inputs = inputs
        self._images = DepthData(inputs.data, inputs.sequence)
        self._focal = inputs.placed.camera.focal

    @classmethod
    def is_used(cls, settings):
        return bool(settings.depth) and super().is_used(settings)

    def noise(self, context, vertices, stage):
        level = self._level(stage)
        before = {k: v for k, v in context.memory.noises.items() if k in (self.name, self._patch)}
        fit = self._images.fitted(vertices, context.frame, level)
        if fit is None:
            return before
        residual, z = self._images.residuals(vertices, context.frame, level, fit)
        residual /= _FIRST + _SHARE * z
        known = np.isfinite(residual)
        if known.sum() < _FEWEST:
            return before
        sigma = np.median(np.abs(residual[known])) / _MEDIAN
        residual = np.clip(residual, -_TOLERANCE * sigma, _TOLERANCE * sigma)
        pairs = ((residual[:, 1:], residual[:, :-1]), (residual[1:], residual[:-1]))
        product = np.concatenate([(a * b).ravel() for a, b in pairs])
        rho = np.clip(np.nanmean(product) / np.nanmean(residual**2), 0, 0.99)
        patch = ((1 + rho) / (1 - rho)) ** 2 * level.stride**2
        return {
            self.name: float(np.clip(sigma, *_BOUNDS)),
            self._patch: float(np.clip(patch, *_PATCHES)),
        }

    def fit(self, surfaces, stage):
        """``used`` of ``given`` images, those that know the surface's depth; ``noise_mm``, their
        standard deviation, by the median.
        """
        level, found = self._level(stage), []
        for frame, vertices in enumerate(surfaces):
            fit = self._images.fitted(vertices, frame, level)
            if fit is None:
                continue
            residual, _ = self._images.residuals(vertices, frame, level, fit)
            residual = residual[np.isfinite(residual)]
            if len(residual) >= _FEWEST:
                found.append(1e3 * float(np.median(np.abs(residual))) / _MEDIAN)
        noise = float(np.median(found)) if found else math.nan
        return {"used": len(found), "given": len(surfaces), "noise_mm": noise}

    def energy(self, at):
        context, level = at.context, self._level(at.stage)
        vertices = np.array(dr.detach(at.vertices), dtype=np.float64).T
        noise = self._noise(context, at.stage)
        fit = self._images.fitted(vertices, context.frame, level)
        if fit is None:
            return mi.Float(0)
        z, image = self._images.attached(at.vertices, vertices, context.frame, level, fit)
        sigma, c2 = noise.sigma(dr.detach(z)), noise.squared_scale(dr.detach(z))
        over = dr.square(z - image) / c2
        rho = c2 / dr.square(sigma) * dr.log(1 + over)
        return mi.Float(float(self._factor(context) * level.stride**2) * dr.sum(rho))

    def rows(self, at):
        context, level = at.context, self._level(at.stage)
        noise, vertices = self._noise(context, at.stage), at.surface.vertices
        fit = self._images.fitted(vertices, context.frame, level)
        if fit is None:
            return
        energy, *sums = self._images.sums(vertices, context.frame, level, noise, fit)
        factor = self._factor(context)
        forms = TriangleForms(*(factor * x for x in sums))
        at.add_to_triangles(self.name, factor * energy, forms)

    def add(self, at):
        return at.energies.get(self.name, 0.0)

    def _level(self, stage):
        return self._inputs.data.level(stage.blur)

    def _factor(self, context):
        patch = context.memory.noises.get(self._patch, _PATCH)
        return self.weight * self._inputs.nat(context) / (2 * patch)

    def _noise(self, context, stage):
        factor = context.memory.noises.get(self.name, 1.0)
        spread = self._inputs.blur(stage) / self._focal
        return DepthNoise(factor * _FIRST, factor * _SHARE, _TOLERANCE, spread)
