"""The figures and texts of a report."""

import numpy as np

from polysft_mi.results import Truth, per_frame

from ..figures import COLOURS, TERMS, loss_curves

_LABELS = {
    "frame": "frame",
    "psnr_mask": "PSNR inside the surface [dB]",
    "ssim_mask": "SSIM inside the surface",
    "iou": "silhouettes, IoU",
    "iterations": "iterations",
    "seconds": "seconds",
    "rgb": "photometric loss",
    "inextensibility": "inextensibility loss",
    "order": "order of the jet",
    "score_mm": "score, median [mm]",
    "rmse_mm": "distance to the truth, RMS [mm]",
    "e3d": "e3d",
    "e3d_proc": "e3d, aligned",
    "en_deg": "normals [deg]",
    "depth_rmse_mm": "depth RMSE [mm]",
    "depth_rmse_allpix_mm": "depth RMSE, all pixels [mm]",
    "hit": "share of points hit",
    "chamfer_1e4": "chamfer [1e-4 m²]",
}


_OF_IMAGES = ("psnr_mask", "ssim_mask", "iou")


def _of(name, camera):
    """What a figure of a further camera is called."""
    return f"{name}, {camera}"


def _named(row, camera):
    return {n if n == "frame" else _of(n, camera): value for n, value in row.items()}


def labels(run):
    """Names of figures to texts."""
    cameras = run.metrics.get("cameras", {})
    further = {_of(n, c): f"{c}: {_LABELS[n]}" for c in cameras for n in _OF_IMAGES}
    return _LABELS | further


def further(run):
    """Of each further camera its name, its figures as a text, and the path of its picture."""
    texts = {"psnr_mask": "PSNR {:.2f} dB", "ssim_mask": "SSIM {:.3f}", "iou": "IoU {:.3f}"}
    return [
        (
            name,
            ", ".join(form.format(known[n]) for n, form in texts.items() if n in known),
            run.path(f"comparison_{name}.png"),
        )
        for name, known in run.metrics.get("cameras", {}).items()
    ]


def figures(run, truth):
    """``(columns, cards, distance)``: lists by frame, pairs of label and value for the top, and (T,
    N) [mm] to a truth of the same vertices or None.
    """
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
        truth = Truth.open(truth)
        surface = {"vertices": run.vertices, "faces": run.faces, "frames": run.frames}
        rows = per_frame(surface, truth)
        add(
            [n for n in rows if n != "frame"],
            [dict(zip(rows, values)) for values in zip(*rows.values())],
        )
        cards += [
            (_LABELS.get(n, n), f"{np.mean(rows[n]):.3g}")
            for n in rows
            if n not in ("frame", "hit")
        ]
        distance = _distance(run, truth)
    metric = run.metrics
    add(_OF_IMAGES, metric.get("per_frame", []))
    for camera, known in metric.get("cameras", {}).items():
        rows = [_named(row, camera) for row in known.get("per_frame", [])]
        add([_of(name, camera) for name in _OF_IMAGES], rows)
    if run.score is not None:
        known = np.isfinite(run.score).any(axis=1)
        columns["score_mm"] = [
            float(1e3 * np.nanmedian(s)) if ok else None for s, ok in zip(run.score, known)
        ]
    add(("rgb", "inextensibility", "iterations", "seconds", "order"), metric.get("windows", []))
    if len(set(columns.get("order", []))) == 1:
        del columns["order"]
    wanted = {
        "psnr_mask": ("PSNR inside the surface", "{:.2f} dB"),
        "ssim_mask": ("SSIM inside the surface", "{:.3f}"),
        "iou": ("IoU of the silhouettes", "{:.3f}"),
        "seconds_per_frame": ("seconds a frame", "{:.2f}"),
    }
    cards += [
        (label, form.format(metric[name]))
        for name, (label, form) in wanted.items()
        if name in metric
    ]
    if "score_mm" in columns:
        known = [s for s in columns["score_mm"] if s is not None] or [np.nan]
        cards.append(("how far off it may be (score), median", f"{np.median(known):.2f} mm"))
    lost = metric.get("lost", {})
    cards.append(("lost frames", str(len(lost))))
    return columns, cards, distance


def _distance(run, truth):
    """Distance (T, N) [mm] of each vertex from the truth, NaN in frames without one; None where the
    truth has other vertices.
    """
    out = np.full(run.vertices.shape[:2], np.nan, np.float32)
    known = [t for t, k in enumerate(run.frames) if int(k) in truth.places]
    if truth.kind != "mesh" or any(
        truth.places[int(run.frames[t])].shape != run.vertices.shape[1:] for t in known
    ):
        return None
    for t in known:
        out[t] = 1e3 * np.linalg.norm(run.vertices[t] - truth.at(int(run.frames[t])), axis=1)
    return out


def subtitle(run, shown):
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


def warning(run):
    lost, wanted = run.metrics.get("lost", {}), run.metrics.get("frames_wanted", len(run.frames))
    texts = (
        [f"Interrupted: {len(run.frames)} of {wanted} frames."] if wanted > len(run.frames) else []
    )
    if known := run.metrics.get("undecided"):
        texts.append(
            f"Undecided: from frame {known['from']} on a second surface, up to"
            f" {known['apart_mm']:.1f} mm away, explains the video nearly as well (other.npz)."
        )
    if doubtful := {k: v for k, v in run.metrics.get("doubtful", {}).items() if k not in lost}:
        frame, reason = next(iter(doubtful.items()))
        more = f" So are {len(doubtful) - 1} more frames." if len(doubtful) > 1 else ""
        texts.append(f"Frame {frame} is doubtful: {reason}.{more}")
    texts += [f"Frame {frame}: {reason}." for frame, reason in list(lost.items())[:5]]
    return " ".join(texts + ([f"And {len(lost) - 5} more lost frames."] if len(lost) > 5 else []))


def about(run):
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
    if second := metric.get("second_pass"):
        rows.append(["second pass", second])
    if run.camera:
        c = run.camera
        rows.append(
            ["camera [pixels]", f"fx {c.fx:.2f}, fy {c.fy:.2f}, cx {c.cx:.2f}, cy {c.cy:.2f}"]
        )
    return rows + [[name, str(value)] for name, value in about.get("versions", {}).items()]


def loss(records, most=4000):
    """The curves of the losses over the ``records`` of a log, at most ``most`` of them; None
    where there are none.
    """
    try:
        records, step, curves = loss_curves(records)
    except ValueError:
        return None
    kept = slice(None, None, -(-len(records) // most))
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
