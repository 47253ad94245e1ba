"""``python -m polysft_mi.compare A B``: a run against another run, or against ground truth:
figures, and pictures of where they differ.

Surfaces are compared in the camera frame, frame by frame, at the frames that both have. Differences
are A minus B.
"""

import json
import os
import re

import numpy as np

from . import commands, evaluate
from .errors import InputError, cli
from .files import folder_aside
from .pictures.shading import seen
from .results import exr, metrics
from .results.run import Run

_EXAMPLES = [
    ("out/a out/b", "two runs: their figures"),
    (
        "out/demo scenes/demo -o out/demo_errors",
        "a run and its ground truth; pictures of the errors",
    ),
    ("out/a out/b -o out/a_b --scale 5", "false colours up to 5 mm"),
    ("out/a out/b --json", "one JSON object on stdout"),
]

_OWN = {
    "psnr_mask": "PSNR inside the surface [dB]",
    "ssim_mask": "SSIM inside the surface",
    "seconds_per_frame": "seconds a frame",
    "order": "order of the jet",
}
LABELS = {
    **evaluate.LABELS,
    "depth_difference_mm": "difference in depth, RMS [mm]",
    "shared": "vertices of B whose ray meets A",
}
LABELS |= {
    f"{name}_worst": label.replace(" [", ", worst frame [")
    for name, label in LABELS.items()
    if f"{name}_worst" not in LABELS
}


class Other:
    """What A is compared with: ``per_frame()`` the figures of each frame, ``frames`` those that
    both have, ``maps(k)`` the differences in frame ``k`` [m].
    """

    def __init__(self, run, path):
        self.run, self.path = run, path
        self.at = {int(k): V.astype(np.float64) for k, V in zip(run.frames, run.vertices)}
        self.faces = run.faces.astype(np.int64)
        self.other = Run.open(path) if os.path.isfile(os.path.join(path, "run.json")) else None
        if self.other is not None:
            self.truth = {
                int(k): V.astype(np.float64) for k, V in zip(self.other.frames, self.other.vertices)
            }
            self.truth_faces, self.kind = self.other.faces.astype(np.int64), "mesh"
        else:
            self._open_truth(evaluate.find_truth(path))
        self.frames = sorted(set(self.at) & set(self.truth))
        if not self.frames:
            raise InputError(f"{path}: has no frame in common with {run.folder}")
        self.same = (
            self.kind == "mesh"
            and self.truth_faces.shape == self.faces.shape
            and (self.truth_faces == self.faces).all()
        )
        self.same &= self.kind == "mesh" and all(
            self.truth[k].shape == self.at[k].shape for k in self.frames
        )

    def _open_truth(self, where):
        self.where, self.truth_faces = where, None
        if os.path.isdir(where):
            names = [
                (re.fullmatch(r"cloud_(\d+)\.npz", name), os.path.join(where, name))
                for name in os.listdir(where)
            ]
            self.kind, self.truth = "cloud", {int(m[1]): path for m, path in names if m}
            return
        truth = metrics.load_npz(where)
        if "points" in truth and "frames" in truth:
            self.kind, self.truth = (
                "points",
                {int(k): p.astype(np.float64) for k, p in zip(truth["frames"], truth["points"])},
            )
        elif "vertices" in truth and "faces" in truth:
            self.kind, self.truth, self.truth_faces = (
                "mesh",
                dict(enumerate(truth["vertices"].astype(np.float64))),
                truth["faces"].astype(np.int64),
            )
        else:
            raise InputError(
                f"{where}: holds {', '.join(truth)}; vertices and faces, or points and frames, are"
                " needed"
            )

    def per_frame(self):
        """Equally long lists by name, ``frame`` among them."""
        if self.other is None:
            return metrics.per_frame(
                {"vertices": self.run.vertices, "faces": self.run.faces, "frames": self.run.frames},
                self.where,
            )
        rows = (
            list(metrics.against_meshes(self.at, self.truth, self.faces, self.path))
            if self.same
            else [{"frame": k} for k in self.frames]
        )
        for row in rows:
            error, share = metrics.depth_rmse(
                self.at[row["frame"]], self.faces, self.truth[row["frame"]]
            )
            row |= {"depth_difference_mm": 1e3 * error, "shared": share}
        return {name: [row[name] for row in rows] for name in rows[0]}

    def maps(self, k, camera):
        """Images (H, W) of the frame ``k``, NaN where there is none: ``distance`` and
        ``depth_difference`` [m], depths [m], as far as they can be told.
        """
        V, other = self.at[k], self.truth[k]
        if self.kind == "cloud":
            from scipy.spatial import cKDTree

            points = metrics.load_npz(other).get("points")
            if points is None:
                raise InputError(f"{other}: holds no points")
            depth, distance = seen(V, self.faces, camera, [cKDTree(points).query(V)[0]])
            return {"depth_a": depth, "distance": distance}
        if self.kind == "points":
            (depth_a,) = seen(V, self.faces, camera)
            depth_b = _splatted(other, camera)
            return {"depth_a": depth_a, "depth_b": depth_b, "depth_difference": depth_a - depth_b}
        values = [np.linalg.norm(V - other, axis=1)] if self.same else []
        depth_a, *distance = seen(V, self.faces, camera, values)
        (depth_b,) = seen(other, self.truth_faces, camera)
        maps = {"depth_a": depth_a, "depth_b": depth_b, "depth_difference": depth_a - depth_b}
        return {**maps, "distance": distance[0]} if distance else maps


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


