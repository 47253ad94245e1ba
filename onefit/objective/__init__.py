"""What a drape costs: positions of cloth and body in some frames go in; the losses that train a
network, and the measures of a drape, come out.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "losses": ["Weights"],
        "measures": ["Measures", "depths_beneath", "measure"],
        "objective": ["posed"],
        "piercing": ["crossing_faces", "crossings"],
    },
)
