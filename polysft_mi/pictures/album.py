"""The pictures of a run: each frame's rendering beside its image, as layers, EXRs, a video and a
sheet; and the curves of its losses.

Import only after a Mitsuba variant is set. :mod:`polysft_mi.pictures.drawing` has this done by a
process of its own.
"""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.colours import srgb
from polyfit.device import on_device
from polyfit.pictures import SideView, Triangles, write_video
from polysft_mi.images import compared
from polysft_mi.render import RasterIntegrator
from polysft_mi.results import metrics

from . import figures
from .exr import write_exr
from .panels import COLUMNS, PEAKS, Box, evenly_spaced, heat, heat_values


@dataclass(frozen=True)
class AlbumSettings:
    """How a run is drawn.

    ``width``: pixels across of a picture in the video, at most. ``rows``: of the contact sheet, at
    most. ``margin``: around the sheet in the pictures, over the longer side of its box.
    ``room``: likewise, what is kept until it is known where the sheet goes. ``view``: how much
    more the view from the side shows than the first surface. ``threads``: that draw and write;
    ``waiting``: renderings that may wait for them.
    """

    width: int = 512
    rows: int = 5
    margin: float = 0.1
    room: float = 0.2
    view: float = 1.25
    threads: int = 2
    waiting: int = 4


class Renderings:
    """Renderings of the surface of a frame beside its image, as arrays; by the scene's own camera,
    or by another one (:class:`polysft_mi.scene.cameras.OtherCamera`), which tells no geometry.
    """

    def __init__(self, problem, other=None):
        self.problem = problem
        self.placed = problem.placed.seen_by(other.sensor()) if other else problem.placed
        self.sequence = other.sequence if other else problem.sequence
        # geometry comes from the rasteriser whatever renders the colours
        self._raster = RasterIntegrator(mi.Properties("raster"))
        self._raster.aovs = ["depth", "normal", "uv", "triangle"]
        self._raster.antialias = False
        self._first, self._patches = _own_patches(problem.experiment)

    def __call__(self, vertices, frame, geometry=True):
        """Layers (H, W[, C]) float32 of the surface with ``vertices`` (N, 3) [m, world]:
        ``target``, ``render`` (linear RGB), ``error`` (root mean square over channels),
        ``mask_target``, ``mask_render``; with ``geometry`` also ``depth`` [m], ``normal`` (camera
        frame, towards the camera), ``uv`` (texture coordinates, v up), and ``patch`` (its number,
        from 1); 0 beyond the surface.
        """
        problem = self.problem
        with dr.suspend_grad():
            rgb, alpha = self.placed.image(
                on_device(vertices, mi.Point3f),
                spp=problem.settings.spp,
            )
            render = np.array(rgb)
            more = self._geometry() if geometry else {}
        mask_render = np.array(alpha)[..., 0]
        image, mask = self.sequence.frame(frame), self.sequence.mask(frame)
        target = image * mask[..., None] if mask is not None else image
        inside = np.ones_like(mask_render) if mask is not None else mask_render > 0.999
        difference = render - target
        error = np.sqrt(np.einsum("hwc,hwc->hw", difference, difference) / 3) * inside
        return {
            "target": image,
            "render": render,
            "error": error,
            "mask_target": mask if mask is not None else np.ones_like(mask_render),
            "mask_render": mask_render,
            **more,
        }

    def _geometry(self):
        """The layers ``depth``, ``normal``, ``uv`` and ``patch`` of the surface that was rendered
        last.
        """
        geometry = np.array(
            self._raster.image(self.problem.experiment.scene, self.problem.experiment.sensor, spp=1)
        )[..., -7:]
        normal = geometry[..., 1:4] @ self.problem.camera.axes.T.astype(np.float32)
        uv = np.where(
            geometry[..., :1] > 0, np.stack([geometry[..., 4], 1 - geometry[..., 5]], -1), 0
        )
        face = np.round(geometry[..., 6]).astype(np.int64) - self._first
        on = (face >= 0) & (face < len(self._patches))
        patch = np.where(on, 1 + self._patches[np.where(on, face, 0)], 0).astype(np.float32)
        return {"depth": geometry[..., 0], "normal": normal, "uv": uv, "patch": patch}


def _own_patches(experiment):
    """Which of the scene's triangles are the template's: the first, and the patch of each (F,), of
    two of its corners at least or of the middle one.
    """
    mesh, template = experiment.mesh, experiment.template
    first = 0
    for shape in experiment.scene.shapes():
        if shape.id() == mesh.id():
            break
        first += shape.face_count() if shape.is_mesh() else 0
    faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    return first, np.sort(template.patch[experiment.corner[faces], 0], axis=1)[:, 1]


