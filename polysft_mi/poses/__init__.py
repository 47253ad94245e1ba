"""An image and what is known of a template go in; where the template is as a rigid body comes out:
by features that two images share, or by the edges that its outline follows. NumPy, OpenCV and SciPy
only.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["outline"],
    submod_attrs={
        "features": ["Features", "FeatureRules", "detected", "pairs"],
        "outline": ["OutlineSettings", "fitted"],
    },
)
