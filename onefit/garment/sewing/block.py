"""The grid of signed distances that garments are cut from.

A garment is a level set: the body's signed distance with its hollows closed by a rolling ball
(cloth spans the gap between the breasts and that of the spine), in parts: torso, arms, hips, legs.
Metres, OneFit's axes.
"""

from functools import cached_property

import numpy as np

from onefit.body import ClosestSurface

SPACING = 0.008  # of the grid [m]
_LOW, _HIGH = np.array([-0.536, -0.424, -0.80]), np.array([0.536, 0.36, 0.80])  # its corners [m]


class Block:
    """The signed distances that garments are made of, on one grid around the standard body [m]."""

    def __init__(self, vertices, faces, spacing=SPACING):
        self.spacing = spacing
        shape = np.round((_HIGH - _LOW) / spacing).astype(int) + 1
        axes = [(_LOW[k] + spacing * np.arange(shape[k])).astype(np.float32) for k in range(3)]
        self.x, self.y, self.z = np.meshgrid(*axes, indexing="ij", sparse=True)
        self.side = np.abs(self.x)
        self.points = np.stack(np.broadcast_arrays(self.x, self.y, self.z), axis=-1)
        self.surface = ClosestSurface(vertices, faces)
        self.body = self._distance(self.surface, 0.26)
        self.armhole = armhole(self.x, self.z)

    @cached_property
    def skin(self):
        """The body with hollows narrower than 6 cm filled."""
        return self._closed(self.body, 0.03)

    @cached_property
    def torso(self):
        """Without arms and neck, hollows narrower than 40 cm filled: between the legs too."""
        return self._closed(np.maximum(np.maximum(self.body, self.armhole), self.z - 0.505), 0.20)

    @cached_property
    def trunk(self):
        """As the skin, without arms."""
        return self._closed(np.maximum(self.body, self.armhole), 0.03)

    @cached_property
    def arms(self):
        return self._closed(np.maximum(self.body, 0.02 - self.armhole), 0.08)

    @cached_property
    def hips(self):
        """From the waist to the crotch, hollows narrower than 20 cm filled."""
        return self._closed(
            np.maximum(
                self.body, np.maximum(np.maximum(self.z - 0.22, -0.065 - self.z), self.armhole)
            ),
            0.10,
        )

    @cached_property
    def legs(self):
        """Each leg by itself, from the hip to the ankle."""
        left = np.maximum(
            np.maximum(self.body, self.z - 0.03), np.maximum(-0.72 - self.z, 0.01 - self.x)
        )
        left = self._closed(left, 0.15)
        return np.minimum(left, left[::-1])

    def mesh(self, field, level=0.0):
        """Level set as ``(vertices [m], faces)``, wound away from where the field is lower."""
        from skimage.measure import marching_cubes

        V, F, _, _ = marching_cubes(
            field,
            level,
            spacing=(self.spacing,) * 3,
            gradient_direction="descent",
            allow_degenerate=False,
        )
        return V + _LOW, F.astype(np.int64)

    def _distance(self, surface, reach):
        return (
            surface(self.points.reshape(-1, 3), reach)
            .distance.reshape(self.points.shape[:3])
            .astype(np.float32)
        )

    def _closed(self, field, radius):
        """Signed distance to the solid ``field`` < 0 after a ball of this radius was rolled over it
        from outside [m].
        """
        distance = self._signed(field, 0, radius + 0.02)
        return self._signed(distance, radius, radius + 0.08) + np.float32(radius)

    def _signed(self, field, level, reach):
        """True signed distance to the level set of a field that need be a distance only in its
        sign.
        """
        return np.sign(field - level) * np.abs(
            self._distance(ClosestSurface(*self.mesh(field, level)), reach)
        )


def armhole(x, z):
    """Negative on the torso's side of the planes through the armpits [m]."""
    return np.abs(x) - 0.15 - 0.6 * np.maximum(0.35 - z, 0)