def residual(layers, masked, *, blur=1.0, window=8.0, side=225.0):
    """The misfit (H, W) of a rendering without what lighting does: the root mean square over the
    channels of rendering minus image, both freed from lighting by local normalisation as in the
    objective, in local standard deviations. 0 beyond the sheet.

    ``layers``: as :class:`Renderings` makes them; ``masked``: whether the frames have masks.
    ``blur``, ``window``: standard deviations [pixels] of the blur before, and of the window of the
    local statistics, on a sheet that is ``side`` pixels wide; on a larger one they grow with it.
    """
    inside = np.where(layers["mask_render"] > 0.999, np.float32(1), np.float32(0))
    weights = (layers["mask_target"], layers["mask_render"]) if masked else (inside, inside)
    out = np.zeros_like(inside)
    area = float(weights[1].sum())
    if area == 0:
        return out
    unit = max(1.0, area**0.5 / side)
    rows, columns = (np.flatnonzero((weights[0] + weights[1]).any(axis=k)) for k in (1, 0))
    room = int(4 * window * unit)
    near = (
        slice(max(0, rows[0] - room), rows[-1] + room + 1),
        slice(max(0, columns[0] - room), columns[-1] + room + 1),
    )
    target, render = (
        compared(layers[name][near], w[near], blur * unit, window * unit, True) * w[near][..., None]
        for name, w in zip(("target", "render"), weights, strict=True)
    )
    out[near] = np.sqrt(((render - target) ** 2).mean(axis=-1))
    return out


class _Strip:
    """What one camera shows of each frame, in any order: its image, the rendering, and how they
    differ. ``place(frame)``: the path of a frame's pictures until the end; ``box``: the
    :class:`~polysft_mi.pictures.panels.Box` that they are cropped to, known once :meth:`finish` is
    called.
    """

    def __init__(self, renderings, settings, place):
        self._renderings, self._settings, self._place = renderings, settings, place
        self._camera, self.size = renderings.placed.camera, renderings.placed.size
        self._masked = renderings.sequence.mask(0) is not None
        self.boxes = {}  # frame: where its surface is
        self._window = None  # what pictures show until they are cropped
        self._windows = {}  # the same of each frame
        self.scale = None  # of the pictures
        self.box = None

    def layers(self, vertices, frame, geometry=False):
        """The arrays that a frame is drawn of; :meth:`draw` takes them, in any thread."""
        layers = self._renderings(vertices, frame, geometry)
        self._place_of(frame, vertices)
        return layers

    def _place_of(self, frame, vertices):
        """Set what the pictures of a frame show. Where the sheet will go is not known yet: room
        around it is kept, and more from the frame on in which it leaves that.
        """
        settings = self._settings
        position, before = self._camera.project(vertices)
        visible = position[before] if before.any() else np.zeros((1, 2))
        box = Box.around(visible, settings.margin, self.size)
        roomy = Box.around(visible, settings.margin + settings.room, self.size)
        if self._window is None or not self._window.holds(box):
            self._window = roomy if self._window is None else self._window.union(roomy)
        self.boxes[frame], self._windows[frame] = box, self._window
        if self.scale is None:
            self.scale = min(1.0, settings.width / box.size[0])

    def draw(self, frame, layers):
        """Draw a frame of its ``layers``, which have a residual then; returns its figures."""
        layers["residual"] = residual(layers, self._masked)
        window = self._windows[frame]
        parts = {n: _resized(layers[n][window.slices], self.scale) for n in COLUMNS[:-1]}
        for name in ("target", "render"):
            parts[name] = np.round(255 * srgb(parts[name])).astype(np.uint8)
        for name, peak in PEAKS.items():
            parts[name] = heat(parts[name], peak)
        _write(self._place(frame), np.concatenate([parts[n] for n in COLUMNS[:-1]], axis=1))
        index = self._renderings.sequence.indices[frame]
        return {"frame": int(index), **_figures(layers, self._masked)}

    def finish(self, count):
        """Once ``count`` frames are drawn: crop all to what holds the surface in each."""
        self.box = self.boxes[0]
        for k in range(1, count):
            self.box = self.box.union(self.boxes[k])

    def panels(self, frame):
        """The pictures of a frame by their column, each (h, w, 3) uint8, cropped to ``box``."""
        parts = np.split(cv2.imread(self._place(frame)), len(COLUMNS) - 1, axis=1)
        return dict(zip(COLUMNS[:-1], (self._cropped(p, self._windows[frame]) for p in parts)))

    def _cropped(self, picture, window):
        """What a picture of ``window`` shows of ``box``, black where it shows nothing of it, at
        most ``width`` pixels wide.
        """
        left, top = (round((b - w) * self.scale) for b, w in zip(self.box, window[:2]))
        width, height = (max(1, round(x * self.scale)) for x in self.box.size)
        out = np.zeros((height, width, 3), np.uint8)
        part = picture[max(0, top) : top + height, max(0, left) : left + width]
        y, x = max(0, -top), max(0, -left)
        out[y : y + part.shape[0], x : x + part.shape[1]] = part
        return _resized(out, min(1.0, self._settings.width / width))

    def caption(self):
        """What the pictures show, in words."""
        b, size = self.box, self.size
        part = f"x {b.left} to {b.right}, y {b.top} to {b.bottom}" if b.size != size else "all"
        return (
            f"shown: {part} of {size[0]}x{size[1]} pixels; error: render minus target in linear"
            " colour, lighting included; residual: the same freed from lighting, over the local"
            " contrast"
        )


