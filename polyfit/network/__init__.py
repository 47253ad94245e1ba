"""Patches of points go in; frames and jets come out, by a network with trained weights. Its layers
and its files of weights serve other networks too.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "stn": [
            "PRETRAINED",
            "PatchFit",
            "PolyFit",
            "SpatialTransformer",
            "linear",
            "normalised_layer",
            "pointwise",
            "subsampled",
        ],
        "weights": ["load_into", "read_weights", "write_weights"],
    },
)
