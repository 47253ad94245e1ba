"""An image and what is known of a template go in; where the template is as a rigid body comes out:
by features that two images share, or by the edges that its outline follows. NumPy, OpenCV and SciPy
only.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["outline"],
    submod_attrs={
        "features": ["Features", "FeatureRules", "detected", "pairs"],
        "outline": ["OutlineSettings", "fitted"],
    },
)
