"""``python -m polysft_mi.report OUT``: one page, in one file, that shows a run in any browser and
without a network.
"""

import base64
import io
import json
import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from importlib import resources

import numpy as np

from . import commands
from .errors import InputError, cli
from .files import aside
from .results.run import PEAK, Run

_EXAMPLES = [
    ("out/demo", "out/demo/report.html again (a run writes it at its end)"),
    (
        "out/demo --truth scenes/demo",
        "with figures and colours of the distance to the true surface",
    ),
    (
        "out/demo -o page.html --frames 50",
        "elsewhere, and smaller: 50 frames spread over the video",
    ),
]

# vertices of all frames together that a page may hold; fewer frames are shown where there are more
_NUMBERS = 450_000
_IMAGES = 9_000_000  # bytes of all pictures together, before base64
_SIZES = (
    (640, 80),
    (640, 70),
    (480, 75),
    (480, 60),
    (360, 60),
    (240, 50),
)  # width and quality, the first that fits
_FINE = 24_000  # triangles that a page may draw
_RECORDS = 4000  # points of the loss curves
_WORKERS = 2


def write(out, path=None, *, truth=None, frames=200):
    """Write the report of the run in the folder ``out`` to ``path`` (default: ``report.html`` in
    it), at most ``frames`` frames spread evenly; returns the path.

    ``truth``: ground truth as :mod:`polysft_mi.evaluate` takes it. Raises InputError.
    """
    run = Run.open(out)
    path = run.path("report.html") if path is None else path
    if os.path.isdir(path) or not os.path.isdir(os.path.dirname(os.path.abspath(path))):
        raise InputError(f"{path}: is not a file in a folder that exists")
    count, vertices = run.vertices.shape[:2]
    shown = spread(count, min(frames, max(1, _NUMBERS // vertices)))
    columns, cards, distance = _figures(run, truth)
    images, errors = _images(run, shown)
    data = {
        "title": os.path.basename(os.path.abspath(out)),
        "subtitle": _subtitle(run, shown),
        "warning": _warning(run),
        "cards": cards,
        "command": run.about.get("command", ""),
        "settings": [[name, value or ""] for name, value in run.settings.items()],
        "about": _about(run),
        "footer": (
            f"polysft_mi {run.about.get('versions', {}).get('polysft_mi', '')}. Lengths in metres,"
            " camera frame turned to z up."
        ),
        "shown": shown,
        "fps": run.fps,
        "peak": f"{PEAK:g} or more",
        "columns": columns,
        "labels": _LABELS,
        "images": images,
        "mesh": _mesh(run, shown),
        "scalars": _scalars(run, shown, errors, distance),
        "loss": _loss(run.log()),
    }
    from plotly.offline import get_plotlyjs

    page = resources.files(__package__).joinpath("data/report.html").read_text(encoding="utf-8")
    text = (
        json.dumps(_finite(data), separators=(",", ":"), allow_nan=False)
        .replace("</", "<\\/")
        .replace("<!--", "<\\u0021--")
    )
    title = data["title"].replace("&", "&amp;").replace("<", "&lt;")
    for name, value in (("title", title), ("plotly", get_plotlyjs()), ("data", text)):
        before, mark, after = page.partition("{{" + name + "}}")
        page = before + value + after
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(page)
    return path


def spread(count, limit):
    """At most ``limit`` of ``count`` indices, spread evenly, first and last among them."""
    return (
        list(range(count))
        if limit >= count
        else sorted(set(np.linspace(0, count - 1, max(limit, 1)).round().astype(int).tolist()))
    )


def _finite(value):
    """The same for JSON: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _base64(array):
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


# ---- figures and texts ---------------------------------------------------------------------------

_LABELS = {
    "frame": "frame",
    "psnr_mask": "PSNR inside the surface [dB]",
    "ssim_mask": "SSIM inside the surface",
    "iterations": "iterations",
    "seconds": "seconds",
    "rgb": "photometric loss",
    "inextensibility": "inextensibility loss",
    "order": "order of the jet",
    "sigma_mm": "sigma, median [mm]",
    "rmse_mm": "distance to the truth, RMS [mm]",
    "e3d": "e3d",
    "e3d_proc": "e3d, aligned",
    "en_deg": "normals [deg]",
    "depth_rmse_mm": "depth RMSE [mm]",
    "depth_rmse_allpix_mm": "depth RMSE, all pixels [mm]",
    "hit": "share of points hit",
    "chamfer_1e4": "chamfer [1e-4 m²]",
}


def _figures(run, truth):
    """``(columns, cards, distance)``: lists by frame, pairs of label and value for the top, and (T,
    N) [mm] to a truth of the same vertices or None.
    """
    from . import evaluate
    from .results import metrics

    at = {int(k): n for n, k in enumerate(run.frames)}
    columns = {"frame": [int(k) for k in run.frames]}

    def add(names, records):
        for name in names:
            column = [None] * len(run.frames)
            for record in records:
                if record.get("frame") in at and name in record:
                    column[at[record["frame"]]] = record[name]
            if any(value is not None for value in column):
                columns[name] = column

    cards, distance = [], None
    if truth is not None:
        where = evaluate.find_truth(truth)
        surface = {"vertices": run.vertices, "faces": run.faces, "frames": run.frames}
        rows = metrics.per_frame(surface, where)
        add(
            [n for n in rows if n != "frame"],
            [dict(zip(rows, values)) for values in zip(*rows.values())],
        )
        cards += [
            (_LABELS.get(n, n), f"{np.mean(rows[n]):.3g}")
            for n in rows
            if n not in ("frame", "hit")
        ]
        distance = _distance(run, where)
    metric = run.metrics
    add(("psnr_mask", "ssim_mask"), metric.get("per_frame", []))
    if run.sigma is not None:
        known = np.isfinite(run.sigma).any(axis=1)
        columns["sigma_mm"] = [
            float(1e3 * np.nanmedian(s)) if ok else None for s, ok in zip(run.sigma, known)
        ]
    add(("rgb", "inextensibility", "iterations", "seconds", "order"), metric.get("windows", []))
    if len(set(columns.get("order", []))) == 1:
        del columns["order"]
    wanted = {
        "psnr_mask": ("PSNR inside the surface", "{:.2f} dB"),
        "ssim_mask": ("SSIM inside the surface", "{:.3f}"),
        "seconds_per_frame": ("seconds a frame", "{:.2f}"),
    }
    cards += [
        (label, form.format(metric[name]))
        for name, (label, form) in wanted.items()
        if name in metric
    ]
    if "sigma_mm" in columns:
        cards.append(
            (
                "sigma along the ray, median",
                (
                    f"{np.median([s for s in columns['sigma_mm'] if s is not None] or [np.nan]):.2f} mm"
                ),
            )
        )
    lost = metric.get("lost", {})
    cards.append(("lost frames", str(len(lost))))
    return columns, cards, distance


def _distance(run, where):
    """Distance (T, N) [mm] of each vertex from the truth, NaN in frames without one; None where the
    truth has other vertices.
    """
    from .results.metrics import load_npz

    truth = load_npz(where) if os.path.isfile(where) else {}
    G = truth.get("vertices")
    if G is None or G.ndim != 3 or G.shape[1:] != run.vertices.shape[1:]:
        return None
    out = np.full(run.vertices.shape[:2], np.nan, np.float32)
    known = run.frames < len(G)
    out[known] = 1e3 * np.linalg.norm(run.vertices[known] - G[run.frames[known]], axis=2)
    return out


def _subtitle(run, shown):
    camera, metric = run.camera, run.metrics
    count = f"{len(run.frames)} frames" + (
        f" ({len(shown)} shown)" if len(shown) < len(run.frames) else ""
    )
    size = f" of {camera.width}×{camera.height}" if camera else ""
    how = (
        f"jet of order {metric.get('order', '?')}, solver {metric.get('solver', '?')},"
        f" {run.about.get('started', '')}"
    )
    return f"{count}{size}, {run.vertices.shape[1]} vertices, {how}"


def _warning(run):
    lost, wanted = run.metrics.get("lost", {}), run.metrics.get("frames_wanted", len(run.frames))
    texts = (
        [f"Interrupted: {len(run.frames)} of {wanted} frames."] if wanted > len(run.frames) else []
    )
    texts += [f"Frame {frame}: {reason}." for frame, reason in list(lost.items())[:5]]
    return " ".join(texts + ([f"And {len(lost) - 5} more lost frames."] if len(lost) > 5 else []))


def _about(run):
    about, metric = run.about, run.metrics
    rows = [["started", about.get("started", "")]]
    rows += [
        [label, f"{metric[name]:.3g}"]
        for name, label in (
            ("template_residual_rms_mm", "template against its jet, RMS [mm]"),
            ("template_residual_max_mm", "at most [mm]"),
        )
        if name in metric
    ]
    rows += [["texture", run.texture or "none"]]
    if run.camera:
        c = run.camera
        rows.append(
            ["camera [pixels]", f"fx {c.fx:.2f}, fy {c.fy:.2f}, cx {c.cx:.2f}, cy {c.cy:.2f}"]
        )
    return rows + [[name, str(value)] for name, value in about.get("versions", {}).items()]


def _loss(records):
    from .pictures.figures import COLOURS, TERMS, loss_curves

    try:
        records, step, curves = loss_curves(records)
    except ValueError:
        return None
    kept = slice(None, None, -(-len(records) // _RECORDS))
    terms = [
        {
            "label": TERMS[t],
            "colour": COLOURS[t],
            "values": [float(f"{v:.5g}") for v in values[kept]],
        }
        for t, values in curves.items()
    ]
    return {
        "step": [int(s) for s in step[kept]],
        "frame": [r["frame"] for r in records[kept]],
        "terms": terms,
    }


# ---- pictures ------------------------------------------------------------------------------------


def _images(run, shown):
    """The pictures as base64 by name, and the error (S, N) at each vertex of the frames shown, or
    None where the camera is not known.
    """
    import cv2
    from PIL import Image

    wanted, budget = set(shown), _IMAGES / len(shown)
    size = None
    encoded, errors = [], []

    def encode(panels, width, quality):
        out = []
        for panel in panels:
            panel = np.ascontiguousarray(panel)
            if width < panel.shape[1]:
                panel = cv2.resize(
                    panel,
                    (width, max(1, round(panel.shape[0] * width / panel.shape[1]))),
                    interpolation=cv2.INTER_AREA,
                )
            data = io.BytesIO()
            Image.fromarray(panel).save(
                data, "WEBP", quality=quality, method=2
            )  # half the time of the default for 3 % more bytes
            out.append(data.getvalue())
        return out

    with ThreadPoolExecutor(_WORKERS) as pool:
        waiting = deque()
        for k, panels in enumerate(run.panels()):
            if k not in wanted:
                continue
            if (
                size is None or encoded and len(encoded) == 1
            ):  # by the first frames: how large pictures may be
                size = next(
                    (
                        s
                        for s in _SIZES[_SIZES.index(size) if size else 0 :]
                        if sum(map(len, encode(panels, *s))) <= budget
                    ),
                    _SIZES[-1],
                )
            if run.camera is not None:
                errors.append(_error_at_vertices(run.camera, run.vertices[k], panels[2]))
            waiting.append(pool.submit(encode, panels, *size))
            if len(waiting) > 2 * _WORKERS:
                encoded.append(waiting.popleft().result())
        encoded += [w.result() for w in waiting]
    named = {
        name: [base64.b64encode(images[c]).decode("ascii") for images in encoded]
        for c, name in enumerate(("target", "render", "error"))
    }
    return {"kind": "webp", **named}, np.stack(errors) if errors else None


def _error_at_vertices(camera, vertices, panel):
    """The error (N,) where each vertex is seen, read off the picture of the error (a mean over 3x3
    of its pixels); NaN outside the image.
    """
    import cv2

    red, green, blue = (
        panel[..., c].astype(np.float32) for c in range(3)
    )  # a fifth of the time of a sum over the axis
    error = cv2.blur((red + green + blue) * (PEAK / 765), (3, 3))
    before = vertices[:, 2] > 0
    x, y = (camera.project(vertices) * (panel.shape[1] / camera.width)).T
    inside = before & (x >= 0) & (y >= 0) & (x < error.shape[1]) & (y < error.shape[0])
    out = np.full(len(vertices), np.nan, np.float32)
    out[inside] = error[y[inside].astype(int), x[inside].astype(int)]
    return out


# ---- the surface ---------------------------------------------------------------------------------


def _mesh(run, shown):
    """The surface for the page: coarse positions, z up, as 16 bit numbers, and a finer mesh on it
    whose vertices have the texture's colours.
    """
    from polyfit.animation import from_camera
    from polyfit.mesh import refined

    V = from_camera(run.vertices[shown], "z").astype(np.float64)
    low, high = V.reshape(-1, 3).min(0), V.reshape(-1, 3).max(0)
    positions = np.round((V - low) / np.maximum(high - low, 1e-12) * 65535).astype("<u2")
    faces = run.faces.astype(np.int64)
    parts = max(1, min(8, int(np.sqrt(_FINE / len(faces)))))
    fine, face, weights = refined(faces, parts)
    corners = faces[face]
    mesh = {
        "vertices": run.vertices.shape[1], "low": low.tolist(), "high": np.maximum(high, low + 1e-9).tolist(),
        "positions": _base64(positions), "corners": _base64(corners.astype("<u4")),
        "weights": _base64(weights.astype("<f4")), "faces": _base64(fine.astype("<u4")),
    }  # fmt: skip
    colours = _texture_colours(
        run.texture,
        np.einsum("nk,nkc->nc", weights, run.uv[corners].astype(np.float64)),
        run.uv,
        fine,
    )
    return mesh if colours is None else {**mesh, "colours": _base64(colours)}


def _texture_colours(path, uv, coarse_uv, fine):
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


def _scalars(run, shown, errors, distance):
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
    if errors is not None:
        meaning = (
            "Root mean square over the channels of rendering minus image, in linear colour, where"
            " each vertex is seen."
        )
        out.append(_scalar("error", meaning, "linear colour", errors, "inferno"))
    curvature = run.mean_curvature()[shown]
    meaning = (
        "Mean curvature of the jet, without its relief: red where the surface bulges towards the"
        " first frame's camera, blue where it is hollow."
    )
    out.append(_scalar("curvature", meaning, "1/m", curvature, "RdBu_r", signed=True))
    if run.sigma is not None and np.isfinite(run.sigma[shown]).any():
        meaning = (
            "Standard deviation of each vertex along its ray, as the solver estimates it; grey"
            " where it is not known."
        )
        out.append(_scalar("sigma", meaning, "mm", 1e3 * run.sigma[shown], "viridis"))
    return out


def _scalar(label, meaning, unit, values, colours, *, signed=False):
    import matplotlib
    from matplotlib.colors import to_hex

    known = np.isfinite(values)
    top = float(np.quantile(np.abs(values[known]), 0.99) if known.any() else 1) or 1.0
    low = -top if signed else 0.0
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


def parser():
    p = commands.parser(
        "report",
        "Write one page, in one file, that shows a run in any browser and without a network.",
        _EXAMPLES,
    )
    p.add_argument("out", metavar="OUT", help="folder of a run")
    p.add_argument(
        "-o", "--output", metavar="FILE", help="file to write (default: report.html in OUT)"
    )
    p.add_argument("--truth", metavar="TRUTH", help="ground truth, as evaluate takes it")
    p.add_argument(
        "--frames",
        type=int,
        default=200,
        metavar="N",
        help="show at most N frames, spread over the video (default: 200)",
    )
    p.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    if options.frames < 1:
        raise InputError(f"--frames {options.frames}; at least 1 is needed")
    path = write(options.out, options.output, truth=options.truth, frames=options.frames)
    if not options.quiet:
        print(f"written: {path}, {os.path.getsize(path) / 1e6:.1f} MB; open it in a browser")
    return 0


if __name__ == "__main__":
    cli(main)
