"""What a garment is made of, in physical units: the one description of cloth that training,
draping, teacher and reference share.

Sources. KES-F is the instrument of the textile literature: Kawabata, *The Standardization and
Analysis of Hand Evaluation*, 2nd ed. 1980; ranges of shirtings, silks and knits in Kawabata and
Niwa, *J. Textile Institute* 80 (1989), 19-50. Bending is its B [gf cm^2/cm = 9.8e-5 N m].
Bending lengths (B / (g density))^(1/3), as hanging strips and Cusick's drape meter find them:
Peirce, *J. Textile Institute* 21 (1930), T377-416; Cusick, *J. Textile Institute* 56 (1965),
T596-606. Skin on cloth: Derler and Gerhardt, *Tribology Letters* 45 (2012), 1-27. The presets are
round numbers inside these ranges, not one measured fabric each.

Stretch is the secant at the loads that hanging and moving cloth makes, P = 2 N/m, not at KES-F's
490 N/m: yarns are crimped, and the curve is soft at first. Of the extension EM at 490 N/m and the
linearity LT (a curve F ~ strain^n has LT = 2 / (n + 1)) it is P / (EM (P / 490)^(LT / (2 - LT))).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from polyfit.errors import InputError, number

GRAVITY = 9.81  # [m/s^2], along -z
AIR = 1.2  # [kg/m^3], the density of air at 20 degrees


@dataclass(frozen=True)
class Material:
    """A sheet of cloth, the same along and across.

    ``stretch`` [N/m]: the tension of a strip of unit width for a unit strain; the strip does not
    become narrower. ``bending`` [N m]: the moment of a strip of unit width for a unit curvature.
    ``density`` [kg/m^2]. ``friction``: Coulomb's coefficient, of cloth on skin and on itself.
    ``thickness`` [m]. ``drag``: the air's pressure drag normal to the cloth, beside :data:`AIR`; a
    plate has 1.1 to 1.3.

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
            number(f"material: {field}", getattr(self, field), above=0)
        for field in ("bending", "friction", "drag"):
            number(f"material: {field}", getattr(self, field), 0)

    @property
    def shear(self) -> float:
        """Shear stiffness [N/m], of a sheet without a grain that does not narrow as it is pulled.

        Real weaves shear far more easily along their grain (KES-F's G is some 30 to 60 N/m), but a
        garment's mesh does not say where that is.
        """
        return self.stretch / 2

    @classmethod
    def named(cls, name: str | os.PathLike[str] | Material) -> Material:
        """One of :data:`MATERIALS` by its name; a Material is returned. Raises InputError."""
        if isinstance(name, Material):
            return name
        if str(name) not in MATERIALS:
            raise InputError(f"material '{name}': choose among {', '.join(MATERIALS)}")
        return MATERIALS[str(name)]

    @classmethod
    def of_each(
        cls, material: str | Material | Sequence[str | Material], count: int
    ) -> list[Material]:
        """Those of so many garments (``count``): each :meth:`named` in a list, or one for all.
        Raises InputError, also where a list has another number of them.
        """
        if isinstance(material, str) or not isinstance(material, Sequence):
            return [cls.named(material)] * count
        if len(material) != count:
            raise InputError(
                f"{len(material)} materials for {count} garment{'s' * (count > 1)}; give one for"
                " each, in their order, or one for all"
            )
        return [cls.named(one) for one in material]


# EM %, LT; B gf cm^2/cm; bending length mm
#   cotton, a shirting                  5, 0.65; 0.12; 20
#   silk, a habotai or crepe de Chine   6, 0.6; 0.03; 17
#   denim of 12 oz                      3, 0.8; 0.5; 23
#   jersey, a single knit              30, 0.75; 0.025; 11
MATERIALS = {
    m.name: m
    for m in (
        Material("cotton", 600.0, 12e-6, 0.15, 0.4, 0.4e-3),
        Material("silk", 350.0, 3e-6, 0.06, 0.3, 0.2e-3),
        Material("denim", 2600.0, 50e-6, 0.40, 0.5, 0.8e-3),
        Material("jersey", 180.0, 2.5e-6, 0.18, 0.5, 0.6e-3),
    )
}
