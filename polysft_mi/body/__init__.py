"""The body under a garment. In: its motion, and a template in its rest pose. Out: maps that carry
the template into each frame, with their derivatives by the body's pose; OneFit's drape; the body's
surface. Needs OneFit, and with it torch, where a body is put on; importing it needs NumPy alone.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "bones": ["Bones"],
        "carrier": ["Carrier", "Maps", "Pose"],
        "motion": ["BodyMotion", "MeshMotion", "read_motion"],
        "wearer": ["check_model", "put_on"],
    },
)
