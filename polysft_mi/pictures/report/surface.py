"""The surface of a report, which the page draws in 3D: a mesh, and what colours it."""

import base64
import os

import numpy as np

from polyfit.colours import patch_colours, range_of


def mesh(run, shown, triangles=24_000):
    """The surface for the page: coarse positions, z up, as 16 bit numbers, and a finer mesh on it
    whose vertices have the texture's colours.
    """
    from polyfit.animation import from_camera
    from polyfit.mesh import refined

    V = from_camera(run.vertices[shown], "z").astype(np.float64)
    low, high = V.reshape(-1, 3).min(0), V.reshape(-1, 3).max(0)
    positions = np.round((V - low) / np.maximum(high - low, 1e-12) * 65535).astype("<u2")
    source, uv, faces = run.texcoords.split(run.faces.astype(np.int64))
    parts = max(1, min(8, int(np.sqrt(triangles / len(faces)))))
    fine, face, weights = refined(faces, parts)
    corners = source[faces[face]]
    mesh = {
        "vertices": run.vertices.shape[1],
        "low": low.tolist(),
        "high": np.maximum(high, low + 1e-9).tolist(),
        "positions": _base64(positions),
        "corners": _base64(corners.astype("<u4")),
        "weights": _base64(weights.astype("<f4")),
        "faces": _base64(fine.astype("<u4")),
    }
    at = lambda values: np.einsum("nk,nkc->nc", weights, values)
    colours = _texture_colours(run.texture, at(uv[faces[face]]), fine)
    if colours is not None:
        mesh["colours"] = _base64(colours)
    patch, weight = (run.params[name] for name in ("patch", "weight"))
    if patch.max() > 0:
        shades = at(patch_colours(patch, weight)[corners].astype(np.float64))
        mesh["patches"] = _base64(np.round(shades).astype(np.uint8))
    return mesh


def _texture_colours(path, uv, fine):
    """Colours (M, 3) uint8 of the texture at uv (M, 2), averaged over about a triangle's size; None
    where there is no readable texture.
    """
    import cv2

    image = cv2.imread(path) if path is not None and os.path.isfile(path) else None
    if image is None:
        return None
    side = np.linalg.norm(uv[fine[:, 0]] - uv[fine[:, 1]], axis=1)
    texels = float(np.median(side)) * max(image.shape[:2])  # from vertex to vertex
    if texels > 1:
        smaller = [max(1, round(s / texels)) for s in image.shape[1::-1]]
        image = cv2.resize(image, smaller, interpolation=cv2.INTER_AREA)
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    sampled = cv2.remap(
        image,
        x.astype(np.float32)[:, None],
        y.astype(np.float32)[:, None],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return sampled.reshape(-1, 3)[:, ::-1]


_ERRORS = {
    "residual": (
        "local contrast",
        "Rendering minus image where each vertex is seen, both freed from lighting: what is bright"
        " is out of place.",
    ),
    "error": (
        "linear colour",
        "Rendering minus image in linear colour where each vertex is seen, light and shade included"
        " (root mean square over the channels).",
    ),
}


def scalars(run, shown, errors, distance):
    """What the surface may be coloured by: for each its texts, its range and scale, and the values
    (S, N) as bytes, 255 for what is not known.
    """
    out = []
    if distance is not None:
        out.append(
            _scalar(
                "distance to the truth",
                "Distance of each vertex from the true one.",
                "mm",
                distance[shown],
                "viridis",
            )
        )
    for name, (unit, meaning) in _ERRORS.items():
        if name in errors:
            out.append(_scalar(name, meaning, unit, errors[name], "inferno"))
    curvature = run.mean_curvature()[shown]
    meaning = (
        "Mean curvature of the jet, without its relief: red where the surface bulges towards the"
        " first frame's camera, blue where it is hollow."
    )
    out.append(_scalar("curvature", meaning, "1/m", curvature, "RdBu_r", signed=True))
    if run.other is not None:
        apart = 1e3 * np.linalg.norm(run.other[shown] - run.vertices[shown], axis=-1)
        meaning = "Distance of each vertex to the second surface, which explains the video as well."
        out.append(_scalar("second surface", meaning, "mm", apart, "viridis"))
    for name, of, meaning in (
        ("sigma", run.sigma, "Standard deviation of each vertex along its ray, by the noise alone"),
        ("score", run.score, "How far off each vertex may be along its ray, fitted to errors"),
    ):
        if of is not None and np.isfinite(of[shown]).any():
            meaning += "; grey where it is not known."
            out.append(_scalar(name, meaning, "mm", 1e3 * of[shown], "viridis"))
    return out


def _scalar(label, meaning, unit, values, colours, *, signed=False):
    import matplotlib
    from matplotlib.colors import to_hex

    known, (low, top) = np.isfinite(values), range_of(values, signed)
    raw = np.round(np.clip((np.where(known, values, 0) - low) / (top - low), 0, 1) * 254).astype(
        np.uint8
    )
    scale = [to_hex(c) for c in matplotlib.colormaps[colours](np.linspace(0, 1, 17))]
    return {
        "label": label,
        "meaning": meaning,
        "unit": unit,
        "low": low,
        "high": top,
        "scale": scale,
        "values": _base64(np.where(known, raw, 255).astype(np.uint8)),
    }


def _base64(array):
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