class Album:
    """The pictures of a run in the making: frames are drawn one by one, in any order and as often
    as need be, and bound into a video at the end.

    ``out``: folder of the run; ``about``: what the EXRs' headers say of it; ``folder``: where the
    frames' pictures lie until the end; ``settings``: :class:`AlbumSettings`. Once :meth:`finish`
    has chosen them, ``rows`` are those of the contact sheet
    (:func:`polysft_mi.pictures.figures.contact_sheet`).
    """

    def __init__(self, problem, out, about, folder, settings=None):
        self.problem, self.out, self.about, self.folder = problem, out, about, folder
        self.settings = settings or AlbumSettings()
        strip = lambda name, camera=None: _Strip(
            Renderings(problem, camera), self.settings, lambda k: self._place(k, name)
        )
        self._own, self._texcoords, self._view = strip("images"), None, None
        # others are drawn by raster alone: their sensors are not Mitsuba's perspective
        others = problem.sequence.cameras if problem.placed.is_raster else ()
        self._others = {c.name: strip(f"of-{c.name}", c) for c in others}
        self._sheet = None  # the surface, as it is seen from the side
        self._pool = ThreadPoolExecutor(self.settings.threads)
        self._drawn = {}  # frame: future of its figures, by camera, None for the own
        self._plots = None  # future of the sheet and the curves
        self.rows = []

    def draw(self, frame, vertices, texcoords=None, exr=False):
        """Draw a frame whose surface has ``vertices`` (N, 3) [m, world], and ``texcoords`` (2V,)
        other than the template's own, if any.
        """
        if texcoords is not None and not np.array_equal(texcoords, self._texcoords):
            self._texcoords = texcoords
            self.problem.placed.set_texcoords(mi.Float(texcoords))
        surface = self.problem.camera.to_camera(vertices)
        if self._view is None:
            self._view = SideView.around(surface).wider(self.settings.view)
        waiting = [f for f in self._drawn.values() if not f.done()]
        if len(waiting) >= self.settings.waiting:
            waiting[0].result()
        if frame in self._drawn:
            self._drawn[frame].result()
        layers = {None: self._own.layers(vertices, frame, geometry=exr)}
        layers |= {name: strip.layers(vertices, frame) for name, strip in self._others.items()}
        _write(self._place(frame, "surface"), self._shaded(surface))
        self._drawn[frame] = self._pool.submit(self._draw, frame, layers, exr)

    def _draw(self, frame, layers, exr):
        found = {n: self._others[n].draw(frame, layers[n]) for n in self._others}
        found[None] = self._own.draw(frame, layers[None])
        for name in layers if exr else ():
            folder = os.path.join(self.out, "comparison", name or "")
            os.makedirs(folder, exist_ok=True)
            index = found[None]["frame"]
            about = {"frame": index, **({"camera": name} if name else {}), **self.about}
            write_exr(os.path.join(folder, f"{index:03d}.exr"), layers[name], about)
        return found

    def _shaded(self, surface):
        """The surface from the side, a square picture as large as the shorter side of the first
        frame's others.
        """
        template, first = self.problem.template, next(iter(self._own.boxes.values()))
        side = max(16, round(min(first.size) * self._own.scale))
        if self._sheet is None:
            self._sheet = Triangles(surface, template.faces)
        self._sheet.move(surface)
        return self._sheet.shaded(self._view, template.texcoords.corners, (side, side))

    def _place(self, frame, name):
        return os.path.join(self.folder, f"{frame}-{name}.png")

    def _panels(self, frame):
        """The pictures of a frame by their column, each (h, w, 3) uint8."""
        panels = self._own.panels(frame)
        height, width = panels["target"].shape[:2]
        square = cv2.imread(self._place(frame, "surface"))
        side = min(height, width)
        square = cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA)
        across, down = width - side, height - side
        surface = cv2.copyMakeBorder(
            square, down // 2, down - down // 2, across // 2, across - across // 2,
            cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return {**panels, COLUMNS[-1]: surface}

    def finish(self, surfaces):
        """Once all frames are drawn and the log is whole: the figures of each; the
        :class:`~polysft_mi.pictures.panels.Box` of the video that the pictures show; and the
        figures of each frame by further camera. Plots are begun, beside whatever comes next.

        ``surfaces`` (T, N, 3) [m, camera frame]. Where some leave the view of the first one, all
        are shaded again in one that holds them.
        """
        count = len(surfaces)
        found = [self._drawn[k].result() for k in range(count)]
        for strip in (self._own, *self._others.values()):
            strip.finish(count)
        if not self._view.holds(surfaces):
            self._view = SideView.around(surfaces)
            for k in range(count):
                _write(self._place(k, "surface"), self._shaded(surfaces[k]))
        shown = evenly_spaced(count, self.settings.rows)
        labels = [f"frame {found[k][None]['frame']}" for k in shown]
        self.rows = _rows([self._panels(k) for k in shown], labels)
        others = {
            name: _rows([strip.panels(k) for k in shown], labels)
            for name, strip in self._others.items()
        }
        self._plots = self._pool.submit(self._plot, others)
        of = lambda name: [figures[name] for figures in found]
        return of(None), self._own.box, {name: of(name) for name in self._others}

    def bind(self, count, fps):
        """Write comparison.mp4 of the first ``count`` frames, ``fps`` a second; returns its path,
        or its folder where no encoder is.
        """

        def whole(k):
            return np.concatenate(list(self._panels(k).values()), axis=1)

        pictures = self._pool.map(whole, range(count))
        return write_video(os.path.join(self.out, "comparison.mp4"), pictures, fps)

    def plot(self):
        """Once comparison.png, the contact sheet, with one for each further camera, and loss.png,
        of the run's log, are written.
        """
        self._plots.result()

    def close(self):
        """Once nothing is drawn or written any more; what has not been begun is left."""
        self._pool.shutdown(cancel_futures=True)

    def _plot(self, others):
        path = os.path.join(self.out, "comparison.png")
        figures.contact_sheet(path, self.rows, self._own.caption())
        for name, rows in others.items():
            path = os.path.join(self.out, f"comparison_{name}.png")
            figures.contact_sheet(path, rows, self._others[name].caption())
        with open(os.path.join(self.out, "log.jsonl"), encoding="utf-8") as file:
            figures.loss_plot(
                os.path.join(self.out, "loss.png"), [json.loads(line) for line in file]
            )


def _rows(panels, labels):
    """Rows of a contact sheet, of the pictures of frames by column."""
    values = lambda row: {name: heat_values(row[name], peak) for name, peak in PEAKS.items()}
    return [{**row, **values(row), "label": label} for row, label in zip(panels, labels)]


def _write(path, picture):
    # what lies aside until the end is compressed as fast as can be
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    options += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # of newer OpenCVs: half the time, and as small
        options += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    cv2.imwrite(path, picture, options)


def _figures(layers, masked):
    """PSNR and SSIM of the rendering, in sRGB, inside the surface (the target's mask, else the
    rendered interior); with a mask also ``iou``, intersection over union of both silhouettes.
    """
    share = {}
    if masked:
        a, b = layers["mask_target"] > 0.5, layers["mask_render"] > 0.5
        share["iou"] = float((a & b).sum() / max(1, (a | b).sum()))
    inside = layers["mask_target"] > 0.5 if masked else layers["mask_render"] > 0.999
    rows, columns = (np.flatnonzero(inside.any(axis=k)) for k in (1, 0))
    if not len(rows):
        return {"psnr_mask": float("nan"), "ssim_mask": float("nan"), **share}
    near = (
        slice(max(0, rows[0] - 5), rows[-1] + 6),
        slice(max(0, columns[0] - 5), columns[-1] + 6),
    )  # with the margin of SSIM's window
    a, b, inside = srgb(layers["render"][near]), srgb(layers["target"][near]), inside[near]
    found = {"psnr_mask": metrics.psnr(a, b, inside), "ssim_mask": metrics.ssim(a, b, inside)}
    return found | share


def _resized(image, scale):
    """An image, shrunk where ``scale`` is below 1."""
    if scale >= 1:
        return image
    size = [max(1, round(x * scale)) for x in image.shape[1::-1]]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
