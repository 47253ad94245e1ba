"""Lets a cut garment fall once onto the standard body, until it hangs: the template of a garment
with slack. The physics is :mod:`onefit.physics`.
"""

import numpy as np

from onefit.garment.binding import standard_body
from onefit.garment.waistband import held
from onefit.physics import BodyContact, Cloth, Material, SelfContact, Settings, Sheet

_MATERIAL = "cotton"
STEP, SECONDS = 1 / 120, 2.5  # [s] of a step, and of the whole fall
_SLOWING = 0.88  # of velocities in each step: the cloth comes to rest, as if it fell through honey
SETTINGS = Settings(clearance=0.006, least=0.0045, newton=2, iterations=150, tolerance=3e-4)


def fallen(cut, seconds=SECONDS, advance=lambda cloth: None):
    """Vertices (N, 3) [m] of a :class:`onefit.garment.sewing.loose.Cut` as it hangs on the standard
    body, held at its waistband if it does not hang from the shoulders.
    """
    body = standard_body()
    corners = cut.vertices[cut.faces]
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    sheet = Sheet(cut.start, cut.faces, Material.named(_MATERIAL), sides, cut.vertices)
    surface = body.vertices.double().numpy()
    skin = BodyContact(sheet, body.vertices, body.faces, SETTINGS)
    itself = SelfContact(sheet, SETTINGS, len(skin))
    cloth = Cloth(sheet, cut.start, SETTINGS, keys=len(skin) + len(sheet))
    pull = sheet.material.stretch * held(cut.start, cut.faces, body.joints.double().numpy())
    skin.find(cloth.x)
    for _ in range(round(seconds / STEP)):
        contacts = [skin.follow(surface), itself.find(cloth.x, STEP * cloth.v)]
        cloth.step(STEP, contacts, cut.start, pull)
        skin.find(cloth.x)
        cloth.x = skin.pushed_out(cloth.x)
        cloth.v *= _SLOWING
        advance(cloth)
    return cloth.x
