"""Points of a patch go in; its canonical frame and its jet come out, and the jet's geometry in
closed form: points, normals, metric, curvatures. Each formula is written once, for arrays of
NumPy, torch and Dr.Jit; the fit of batches alone (``fit``) needs torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "backends": ["namespace"],
        "batches": ["fit"],
        "frames": ["CanonicalFrame", "rotation_matrix", "rotation_rows"],
        "jet": [
            "basis",
            "derivatives",
            "from_matrix",
            "height",
            "height_derivatives",
            "matrix",
            "mean_curvature",
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
        "least_squares": ["JetFit", "fit_points"],
        "monomials": ["check_order", "exponents", "order_of", "size_of"],
    },
)
