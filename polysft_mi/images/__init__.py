"""What the images say of a surface: frames and the template's texture in; how well a surface
explains a frame, to second order at its vertices, out. The solver asks one object,
:class:`polysft_mi.images.registration.Registration`. Import only after a Mitsuba variant is set.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "light": ["Light"],
        "pixels": ["packed"],
        "pyramid": ["POOL", "compared"],
        "registration": ["Appearance", "Evaluation", "Registration"],
    },
)
