"""The numbers of contact: of cloth with skin, of cloth with itself, of skin with skin."""

from dataclasses import dataclass

from polyfit.errors import number

# What a simulation does not read, all in metres:
#: that a garment gets where it lies in the body, or in another one: more than the clearance, for
#: smoothing takes some
MADE = 0.004
#: that a garment that is tried on gets, if it was made with as much: more, for what comes nearer in
#: some poses
EASED = 0.007
#: cloth of a drape that is so near touches the skin: twice the clearance
TOUCHING = 0.006
#: in the body that cloth of a drape is looked for: deeper, the nearest skin is another side's
DEEPEST = 0.08
#: points of a drape's large faces that are nearer than the first are pushed to the second: less
#: than a vertex, for skin bulges between these
POINT_NEAR, POINT_CLEARANCE = 0.0015, 0.002
#: of limbs: cloth of a drape that moves by less has not passed through one
THINNEST = 0.02


@dataclass(frozen=True)
class ContactSettings:
    """How near cloth and skin come to each other in a simulation; what drapes and grading share
    with it has these defaults there. Raises InputError for a number below 0.
    """

    #: [m] that cloth keeps from the skin, also in drapes and grading: what a chord of 2 cm misses
    #: of a limb
    clearance: float = 0.003
    #: [m] to which cloth is pushed at the end of a simulation's step that brought it nearer: less,
    #: for a push is sudden where the contact's force is not
    least: float = 0.001
    #: [m] between the points of large faces that are kept out, also in drapes: a limb shows through
    #: there
    spacing: float = 0.02
    #: [m]: what comes nearer in a step is seen, and cloth that went so far is free, also in drapes:
    #: 2 m/s at 60 Hz
    reach: float = 0.03
    #: [m] between folds: cloth's thickness and hairs, and what a step's errors take
    apart: float = 0.003
    #: [m] between skin and skin, to which flesh yields (:class:`onefit.contact.Flesh`): two layers
    #: of cloth have their clearances, and what keeps them apart; 0: a rigid body
    room: float = 0.009
    #: [1] of a contact with the skin, in units of the material's stretch stiffness: less, and cloth
    #: is pressed in; more, and the linear systems are harder
    stiffness: float = 0.5
    #: [1], the same of cloth with itself: as much, or skin presses one layer through another
    layer_stiffness: float = 0.5
    #: [m/s]: a slower slip does not have friction's full force, which has no direction at rest
    sticking: float = 0.005

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            number(name, value, 0)
