"""What a user should be told of a mesh that can be used, but may not be what was meant."""

import numpy as np

from .triangles import edges_of


def size_note(vertices: np.ndarray, where: str = "mesh", what: str = "mesh") -> str | None:
    """A line about a mesh, called ``what``, whose size in metres is unlikely, with the factors that
    would make it likely; None for one that lies between a grain of rice and a house. ``vertices``
    (N, 3) [m].
    """
    extent, rice, house = float(np.ptp(vertices, axis=0).max()), 0.005, 10.0
    if rice <= extent <= house:
        return None
    # in the order in which people use them
    units = [("millimetres", 1e-3), ("centimetres", 1e-2), ("micrometres", 1e-6)]
    units = units if extent > house else [("kilometres", 1e3)]
    likely = [(unit, factor) for unit, factor in units if 0.02 <= factor * extent <= house]
    ways = [
        f"if it is in {unit}, scale it by {factor:g}, to {factor * extent:.3g} m"
        for unit, factor in likely or [("another unit", 1 / extent)]
    ]
    return (
        f"note: {where}: the {what} is {extent:.4g} m large, since lengths are read as metres;"
        f" {'; '.join(ways)}"
    )


def seam_note(vertices: np.ndarray, faces: np.ndarray, where: str = "mesh") -> str | None:
    """A line about boundary vertices (N, 3) [m] that lie on one another, so that the surface comes
    apart there; None without any.
    """
    from scipy.spatial import cKDTree

    edges, side = edges_of(faces)
    rim = np.unique(edges[np.bincount(side.ravel(), minlength=len(edges)) == 1])
    near = 1e-7 * np.ptp(vertices, axis=0).max()
    nearest = cKDTree(vertices[rim]).query(vertices[rim], k=2)[0][:, 1] if len(rim) else rim
    count = int((nearest <= near).sum())
    if not count:
        return None
    return (
        f"note: {where}: the surface is open where {count} vertices lie on others; if it should be"
        " whole there, merge them; seams of the texture an OBJ keeps all the same (f v/vt)"
    )
