"""PolyFit: surfaces as patches, each a jet in a canonical frame (paper, section "PolyFit"), in
torch.
"""

_EXPORTS = {
    "CanonicalFrame": "frames",
    "rotation_matrix": "frames",
    "exponents": "monomials",
    "height": "jets",
    "height_derivatives": "jets",
    "point": "jets",
    "tangents": "jets",
    "normal": "jets",
    "metric": "jets",
    "second_fundamental_form": "jets",
    "principal_curvatures": "jets",
    "turned_over": "jets",
    "fit": "jets",
    "JetFit": "jets",
    "Patches": "patches",
    "patch_count": "patches",
    "PatchedSurface": "surface",
    "smoothed": "surface",
    "read_mesh": "meshio",
    "write_ply": "meshio",
    "InputError": "errors",
    "PolyFit": "stn",
    "SpatialTransformer": "stn",
}

__all__ = sorted(_EXPORTS)


def __getattr__(name):
    # torch is loaded on first use, so that `import polyfit` stays instant
    if name in _EXPORTS:
        from importlib import import_module

        return getattr(import_module(f".{_EXPORTS[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__():
    return sorted(list(globals()) + __all__)
