"""What a garment is made of, in physical units: the one description of cloth that training,
draping, teacher and reference share.

Sources. Kawabata, *The Standardization and Analysis of Hand Evaluation*, 2nd ed. 1980, whose
instruments (KES-F) all the textile literature uses: bending rigidity B [gf cm^2/cm = 9.8e-5 N m],
shear stiffness G [gf/(cm degree) = 56 N/m], extension EM at 490 N/m, surface friction MIU. Ranges
of shirtings, silks and knits: Kawabata and Niwa, *J. Textile Institute* 80 (1989), 19-50. Bending
lengths c = (B / (g density))^(1/3) as the hanging-strip and Cusick tests find them: Peirce, *J.
Textile Institute* 21 (1930), T377-416; Cusick, *J. Textile Institute* 56 (1965), T596-606. Slopes
at the small loads of hanging cloth, and denim and jersey: Wang, O'Brien and Ramamoorthi,
*Data-Driven Elastic Models for Cloth*, SIGGRAPH 2011. Skin on cloth: Derler and Gerhardt,
*Tribology Letters* 45 (2012), 1-27. The presets are round numbers inside these ranges, not one
measured fabric each.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from polyfit.errors import InputError

GRAVITY = 9.81  # [m/s^2], along -z
AIR = 1.2  # [kg/m^3], the density of air at 20 degrees


@dataclass(frozen=True)
class Material:
    """A sheet of cloth, the same along and across.

    ``name``; ``stretch`` [N/m]: the tension of a strip of unit width for a unit strain, at the
    loads that cloth itself makes (a few N/m); it does not become narrower as it is pulled.
    ``shear`` [N/m]: the same for a unit shear; it cannot exceed half of ``stretch``'s by much and
    is that half for a sheet without a grain, which is what garments' meshes are: real weaves shear
    far more easily along their grain (G is some 30 to 60 N/m), and a mesh does not say where that
    is. ``bending`` [N m]: moment of a strip of unit width for a unit curvature, Kawabata's B.
    ``density`` [kg/m^2]. ``drag``: coefficient of the air's pressure drag normal to the cloth,
    beside :data:`AIR`. ``friction``: Coulomb's coefficient, of cloth on skin and on itself.
    ``thickness`` [m].

    Raises InputError for numbers that no cloth has.
    """

    name: str
    stretch: float
    bending: float
    density: float
    friction: float
    thickness: float
    drag: float = 1.0

    def __post_init__(self) -> None:
        for field in ("stretch", "density", "thickness"):
            if not 0 < getattr(self, field) < float("inf"):
                raise InputError(f"material: {field} = {getattr(self, field)}; above 0 is needed")
        for field in ("bending", "friction", "drag"):
            if not 0 <= getattr(self, field) < float("inf"):
                raise InputError(f"material: {field} = {getattr(self, field)}; 0 or more is needed")

    @property
    def shear(self) -> float:
        """Shear stiffness [N/m] of a sheet without a grain that does not narrow as it is pulled."""
        return self.stretch / 2

    @classmethod
    def named(cls, name: str | os.PathLike[str] | Material) -> Material:
        """One of :data:`MATERIALS` by its name; a Material is returned. Raises InputError."""
        if isinstance(name, Material):
            return name
        if str(name) not in MATERIALS:
            raise InputError(f"material '{name}': choose among {', '.join(MATERIALS)}")
        return MATERIALS[str(name)]


# Bending in Kawabata's unit: cotton 0.06, silk 0.02, denim 0.6, jersey 0.02 gf cm^2/cm; their
# bending lengths are 16, 15, 25 and 10 mm. Skin on dry cotton: 0.3 to 0.6, on silk less.
MATERIALS = {
    m.name: m
    for m in (
        Material("cotton", 2000.0, 6e-6, 0.13, 0.4, 0.4e-3),  # a shirting
        Material("silk", 1500.0, 2e-6, 0.06, 0.3, 0.2e-3),  # a habotai or crepe de Chine
        Material("denim", 4000.0, 60e-6, 0.40, 0.5, 0.8e-3),  # 12 oz
        Material("jersey", 300.0, 2e-6, 0.18, 0.5, 0.6e-3),  # a single knit
    )
}