def compare(a, b):
    """Figures of the run ``a`` (a folder) against ``b``, a run or ground truth as
    :mod:`polysft_mi.evaluate` takes it: ``(figures, Other)``.

    ``figures``: ``a``, ``b``, ``frames``, ``difference`` (name to mean, and to the worst frame's as
    NAME_worst), ``own`` (name to [a, b], of two runs), ``per_frame``. Raises InputError.
    """
    run = Run.open(a)
    other = Other(run, b)
    columns = other.per_frame()
    difference = {}
    for name, values in columns.items():
        if name != "frame":
            difference[name] = float(np.mean(values))
            if name.endswith(("_mm", "_deg", "_1e4")):
                difference[f"{name}_worst"] = float(np.max(values))
    own = {}
    if other.other is not None:
        both = run.metrics, other.other.metrics
        own = {
            name: [m.get(name) for m in both]
            for name in _OWN
            if all(isinstance(m.get(name), (int, float)) for m in both)
        }
    return {
        "a": a,
        "b": b,
        "frames": len(columns["frame"]),
        "difference": difference,
        "own": own,
        "per_frame": columns,
    }, other


def write(figures, other, out, *, count=20, scale=None):
    """Write compare.json, figures.png and, for at most ``count`` frames, NNN.png and NNN.exr with
    the differences in false colours into the folder ``out``.

    ``scale``: the difference [mm] at which the colours end, by default what 98 % of the pixels lie
    below.
    """
    from .pictures import figures as pictures
    from .report import spread

    camera = other.run.camera
    if camera is None:
        raise InputError(
            f"{other.run.folder}: holds no camera.json, which pictures need (an older version ran"
            " it); run it again"
        )
    shown = [other.frames[i] for i in spread(len(other.frames), count)]
    maps = {k: other.maps(k, camera) for k in shown}
    if scale is None:
        values = np.concatenate(
            [
                np.abs(m[name][np.isfinite(m[name])])
                for m in maps.values()
                for name in ("distance", "depth_difference")
                if name in m
            ]
        )
        scale = 1e3 * float(np.quantile(values, 0.98)) if values.size else 1.0
    scale = max(scale, 1e-3)
    panels = [_pictures(run, set(shown)) if run else {} for run in (other.run, other.other)]
    ours = lambda name: (
        name in ("compare.json", "figures.png")
        or re.fullmatch(r"\d{3,}\.(png|exr)", name) is not None
    )
    names = "   ".join(
        f"{side}: {'/'.join(os.path.normpath(figures[side.lower()]).split(os.sep)[-2:])}"
        for side in "AB"
    )
    with folder_aside(out, ours) as folder:
        for k in shown:
            images = [("frame", panels[0][k][0]), ("A", panels[0][k][1])] + (
                [("B", panels[1][k][1])] if k in panels[1] else []
            )
            drawn = [
                (name, 1e3 * maps[k][name])
                for name in ("distance", "depth_difference")
                if name in maps[k]
            ]
            if other.kind == "points":
                drawn = [(name, _dots(values)) for name, values in drawn]
            pictures.false_colours(
                os.path.join(folder, f"{k:03d}.png"),
                f"frame {k}      {names}",
                images,
                drawn,
                scale,
            )
            layers = _layers(other, k, camera) | maps[k]
            layers["false_colour"] = pictures.false_colour(*drawn[0], scale)
            versions = other.run.about.get("versions", {})
            metadata = {
                "frame": k,
                "a": figures["a"],
                "b": figures["b"],
                "false_colour_mm": scale,
                "scene": os.path.abspath(other.run.path("scene.xml")),
                **versions,
            }
            exr.write_exr(
                os.path.join(folder, f"{k:03d}.exr"), layers, metadata, plain="false_colour"
            )
        pictures.frame_plot(
            os.path.join(folder, "figures.png"),
            {n: v for n, v in figures["per_frame"].items() if n != "shared"},
            LABELS,
        )
        with open(os.path.join(folder, "compare.json"), "w", encoding="utf-8") as file:
            json.dump({**figures, "false_colour_mm": scale}, file, indent=1)
            file.write("\n")
    return len(shown)


