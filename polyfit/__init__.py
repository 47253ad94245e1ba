"""PolyFit: surfaces as patches, each a jet in a canonical frame (paper, section "PolyFit").

A mesh goes in, its patches and a surface of any resolution come out::

    import polyfit

    vertices, faces, _ = polyfit.read_mesh("garment.obj")  # metres
    surface = polyfit.PatchedSurface.from_mesh(vertices, faces)
    fine, fine_faces = surface.resampled(4)

``docs/api.md`` lists the public names. torch is loaded where the first of them that needs it is
used: networks, and fits of batches.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "errors": ["InputError"],
        "jets.batches": ["fit"],
        "jets.frames": ["CanonicalFrame", "rotation_matrix"],
        "jets.jet": [
            "height",
            "height_derivatives",
            "metric",
            "normal",
            "point",
            "principal_curvatures",
            "second_fundamental_form",
            "tangents",
            "turned_over",
        ],
        "jets.least_squares": ["JetFit"],
        "jets.monomials": ["exponents"],
        "mesh.meshio": ["read_mesh", "write_ply"],
        "network.stn": ["PolyFit", "SpatialTransformer"],
        "patches.patches": ["Patches", "patch_count"],
        "patches.surface": ["PatchedSurface", "smoothed"],
    },
)
