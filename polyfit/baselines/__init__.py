"""Networks of others that PolyFit is compared with: patches go in, jets come out (PointNet, DGCNN);
surfaces go in, surfaces come out (AtlasNet).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "atlasnet": ["AtlasNet", "chamfer", "normalised"],
        "regressors": ["DGCNN", "PointNet"],
    },
)
