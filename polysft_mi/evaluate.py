"""``python -m polysft_mi.evaluate OUT TRUTH``: the figures of a run against ground truth, as a
table or as JSON.

OUT is a run's folder (with ``surface.npz``) or a ``surface.npz``. TRUTH is ``gt.npz`` (vertices of
every frame), an .npz of depth points, a folder of ``cloud_*.npz``, or a sequence's folder that
holds one of them. :func:`polysft_mi.results.metrics.score` says what the figures are.
"""

import glob
import json
import os
import sys

import numpy as np

from . import commands
from .errors import InputError, cli
from .results.metrics import load_npz, score

_EXAMPLES = [
    ("out/demo scenes/demo", "a run against the truth in its sequence's folder"),
    ("out/flag/surface.npz /data/flag/gt.npz --json", "files alone; one JSON object on stdout"),
]

LABELS = {
    "frames": "frames compared",
    "rmse_mm": "vertex RMSE [mm]",
    "rmse_mm_worst": "vertex RMSE, worst frame [mm]",
    "e3d": "e3d",
    "e3d_proc": "e3d after similarity alignment",
    "en_deg": "angle between normals [deg]",
    "depth_rmse_mm": "depth RMSE on the surface [mm]",
    "depth_rmse_mm_worst": "depth RMSE, worst frame [mm]",
    "hit": "points whose ray meets the surface",
    "depth_rmse_allpix_mm": "depth RMSE over all pixels [mm]",
    "chamfer_1e4": "chamfer, squared, two-way [1e-4 m^2]",
    "chamfer_1e4_worst": "chamfer, worst frame [1e-4 m^2]",
    "sigma_factor": "factor at which sigma holds 68 % of the errors",
    "sigma_two": "share of the errors within twice that",
    "sigma_rank": "rank correlation of sigma and error",
    "psnr": "PSNR [dB]",
    "ssim": "SSIM",
    "psnr_mask": "PSNR inside the mask [dB]",
    "ssim_mask": "SSIM inside the mask",
}


def read_surface(path):
    """The arrays of a ``surface.npz``, or of a run's folder that holds one. Raises InputError where
    it is not of that form.
    """
    if os.path.isdir(path):
        if not os.path.exists(os.path.join(path, "surface.npz")):
            raise InputError(
                f"{path}: holds no surface.npz; the folder of a run, or a surface.npz, is needed"
            )
        path = os.path.join(path, "surface.npz")
    surface = load_npz(path)
    missing = [name for name in ("vertices", "faces", "frames") if name not in surface]
    if missing:
        raise InputError(
            f"{path}: holds no {', '.join(missing)}; vertices (T,N,3), faces (F,3) and frames (T,)"
            " are needed"
        )
    V, F, frames = (surface[name] for name in ("vertices", "faces", "frames"))
    if (
        V.ndim != 3
        or V.shape[2] != 3
        or F.ndim != 2
        or F.shape[1] != 3
        or frames.shape != V.shape[:1]
        or not len(frames)
    ):
        raise InputError(
            f"{path}: vertices {V.shape}, faces {F.shape}, frames {frames.shape}; (T,N,3), (F,3)"
            " and (T,) with T > 0 are needed"
        )
    if V.dtype.kind not in "fiu" or F.dtype.kind not in "iu" or frames.dtype.kind not in "iu":
        raise InputError(
            f"{path}: types {V.dtype}, {F.dtype}, {frames.dtype} of vertices, faces, frames; a"
            " float and two integers are needed"
        )
    if F.size and not 0 <= F.min() <= F.max() < V.shape[1]:
        raise InputError(
            f"{path}: faces name vertices {F.min()} to {F.max()}; 0 to {V.shape[1] - 1} exist"
        )
    if not np.isfinite(V).all():
        raise InputError(f"{path}: vertices hold values that are not finite")
    return surface


def find_truth(path):
    """The ground truth in ``path``: a file as it is, a folder of clouds as it is, else what a
    sequence's folder holds.
    """
    if not os.path.isdir(path):
        return path
    if glob.glob(os.path.join(glob.escape(path), "cloud_*.npz")):
        return path
    for name in ("gt.npz", "gt_points.npz", "points.npz"):
        if os.path.exists(os.path.join(path, name)):
            return os.path.join(path, name)
    clouds = os.path.join(path, "clouds")
    if glob.glob(os.path.join(glob.escape(clouds), "cloud_*.npz")):
        return clouds
    raise InputError(
        f"{path}: holds no ground truth; gt.npz, gt_points.npz or clouds/cloud_*.npz is needed"
    )


def image_figures(out):
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


def evaluate(out, truth):
    """All figures of the run ``out`` against ``truth`` (paths as on the command line), a dict."""
    surface = read_surface(out)
    figures = score(surface, find_truth(truth))
    return {**figures, **(image_figures(out) if os.path.isdir(out) else {})}


def _format(value):
    return str(value) if isinstance(value, int) else f"{value:.5g}"


def print_table(figures, title, labels=LABELS):
    """The figures as a table: by rich on a terminal, as aligned plain text elsewhere."""
    rows = [(labels.get(k, k), _format(v)) for k, v in figures.items() if not isinstance(v, dict)]
    if not sys.stdout.isatty():
        width = max(len(label) for label, _ in rows)
        for label, value in rows:
            print(f"{label:{width}s}  {value}")
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title))  # as Text, because rich takes "[mm]" in a str for markup
    table.add_column("figure")
    table.add_column("value", justify="right")
    for row in rows:
        table.add_row(*map(Text, row))
    Console().print(table)


def parser():
    p = commands.parser("evaluate", "Figures of a reconstruction against ground truth.", _EXAMPLES)
    p.add_argument("out", metavar="OUT", help="folder of a run, or a surface.npz")
    p.add_argument(
        "truth",
        metavar="TRUTH",
        help="gt.npz, an .npz of depth points, a folder of cloud_*.npz, or a sequence's folder",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    figures = evaluate(options.out, options.truth)
    if options.json:
        print(json.dumps(figures))
    else:
        print_table(figures, options.out)
    return 0


if __name__ == "__main__":
    cli(main)
