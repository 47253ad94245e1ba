"""The silhouette for path replay: Mitsuba's projective integrators give alpha no gradient, this one
does.

Import only after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import PSIntegrator


class SilhouetteProjective(PSIntegrator):
    """

    .. pluginparameters::

     * - (none of its own)

    Renders 1 where a ray meets a surface and 0 where it does not, in every colour channel, with the
    gradient of that step by projective sampling (Zhang et al. 2023, "Projective Sampling for
    Differentiable Rendering of Geometry"). The objective uses it for the mask where the images come
    from ``prb_projective``. Noisy: 16 samples a pixel are usable.
    """

    def __init__(self, props):
        props["sppc"], props["sppi"] = (
            0,
            0,
        )  # a step function has neither a continuous nor an indirect derivative
        super().__init__(props)
        self.max_depth, self.rr_depth = 1, 1
        self.radiative_backprop = False

    def sample(self, mode, scene, sampler, ray, active=True, **_):
        hit = scene.ray_intersect_preliminary(
            mi.Ray3f(ray), coherent=True, active=active
        ).is_valid()
        return mi.Spectrum(dr.select(hit, 1.0, 0.0)), hit, [], None

    def sample_radiance_difference(self, scene, ss, curr_depth, sampler, wavelengths, active):
        """1 where the ray that just passes the edge misses the whole scene, 0 where it meets
        something else.
        """
        beyond = ss.spawn_ray(wavelengths)
        hit = scene.ray_intersect_preliminary(beyond, active=active).is_valid()
        return mi.Spectrum(dr.select(hit, 0.0, 1.0)), active

    def to_string(self):
        return "SilhouetteProjective[]"
