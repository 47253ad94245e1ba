"""Pictures of where a run differs from another run, or from ground truth: false colours, plots,
EXR layers.
"""

import os
import re

import numpy as np

from polyfit.backend import set_variant
from polyfit.files import folder_aside, json_text
from polysft_mi.errors import InputError
from polysft_mi.results.comparison import LABELS

from . import exr, figures
from .panels import box_of, evenly_spaced, panels


def write_comparison(comparison, out, *, count=20, scale=None):
    """Draw a :class:`~polysft_mi.results.comparison.Comparison` into the folder ``out``:
    compare.json, figures.png and, for at most ``count`` frames, NNN.png and NNN.exr with the
    differences in false colours.

    ``scale``: the difference [mm] at which the colours end; by default 98 % of the pixels lie below
    it. Returns the number of frames drawn. Raises InputError.
    """
    set_variant()
    run = comparison.run
    if run.camera is None:
        raise InputError(f"{run.folder}: holds no camera.json, which pictures need; run it again")
    shown = [comparison.frames[i] for i in evenly_spaced(len(comparison.frames), count)]
    maps = {k: difference_maps(comparison, k) for k in shown}
    scale = max(_scale_of(maps.values()) if scale is None else scale, 1e-3)
    runs = [r for r in (run, comparison.other) if r]
    drawn, boxes = [_panels_of(r, set(shown)) for r in runs], [box_of(r) for r in runs]
    sides = [(side, comparison.figures[side.lower()]) for side in "AB"]
    title = "   ".join(f"{s}: {'/'.join(os.path.normpath(p).split(os.sep)[-2:])}" for s, p in sides)
    with folder_aside(out, _is_ours, "compare.json") as folder:
        for k in shown:
            images = [("frame", drawn[0][k]["target"], boxes[0])]
            for side, own, box in zip("AB", drawn, boxes, strict=False):
                images += [(side, own[k]["render"], box)] if k in own else []
            values = _millimetres(maps[k], dots=comparison.truth.kind == "points")
            path = os.path.join(folder, f"{k:03d}.png")
            figures.false_colours(path, f"frame {k}      {title}", images, values, scale, boxes[0])
            layers = _images_of_runs(comparison, k) | maps[k]
            layers["false_colour"] = figures.false_colour(*values[0], scale)
            about = {"frame": k, **{s.lower(): p for s, p in sides}, "false_colour_mm": scale}
            about["scene"] = os.path.abspath(run.path("scene.xml"))
            about |= run.about.get("versions", {})
            exr.write_exr(os.path.join(folder, f"{k:03d}.exr"), layers, about, plain="false_colour")
        columns = {n: v for n, v in comparison.figures["per_frame"].items() if n != "shared"}
        figures.frame_plot(os.path.join(folder, "figures.png"), columns, LABELS)
        with open(os.path.join(folder, "compare.json"), "w", encoding="utf-8") as file:
            known = {**comparison.figures, "false_colour_mm": scale}
            file.write(json_text(known, indent=1) + "\n")
    return len(shown)


def difference_maps(comparison, frame):
    """Images (H, W) [m] of a frame, as A's camera sees it, NaN where a value is not known:
    ``depth_a``, and as far as B allows ``depth_b``, ``depth_difference`` and ``distance``.
    """
    from polyfit.pictures import Triangles

    run, truth = comparison.run, comparison.truth
    V, G = comparison.vertices(frame), truth.at(frame)
    surface = Triangles(V, run.faces.astype(np.int64))
    if truth.kind == "clouds":
        from scipy.spatial import cKDTree

        depth, distance = surface.seen(run.camera, [cKDTree(G).query(V)[0]])
        return {"depth_a": depth, "distance": distance}
    if truth.kind == "points":
        (depth_a,), distance, depth_b = surface.seen(run.camera), [], _splatted(G, run.camera)
    else:
        values = [np.linalg.norm(V - G, axis=1)] if comparison.same_mesh else []
        depth_a, *distance = surface.seen(run.camera, values)
        (depth_b,) = Triangles(G, truth.faces).seen(run.camera)
    maps = {"depth_a": depth_a, "depth_b": depth_b, "depth_difference": depth_a - depth_b}
    return {**maps, "distance": distance[0]} if distance else maps


def _is_ours(name):
    """Whether a file in the folder is one that :func:`write_comparison` wrote, by its name."""
    known = name in ("compare.json", "figures.png")
    return known or re.fullmatch(r"\d{3,}\.(png|exr)", name) is not None


def _millimetres(maps, dots):
    """The pairs (name, (H, W) [mm]) that are drawn; with ``dots``, few pixels become dots."""
    names = [name for name in ("distance", "depth_difference") if name in maps]
    return [(n, _dots(1e3 * maps[n]) if dots else 1e3 * maps[n]) for n in names]


def _scale_of(maps, share=0.98):
    """The difference [mm] that so large a share of the pixels lies below."""
    drawn = [x for m in maps for _, x in _millimetres(m, dots=False)]
    values = np.concatenate([np.abs(x[np.isfinite(x)]) for x in drawn])
    return float(np.quantile(values, share)) if values.size else 1.0


def _panels_of(run, shown):
    """The pictures of :func:`polysft_mi.pictures.panels.panels` of the frames ``shown``, by their
    index.
    """
    return {int(k): p for k, p in zip(run.frames, panels(run)) if int(k) in shown}


def _images_of_runs(comparison, frame):
    """The images of both runs in a frame that their own EXR files hold, as the layers ``target``,
    ``a``, ``b`` and ``difference``.
    """
    layers, camera = {}, comparison.run.camera
    for name, run in (("a", comparison.run), ("b", comparison.other)):
        path = run.path("comparison", f"{frame:03d}.exr") if run else ""
        if os.path.isfile(path):
            found = exr.read_exr(path)[0]
            if found["render"].shape[:2] == (camera.height, camera.width):
                layers[name] = found["render"].astype(np.float32)
                layers.setdefault("target", found["target"])
    if "a" in layers and "b" in layers:
        layers["difference"] = layers["a"] - layers["b"]
    return layers


def _splatted(points, camera):
    """Depth (H, W) [m] of points (P, 3), the nearest in each pixel, NaN where none is."""
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]
    x, y = np.floor(camera.project(points)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    depth = np.full(camera.height * camera.width, np.inf)
    np.minimum.at(depth, (y * camera.width + x)[inside], points[inside, 2])
    return np.where(np.isfinite(depth), depth, np.nan).reshape(camera.height, camera.width)


def _dots(values, share=0.05):
    """An image (H, W) of values at few pixels, NaN elsewhere, as dots that can be seen; as it is
    where more than ``share`` of the pixels have one.
    """
    from scipy.ndimage import distance_transform_edt

    missing = np.isnan(values)
    if missing.all() or (~missing).mean() > share:
        return values
    far, (row, column) = distance_transform_edt(missing, return_indices=True)
    return np.where(far <= max(2, values.shape[1] / 160), values[row, column], np.nan)
