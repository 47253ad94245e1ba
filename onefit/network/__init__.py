"""The network: features of patches and the motion of a body go in, deformations of the patches come
out. Its weights are read from files and written to them.
"""

import lazy_loader

DEFAULT = "taught"  # of the networks of the package, where none is named

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "network": ["EXTRAS", "OneFit"],
        "weights": ["Trained"],
    },
)
