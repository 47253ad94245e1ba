"""The physics of cloth: a garment's mesh, a material and a moving body go in; energies, their
gradients and second-order steps of the cloth come out.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "cloth": ["Cloth"],
        "material": ["MATERIALS", "Material"],
        "settings": ["Settings"],
        "sheet": ["Sheet"],
        "worn": ["WornCloth"],
    },
)
