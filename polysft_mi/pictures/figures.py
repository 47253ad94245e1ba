"""Pictures of a run: loss curves, figures a frame, and a sheet of chosen frames.

matplotlib is loaded on first use and without a display. Each function returns the path, or None
after a warning where the picture could not be drawn or written: a run must not be lost to its
pictures.
"""

import functools
import os
import textwrap
import warnings

import numpy as np

from polyfit.colours import linear
from polyfit.errors import Notice
from polyfit.files import DISK_FULL_ERRORS, aside

from .panels import PEAKS

TERMS = {"loss": "total", "rgb": "photometric"} | {
    t: t for t in ("silhouette", "shading", "inextensibility", "smoothness", "temporal")
}
COLOURS = dict(
    zip(
        TERMS,
        ("#222222", "#c4572e", "#3b6ea5", "#d19a1e", "#4b8b3b", "#7a7a7a", "#8d5aa0"),
        strict=True,
    )
)


def _kept_safe(draw):
    @functools.wraps(draw)
    def wrapper(path, *arguments, **options):
        try:
            figure = draw(path, *arguments, **options)
            with aside(path) as temporary:
                figure.savefig(temporary, facecolor="white")
            return os.fspath(path)
        except Exception as error:  # whatever it is, the results stand without the picture
            if getattr(error, "errno", None) in DISK_FULL_ERRORS:
                raise
            warnings.warn(
                f"{path}: picture not written ({type(error).__name__}: {error})",
                Notice,
                stacklevel=2,
            )
            return None

    return wrapper


def _figure(width, height, **options):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, **options)
    FigureCanvasAgg(figure)
    return figure


def _plain(axes):
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


