"""What decides how a step of cloth is solved."""

from dataclasses import dataclass

from polyfit.errors import InputError


@dataclass(frozen=True)
class Settings:
    """How implicit steps are solved; what the cloth is made of is its
    :class:`onefit.physics.Material`.

    ``newton``: iterations of Newton's method in a step; a second one finds what the first brought
    into contact, and how far triangles have turned. ``iterations`` of conjugate gradients in each
    of them, at most, and the ``tolerance`` of the residual, relative to the forces', below which
    they end earlier. ``clearance`` [m] that cloth keeps from the body, which covers what a chord of
    2 cm misses of a limb; ``least`` [m] to which it is pushed at the end of a step, if it came
    nearer. ``reach`` [m]: cloth and body that come nearer to each other than this in a step are
    seen, and so far does cloth look for other cloth at most. ``contact`` and ``layers`` [1]: the
    stiffness of a contact with the body and of cloth with itself, in units of the material's
    stretch stiffness. ``room`` [m]: between the skins of two limbs, or of a limb and the trunk, to
    which flesh yields (:class:`onefit.body.Flesh`); 0: a rigid body. ``sticking`` [m/s]: a slower
    slip is not friction's full force. ``apart`` [m]: what folds keep from each other. ``spacing``
    [m]: of points of the faces that must stay out of the body, as vertices must. ``draw`` [1/s^2]:
    acceleration towards the network's drape, for a unit distance. ``lead`` [s]: how long the
    body takes, before the motion, from its rest, in which garments are made, to the first pose;
    ``settling`` [s]: how long that is held then, for the cloth to come to rest. In each step of
    both, velocities are multiplied by ``damping``.
    """

    newton: int = 2
    iterations: int = 10
    tolerance: float = 1e-5
    clearance: float = 0.003
    least: float = 0.001
    reach: float = 0.03
    contact: float = 0.5
    layers: float = 0.2
    room: float = 0.003
    sticking: float = 0.005
    apart: float = 0.003
    spacing: float = 0.02
    draw: float = 0.2
    lead: float = 0.6
    settling: float = 0.4
    damping: float = 0.9

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < float("inf"):
                raise InputError(f"{name} = {value}: a number, 0 or more")