def _pictures(run, shown):
    """The pictures of :meth:`polysft_mi.results.run.Run.panels` of the frames ``shown``, by their
    index.
    """
    return {
        int(k): [panel.copy() for panel in panels]
        for k, panels in zip(run.frames, run.panels())
        if int(k) in shown
    }


def _layers(other, k, camera):
    """The images of both runs in the frame ``k`` that their own EXR files hold, as the layers
    ``target``, ``a``, ``b`` and ``difference``.
    """
    layers = {}
    for name, run in (("a", other.run), ("b", other.other)):
        path = run.path("comparison", f"{k:03d}.exr") if run else ""
        if os.path.isfile(path):
            found = exr.read_exr(path)[0]
            if found["render"].shape[:2] == (camera.height, camera.width):
                layers[name] = found["render"].astype(np.float32)
                layers.setdefault("target", found["target"])
    if "a" in layers and "b" in layers:
        layers["difference"] = layers["a"] - layers["b"]
    return layers


def parser():
    p = commands.parser(
        "compare",
        "Compare a run with another run, or with ground truth. Differences are A minus B.",
        _EXAMPLES,
    )
    p.add_argument("a", metavar="A", help="folder of a run")
    p.add_argument(
        "b", metavar="B", help="folder of another run, or ground truth as evaluate takes it"
    )
    p.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help=(
            "folder for compare.json, figures.png, and a PNG and an EXR a frame with the"
            " differences in false colours"
        ),
    )
    p.add_argument(
        "--frames",
        type=int,
        default=20,
        metavar="N",
        help="pictures of at most N frames, spread evenly (default: 20)",
    )
    p.add_argument(
        "--scale",
        type=float,
        metavar="MM",
        help=(
            "difference at which the false colours end (default: that which 98 %% of the pixels lie"
            " below)"
        ),
    )
    p.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    p.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if (
        options.frames < 1
        or options.scale is not None
        and not (np.isfinite(options.scale) and options.scale > 0)
    ):
        raise InputError(
            f"--frames {options.frames} --scale {options.scale}: at least one frame and a positive"
            " number of millimetres are needed"
        )
    if options.output is not None and not os.path.isdir(
        os.path.dirname(os.path.abspath(options.output))
    ):
        raise InputError(
            f"-o {options.output}: no such folder:"
            f" {os.path.dirname(os.path.abspath(options.output))}"
        )
    figures, other = compare(options.a, options.b)
    if options.output is not None:
        write(figures, other, options.output, count=options.frames, scale=options.scale)
    if options.json:
        print(json.dumps(figures))
    elif not options.quiet:
        rows = {"frames": figures["frames"], **figures["difference"]}
        evaluate.print_table(rows, f"{options.a} against {options.b}", LABELS)
        for name, (one, two) in figures["own"].items():
            print(f"{_OWN[name]}: {one:.4g} (A), {two:.4g} (B)")
        if options.output is not None:
            print(f"written: {options.output}")
    return 0


if __name__ == "__main__":
    cli(main)
