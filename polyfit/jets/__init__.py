"""Points of a patch go in; its canonical frame and its jet come out, and the jet's geometry in
closed form: points, normals, metric, curvatures. In torch; the monomials need NumPy alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "frames": ["CanonicalFrame", "rotation_matrix"],
        "jet": [
            "basis",
            "derivatives",
            "from_matrix",
            "height",
            "height_derivatives",
            "matrix",
            "metric",
            "nearest",
            "normal",
            "point",
            "powers",
            "principal_curvatures",
            "second_fundamental_form",
            "tangents",
            "turned_over",
        ],
        "least_squares": ["JetFit", "fit"],
        "monomials": ["DETERMINED_RMS", "MIN_BOX_RATIO", "exponents", "order_of", "size_of"],
    },
)