@_kept_safe
def loss_plot(path, log_records):
    """Loss and its terms over all iterations, on a logarithmic axis, with a mark where a new frame
    begins.

    ``log_records``: dicts with ``frame``, ``iteration``, ``loss`` and any of the terms in
    ``TERMS``, in the order of the run; records without a loss are passed over.
    """
    records, step, curves = loss_curves(log_records)
    figure = _figure(9, 4, layout="constrained")
    axes = figure.add_subplot()
    for term, values in curves.items():
        axes.plot(
            step,
            values,
            color=COLOURS[term],
            label=TERMS[term],
            linewidth=1.4 if term == "loss" else 0.9,
        )
    axes.set_yscale("log")
    axes.set_xlabel("iteration, all frames one after the other")
    axes.set_ylabel("loss")
    starts = [
        (s, r["frame"])
        for s, r, before in zip(step, records, [None, *records])
        if before is None or before["frame"] != r["frame"]
    ]
    if len(starts) <= 200:
        axes.vlines(
            [s for s, _ in starts],
            0,
            1,
            transform=axes.get_xaxis_transform(),
            color="0.85",
            linewidth=0.5,
            zorder=0,
        )
    top = axes.secondary_xaxis("top")
    shown = starts[:: max(1, -(-len(starts) // 12))]
    top.set_xticks([s for s, _ in shown], [str(frame) for _, frame in shown], fontsize=8)
    top.set_xlabel("frame", fontsize=9)
    top.spines["top"].set_visible(False)
    _plain(axes)
    axes.set_xlim(step[0], max(step[-1], step[0] + 1))
    if axes.get_legend_handles_labels()[0]:
        figure.legend(frameon=False, fontsize=8, ncols=len(TERMS), loc="outside lower center")
    return figure


def loss_curves(log_records):
    """``(records, step, curves)``: the records with a loss, the iteration (R,) of each counted over
    all frames, and each term of ``TERMS`` that has one as its values (R,), NaN where they are not
    positive. Raises ValueError where no record holds a loss.
    """
    records = [r for r in log_records if "loss" in r and "frame" in r]
    if not records:
        raise ValueError("no record holds a loss")
    step = np.cumsum([_advance(a, b) for a, b in zip([None, *records], records)])
    curves = {}
    for term in TERMS:
        values = np.array([_number(r.get(term)) for r in records])
        values[~(values > 0)] = np.nan  # a logarithmic axis has no place for them
        if np.isfinite(values).any():
            curves[term] = values
    return records, step, curves


def _advance(before, record):
    """Iterations from one record to the next, so that records logged now and then keep their
    place.
    """
    iteration = _number(record.get("iteration"))
    if (
        before is None
        or before["frame"] != record["frame"]
        or not iteration > _number(before.get("iteration"))
    ):
        return 1
    return iteration - before["iteration"]


def _number(value):
    return float(value) if isinstance(value, (int, float)) else float("nan")


@_kept_safe
def frame_plot(path, per_frame, labels=None):
    """One small plot over the frames for each figure: ``per_frame`` is a dict of equally long
    lists, one of them ``frame``; ``labels`` names them.
    """
    from polysft_mi.results.evaluation import LABELS

    labels = labels or LABELS
    names = [k for k in per_frame if k != "frame"]
    figure = _figure(9, 1.7 * len(names) + 0.6, layout="constrained")
    frames = np.asarray(per_frame["frame"])
    for k, name in enumerate(names):
        axes = figure.add_subplot(len(names), 1, k + 1)
        values = np.array([_number(v) for v in per_frame[name]])
        axes.plot(frames, values, color="#c4572e", linewidth=1.2, marker="o", markersize=2.5)
        finite = values[np.isfinite(values)]
        if finite.size:
            axes.axhline(finite.mean(), color="0.55", linewidth=0.8, linestyle="--")
            if finite.min() >= 0:
                axes.set_ylim(0, 1.1 * finite.max() or 1)
            axes.set_title(
                f"{labels.get(name, name)}: mean {finite.mean():.4g}", fontsize=9, loc="left"
            )
        _plain(axes)
        axes.tick_params(labelsize=8, labelbottom=k == len(names) - 1)
    axes.set_xlabel("frame")
    return figure


@_kept_safe
def contact_sheet(path, rows, caption=""):
    """A row for each chosen frame: target, render, error and residual as heat maps, the surface
    seen from the side; ``caption`` below.

    ``rows``: dicts of ``target``, ``render`` and ``surface`` (H, W, 3), sRGB, uint8 or float in [0,
    1]; ``error`` and ``residual`` (H, W) float, each in one unit for all rows; and ``label``, a
    short text such as "frame 12". A picture that is missing leaves its place empty. The colours of
    the error end where 99.5 % of its values lie below, those of the residual at
    ``panels.PEAKS``.
    """
    rows = list(rows)
    pictures = [r[k] for r in rows for k in _SHEET if r.get(k) is not None]
    height, width = np.asarray(pictures[0]).shape[:2]
    columns = [k for k in _SHEET if any(r.get(k) is not None for r in rows)]
    peaks = {"error": _quantile(rows, "error"), "residual": PEAKS["residual"]}
    maps = [name for name in columns if name in peaks]
    wide, left, top, gap = 2.6, 0.25, 0.25, 0.04  # inches
    high, below = wide * height / width, 0.45 if maps else 0.05
    whole = left + len(columns) * (wide + gap), top + len(rows) * (high + gap) + below
    lines = textwrap.wrap(caption, int(17 * whole[0]))
    bottom = below + 0.16 * len(lines)
    whole = whole[0], whole[1] + bottom - below
    figure = _figure(*whole)

    # places in inches, by hand: finding them takes matplotlib longer than all the rest
    def axes_at(x, y, w, h):
        return figure.add_axes((x / whole[0], y / whole[1], w / whole[0], h / whole[1]))

    shown = {}
    for i, row in enumerate(rows):
        for j, name in enumerate(columns):
            y = bottom + (len(rows) - 1 - i) * (high + gap)
            axes = axes_at(left + j * (wide + gap), y, wide, high)
            _frameless(axes)
            image = row.get(name)
            if image is not None and name in peaks:
                image = np.asarray(image, dtype=np.float64)
                shown[name] = axes.imshow(image, cmap="inferno", vmin=0, vmax=peaks[name])
            elif image is not None:
                image = np.asarray(image)
                image = image if image.dtype == np.uint8 else np.clip(np.nan_to_num(image), 0, 1)
                axes.imshow(image)
            if i == 0:
                axes.set_title(_SHEET[name], fontsize=9)
            if j == 0:
                axes.set_ylabel(row.get("label", ""), fontsize=9)
    for name, drawn in shown.items():
        x = left + columns.index(name) * (wide + gap)
        scale = axes_at(x + 0.1 * wide, bottom - 0.15, 0.8 * wide, 0.08)
        figure.colorbar(drawn, cax=scale, orientation="horizontal").ax.tick_params(labelsize=7)
    figure.text(left / whole[0], 0.05 / whole[1], "\n".join(lines), fontsize=8, va="bottom")
    return figure


def _quantile(rows, name, share=0.995):
    """The value that this share of the pictures' pixels lies below; 1 where there are none."""
    values = [np.asarray(r[name], dtype=np.float64).ravel() for r in rows if name in r]
    finite = np.concatenate([v[np.isfinite(v)] for v in values]) if values else np.zeros(0)
    return max(float(np.quantile(finite, share)), 1e-6) if finite.size else 1.0


def _frameless(axes):
    axes.set_xticks([]), axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


_MAPS = {
    "distance": ("distance of A from B [mm]", "viridis", 0),
    "depth_difference": ("depth of A minus B [mm]", "RdBu_r", -1),
}


def false_colour(name, values, scale):
    """The difference ``name``, values (H, W) [mm], as linear RGB (H, W, 3): in the colours of
    :func:`false_colours`, black where it is not known.
    """
    import matplotlib

    _, colours, low = _MAPS[name]
    x = np.clip((values / scale - low) / (1 - low), 0, 1)
    rgb = matplotlib.colormaps[colours](np.nan_to_num(x))[..., :3]
    return np.where(np.isfinite(values)[..., None], linear(rgb), 0)


def false_colours(path, title, images, maps, scale, box):
    """Pictures side by side, and differences in false colours with their scale, of a part of the
    image.

    ``images``: (title, (h, w, 3) uint8, the :class:`~polysft_mi.pictures.panels.Box` that it
    shows); ``maps``: (name, (H, W) [mm] of the whole image, NaN where unknown), the name one of
    "distance" and "depth_difference"; colours end at ``scale`` [mm]. ``box``: the part to show.
    Raises OSError where it cannot be written.
    """
    (width, height), columns, wide = box.size, len(images) + len(maps), 3.2
    figure = _figure(wide * columns, wide * height / width + 0.75, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03, wspace=0, hspace=0)
    grid = list(figure.subplots(1, columns, squeeze=False)[0])
    for axes, (label, image, part) in zip(grid, images, strict=False):
        axes.imshow(image, extent=(part.left, part.right, part.bottom, part.top))
        axes.set_title(label, fontsize=9)
    for axes, (name, values) in zip(grid[len(images) :], maps, strict=True):
        label, colours, low = _MAPS[name]
        axes.set_facecolor("0.93")
        shown = axes.imshow(
            values,
            cmap=colours,
            vmin=low * scale,
            vmax=scale,
            interpolation="nearest",
            extent=(0, values.shape[1], values.shape[0], 0),
        )
        axes.set_title(label, fontsize=9)
        ends = "max" if low == 0 else "both"
        figure.colorbar(
            shown, ax=axes, location="bottom", shrink=0.9, aspect=30, pad=0.02, extend=ends
        ).ax.tick_params(labelsize=7)
    for axes in grid:
        axes.set_anchor("N")
        axes.set_xlim(box.left, box.right), axes.set_ylim(box.bottom, box.top)
        _frameless(axes)
    figure.suptitle(title, fontsize=10)
    with aside(path) as temporary:
        figure.savefig(temporary, facecolor="white")


_SHEET = {
    "target": "target",
    "render": "render",
    "error": "error",
    "residual": "residual, without lighting",
    "surface": "surface from the side",
}
