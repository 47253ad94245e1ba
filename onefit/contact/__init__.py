"""Contact: cloth and a moving body go in; what keeps the one out of the other, and cloth apart from
itself, come out: pushes, for post-processing, and planes, for the steps of a simulation.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "flesh": ["Flesh", "spread"],
        "kernels": ["neighbour_mean"],
        "layers": ["SelfContact"],
        "planes": ["Contacts", "ThreadContact", "weighted"],
        "settings": [
            "DEEPEST",
            "EASED",
            "MADE",
            "POINT_CLEARANCE",
            "POINT_NEAR",
            "TOUCHING",
            "ContactSettings",
        ],
        "skin": ["SkinContact"],
    },
)
