"""A run against another run, or against ground truth: the figures of their differences.

Surfaces are compared in the camera frame, frame by frame, at the frames that both have. Differences
are A minus B. :mod:`polysft_mi.pictures.comparison` draws them.
"""

import os
from dataclasses import dataclass

import numpy as np

from polysft_mi.errors import InputError

from . import evaluation
from .metrics import depth_rmse
from .run import Run
from .truth import Truth

OWN_LABELS = {
    "psnr_mask": "PSNR inside the surface [dB]",
    "ssim_mask": "SSIM inside the surface",
    "seconds_per_frame": "seconds a frame",
    "order": "order of the jet",
}
LABELS = {
    **evaluation.LABELS,
    "depth_difference_mm": "difference in depth, RMS [mm]",
    "depth_difference_mm_worst": "difference in depth, RMS, worst frame [mm]",
    "en_deg_worst": "angle between normals, worst frame [deg]",
    "depth_rmse_allpix_mm_worst": "depth RMSE over all pixels, worst frame [mm]",
    "shared": "vertices of B whose ray meets A",
}


@dataclass(frozen=True)
class Comparison:
    """Run A beside what it is compared with.

    ``run``: A, a :class:`~polysft_mi.results.run.Run`; ``other``: B where it is a run, else None;
    ``truth``: the surface or the points of B, a :class:`~polysft_mi.results.truth.Truth`;
    ``figures``: the dict that :func:`compare` describes.
    """

    run: Run
    other: Run
    truth: Truth
    figures: dict

    @property
    def frames(self):
        """The frames that both have, in order."""
        return self.figures["per_frame"]["frame"]

    @property
    def same_mesh(self):
        """Whether both have the same triangles, so that vertices correspond."""
        return _same_mesh(self.run, self.truth)

    def vertices(self, frame):
        """A's vertices (N, 3) [m, camera frame] in a frame."""
        return self.run.vertices[list(self.run.frames).index(frame)].astype(np.float64)


def compare(a, b):
    """The :class:`Comparison` of the run A with B.

    ``a``: A's folder. ``b``: the folder of another run, or ground truth as
    :meth:`polysft_mi.results.truth.Truth.open` takes it. Raises InputError.

    ``figures`` of the result: ``a``, ``b``: the arguments; ``frames``: their number;
    ``difference``: name to mean, and NAME_worst to the worst frame's; ``own``: name to [of A, of
    B], for two runs; ``per_frame``: equally long lists by name, ``frame`` among them.
    """
    run, other = Run.open(a), None
    if os.path.isfile(os.path.join(b, "run.json")):
        other = Run.open(b)
        places = {int(k): V for k, V in zip(other.frames, other.vertices)}
        truth = Truth(b, "mesh", places, other.faces.astype(np.int64))
        columns = _run_against_run(run, truth)
    else:
        truth = Truth.open(b)
        surface = {"vertices": run.vertices, "faces": run.faces, "frames": run.frames}
        columns = evaluation.per_frame(surface, truth)
    difference = {}
    for name, values in columns.items():
        if name != "frame":
            difference[name] = float(np.mean(values))
            if name.endswith(("_mm", "_deg", "_1e4")):
                difference[f"{name}_worst"] = float(np.max(values))
    pairs = {n: [run.metrics.get(n), other.metrics.get(n)] for n in OWN_LABELS} if other else {}
    figures = {
        "a": a,
        "b": b,
        "frames": len(columns["frame"]),
        "difference": difference,
        "own": {n: p for n, p in pairs.items() if all(isinstance(x, (int, float)) for x in p)},
        "per_frame": columns,
    }
    return Comparison(run, other, truth, figures)


def _run_against_run(run, truth):
    """The figures of each frame of two runs: those of vertices where their triangles are the same,
    and those of the depth.
    """
    rows, faces = [], run.faces.astype(np.int64)
    same = _same_mesh(run, truth)
    for k, V in sorted(zip(map(int, run.frames), run.vertices.astype(np.float64))):
        if k in truth.places:
            G = truth.at(k)
            row = evaluation.against_mesh(V, G, faces, truth.path) if same else {}
            error, share = depth_rmse(V, faces, G)
            more = {"depth_difference_mm": 1e3 * error, "shared": share}
            rows.append({"frame": k, **row, **more})
    if not rows:
        raise InputError(f"{truth.path}: has no frame in common with {run.folder}")
    return {name: [row[name] for row in rows] for name in rows[0]}


def _same_mesh(run, truth):
    count = run.vertices.shape[1]
    return (
        truth.kind == "mesh"
        and np.array_equal(truth.faces, run.faces)
        and all(len(G) == count for G in truth.places.values())
    )
