"""A run against ground truth: the figures of each frame, and of the sequence.

:mod:`polysft_mi.results.metrics` defines the figures of a frame; :func:`score` says what those of a
sequence are.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping

import numpy as np

from polysft_mi.errors import InputError

from .metrics import (
    align_similarity,
    chamfer,
    depth_rmse,
    e3d,
    image_share,
    normal_angle,
    rmse,
    sample_surface,
)
from .truth import Truth, check_surface, read_surface

_ALIKE = 5.0  # times as large as each other, at most, a surface and what it is compared with
LABELS = {
    "frames": "frames compared",
    "rmse_mm": "vertex RMSE [mm]",
    "rmse_mm_worst": "vertex RMSE, worst frame [mm]",
    "e3d": "e3d",
    "e3d_proc": "e3d after similarity alignment",
    "en_deg": "angle between normals [deg]",
    "rmse_mm_seen": "vertex RMSE, vertices in view [mm]",
    "e3d_proc_seen": "e3d after alignment, vertices in view",
    "en_deg_seen": "angle between normals, vertices in view [deg]",
    "depth_rmse_mm": "depth RMSE on the surface [mm]",
    "depth_rmse_mm_worst": "depth RMSE, worst frame [mm]",
    "hit": "points whose ray meets the surface",
    "depth_rmse_allpix_mm": "depth RMSE over all pixels [mm]",
    "chamfer_1e4": "chamfer, squared, two-way [1e-4 m^2]",
    "chamfer_1e4_worst": "chamfer, worst frame [1e-4 m^2]",
    "sigma_two": "share of the errors within two sigma",
    "sigma_factor": "factor at which sigma holds 68 % of the errors",
    "sigma_rank": "rank correlation of sigma and error",
    "score_two": "share of the errors within two scores",
    "score_factor": "factor at which the score holds 68 % of the errors",
    "score_rank": "rank correlation of score and error",
    "psnr": "PSNR [dB]",
    "ssim": "SSIM",
    "psnr_mask": "PSNR inside the mask [dB]",
    "ssim_mask": "SSIM inside the mask",
}


def evaluate(out, truth):
    """All figures of a run against ground truth, a dict.

    ``out``: a run's folder or a ``surface.npz``; ``truth``: as :meth:`Truth.open` takes it. Raises
    InputError.
    """
    figures = score(read_surface(out), truth)
    return {**figures, **(_image_figures(out) if os.path.isdir(out) else {})}


def _image_figures(out):
    """The PSNR and SSIM figures that a run left in its metrics.json, or none."""
    path = os.path.join(out, "metrics.json")
    if not os.path.isfile(path):
        return {}
    try:
        with open(path, encoding="utf-8") as file:
            figures = json.load(file)
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error})") from None
    if not isinstance(figures, dict):
        return {}
    return {
        k: v
        for k, v in figures.items()
        if k.startswith(("psnr", "ssim")) and isinstance(v, (int, float))
    }


def score(surface: Mapping[str, np.ndarray], truth: Truth | str | os.PathLike[str]) -> dict:
    """The figures of a reconstruction: a dict of numbers, its keys by the kind of truth.

    ``surface`` maps ``vertices`` (T, N, 3) [m], ``faces`` (F, 3), ``frames`` (T,), and perhaps
    ``sigma`` and ``score`` (T, N) [m]; ``truth``: a :class:`Truth`, or its path. A figure is the
    mean of those of the frames; NAME_worst is that of the worst frame. Raises InputError where they
    cannot be compared.
    """
    truth = truth if isinstance(truth, Truth) else Truth.open(truth)
    columns = per_frame(surface, truth)
    summary: dict = {"frames": len(columns["frame"])}
    for name, values in columns.items():
        if name != "frame":
            summary[name] = float(np.mean(values))
        if name in ("rmse_mm", "depth_rmse_mm", "chamfer_1e4"):
            summary[f"{name}_worst"] = float(np.max(values))
    if "depth_rmse_mm" in columns:
        summary["per_frame_mm"] = {
            str(k): round(v, 2) for k, v in zip(columns["frame"], columns["depth_rmse_mm"])
        }
    return summary | confidence(surface, truth)


def per_frame(surface, truth):
    """The figures of each frame that both have: a dict of equally long lists, ``frame`` and the
    figures of :func:`score`, which says what the arguments are.
    """
    check_surface(surface, "surface")
    meshes = np.asarray(surface["vertices"], dtype=np.float64)
    faces = np.asarray(surface["faces"], dtype=np.int64)
    at = {int(k): V for k, V in zip(surface["frames"], meshes)}
    _check_alike(meshes[0], faces, truth)
    rng = np.random.default_rng(0)  # one stream through all frames, so that figures repeat
    rows = [{"frame": k, **_figures(at[k], faces, truth, k, rng)} for k in truth.places if k in at]
    if not rows:
        raise InputError(
            f"{truth.path}: has no frame in common with the surface's frames {min(at)} to {max(at)}"
        )
    if truth.kind == "points" and not any(row["hit"] for row in rows):
        raise InputError(
            f"{truth.path}: no point lies on a ray that meets the surface; metres in the camera's"
            " frame (x right, y down, z forward) are needed"
        )
    return {name: [row[name] for row in rows] for name in rows[0]}


def _check_alike(V, faces, truth):
    """Raise InputError where true meshes cannot be of the surface with vertices V (N, 3) [m] and
    ``faces`` (F, 3): in another unit, in another frame, or with vertices in another order.
    """
    from polyfit.mesh import edges_of

    if truth.kind != "mesh":
        return
    G = truth.at(min(truth.places))
    size = np.linalg.norm(np.ptp(G, axis=0)) / max(np.linalg.norm(np.ptp(V, axis=0)), 1e-12)
    if not 1 / _ALIKE < size < _ALIKE:
        raise InputError(
            f"{truth.path}: {size:.3g} times as large as the surface; both are needed in metres"
        )
    if (G[:, 2] <= 0).all():
        raise InputError(
            f"{truth.path}: lies behind the camera; the camera's frame is needed: x right, y down,"
            " z forward"
        )
    key = lambda faces: np.unique(np.sort(edges_of(faces)[0], axis=1), axis=0)
    if len(V) == len(G):  # quads may have been cut the other way
        ours, theirs = ({tuple(e) for e in key(f).tolist()} for f in (faces, truth.faces))
        if 2 * len(ours & theirs) < len(theirs):
            raise InputError(
                f"{truth.path}: its faces join other vertices than the surface's; the template's"
                " own vertices, in its order, are needed"
            )


def _figures(V, faces, truth, frame, rng):
    """The figures of one frame, whose surface has the vertices V (N, 3) [m]."""
    G = truth.at(frame)
    if truth.kind == "mesh":
        seen = truth.seen[frame] if truth.seen is not None else None
        return against_mesh(V, G, faces, truth.path, seen)
    if truth.kind == "clouds":
        return {"chamfer_1e4": 1e4 * chamfer(sample_surface(V, faces, len(G), rng), G)}
    error, share = depth_rmse(V, faces, G)
    row = {"depth_rmse_mm": 1e3 * error, "hit": share}
    if truth.K is not None:
        all_pixels = float(np.sqrt(image_share(V, faces, truth.K)))
        row["depth_rmse_allpix_mm"] = row["depth_rmse_mm"] * all_pixels
    return row


def against_mesh(V, G, faces, where, seen=None):
    """The figures of vertices V (N, 3) [m] against G (N, 3) [m], both with the triangles ``faces``
    (F, 3); NAME_seen: over those alone that are ``seen`` (N,) bool, aligned by these alone. Raises
    InputError, which names ``where``, for different numbers of vertices.
    """
    if len(V) != len(G):
        raise InputError(
            f"surface has {len(V)} vertices, {where} has {len(G)}; the template's own vertices are"
            " needed"
        )
    moved = align_similarity(V, G)
    figures = {
        "rmse_mm": 1e3 * rmse(V, G),
        "e3d": e3d(V, G),
        "e3d_proc": e3d(moved, G),
        "en_deg": normal_angle(moved, G, faces),
    }
    if seen is None:
        return figures
    moved = align_similarity(V, G, seen)
    return figures | {
        "rmse_mm_seen": 1e3 * rmse(V[seen], G[seen]),
        "e3d_proc_seen": e3d(moved[seen], G[seen]),
        "en_deg_seen": normal_angle(moved, G, faces, seen),
    }


def confidence(surface, truth):
    """How ``sigma`` and ``score`` (T, N) [m] of a surface relate to its errors along the rays,
    where the truth has the same vertices; {} where it cannot be told.

    NAME_two: the share of the errors within twice as much (95 % were they Gaussian); NAME_factor:
    what it has to be multiplied by for 68 % of the errors to lie within it; NAME_rank: rank
    correlation with the errors. The first frame, where the template stands in its place, is left
    out.
    """
    if "sigma" not in surface or truth.kind != "mesh":
        return {}
    frames = [int(k) for k in surface["frames"]]
    known = [i for i, k in enumerate(frames) if k > 0 and k in truth.places]
    found = np.asarray(surface["vertices"], dtype=np.float64)[known]
    true = [truth.at(frames[i]) for i in known]
    if any(G.shape != found.shape[1:] for G in true) or not known:
        return {}
    ray = found / np.linalg.norm(found, axis=2, keepdims=True)
    errors = np.abs(((found - true) * ray).sum(2)).ravel()
    figures = {}
    for name in ("sigma", "score"):
        if name not in surface:
            continue
        told = np.asarray(surface[name], dtype=np.float64)[known].ravel()
        usable = np.isfinite(told) & (told > 0)
        if usable.sum() < 2:
            continue
        error, told = errors[usable], told[usable]
        ratio = error / told
        ranks = [np.argsort(np.argsort(x)) for x in (error, told)]
        figures |= {
            f"{name}_two": float((ratio <= 2).mean()),
            f"{name}_factor": float(np.quantile(ratio, 0.68)),
            f"{name}_rank": float(np.corrcoef(*ranks)[0, 1]),
        }
    return figures
