"""What decides how a simulation is done."""

from dataclasses import dataclass, field

from onefit.contact import ContactSettings
from polyfit.errors import InputError, number


@dataclass(frozen=True)
class Settings:
    """How implicit steps are solved, and how a simulation begins; what the cloth is made of is its
    :class:`onefit.physics.Material`, and ``contact`` says how it touches.

    ``newton``: iterations of Newton's method in a step; a second one finds what the first brought
    into contact, and how far triangles have turned. ``iterations`` of conjugate gradients in each
    of them, at most, and the ``tolerance`` of the residual, relative to the forces', below which
    they end earlier. ``draw`` [1/s^2]: acceleration towards the network's drape, for a unit
    distance. ``lead`` [s]: how long the body takes, before the motion, from its rest, in which
    garments are made, to the first pose; ``settling`` [s]: how long that is held then, for the
    cloth to come to rest. In each step of both, velocities are multiplied by ``damping``.
    ``stride`` [m]: by how much layers of cloth may fly towards each other in a step; where they
    would by more it is cut into parts, at most ``parts``. It is about the length of an edge.
    """

    newton: int = 2
    iterations: int = 10
    tolerance: float = 1e-5
    draw: float = 0.2
    lead: float = 0.6
    settling: float = 0.4
    damping: float = 0.9
    stride: float = 0.015
    parts: int = 4
    contact: ContactSettings = field(default_factory=ContactSettings)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in ("newton", "iterations", "parts"):
                object.__setattr__(self, name, number(name, value, 1, whole=True))
            elif name != "contact":
                number(name, value, 0)
        number("stride", self.stride, above=0)
        if not isinstance(self.contact, ContactSettings):
            raise InputError(f"contact = {self.contact}: ContactSettings are needed")
