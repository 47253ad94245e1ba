"""Lets a cut garment fall once onto the standard body, until it hangs: the template of a garment
with slack. The physics is :mod:`onefit.physics`.
"""

from onefit.contact import ContactSettings
from onefit.garment.binding import standard_body
from onefit.garment.fitting import untangled
from onefit.garment.waistband import held
from onefit.physics import Material, Settings, Sheet, WornCloth

_MATERIAL = "cotton"
STEP, SECONDS = 1 / 120, 2.5  # [s] of a step, and of the whole fall
_SLOWING = 0.88  # of velocities in each step: the cloth comes to rest, as if it fell through honey
# templates lie twice as far from the skin as cloth comes to it in motion
CONTACT = ContactSettings(clearance=0.006, least=0.0045)
SETTINGS = Settings(iterations=150, tolerance=3e-4, contact=CONTACT)


def fallen(cut, seconds=SECONDS):
    """Vertices (N, 3) [m] of a :class:`onefit.garment.sewing.loose.Cut` as it hangs on the standard
    body, held at its waistband if it does not hang from the shoulders; it does not pass through
    itself.
    """
    body = standard_body()
    sheet = Sheet(cut.start, cut.faces, Material.named(_MATERIAL), cut.sides, cut.vertices)
    surface, faces = body.vertices.numpy(), body.faces.numpy()
    worn = WornCloth(sheet, cut.start, surface, faces, SETTINGS)
    pull = sheet.firmness * held(cut.start, cut.faces, body.joints.double().numpy())
    for _ in range(round(seconds / STEP)):
        worn.step(STEP, surface, cut.start, pull)
        worn.cloth.v *= _SLOWING
    return untangled(worn.cloth.x, cut.faces)  # one crossing here grows to dozens in motion
