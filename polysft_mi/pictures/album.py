"""The pictures of a run: each frame's rendering beside its image, as layers, EXRs, a video and a
sheet; and the curves of its losses.

Import only after a Mitsuba variant is set. :mod:`polysft_mi.pictures.drawing` has this done by a process of
its own.
"""

import json
import os
from concurrent.futures import ThreadPoolExecutor

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.render.raster import RasterIntegrator
from polysft_mi.results import metrics

from . import figures
from .exr import write_exr
from .panels import PEAK, spread
from .video import write_video

_WIDTH = 640  # pixels across of a picture in the video, at most
_ROWS = 5  # of the contact sheet
_MARGIN = 1.25  # of the view of the surface, for what may move
_THREADS = 2  # that draw and write what has been rendered
_WAITING = 4  # renderings that may wait for them
_PNG = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
]  # of what lies aside until the end
if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # of newer OpenCVs: half the time, and as small
    _PNG += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]


def srgb(linear):
    """Linear values (..., 3) as sRGB in [0, 1]."""
    x = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


class Renderings:
    """Renderings of the surface of a frame beside its image, as arrays."""

    def __init__(self, problem):
        self.problem = problem
        # geometry comes from the rasteriser whatever renders the colours
        self._raster = RasterIntegrator(mi.Properties("raster"))
        self._raster.aovs, self._raster.antialias = ["depth", "normal", "uv"], False

    def __call__(self, vertices, frame, geometry=True):
        """Layers (H, W[, C]) float32 of the surface with ``vertices`` (N, 3) [m, world]:
        ``target``, ``render`` (linear RGB), ``error`` (root mean square over channels),
        ``mask_target``, ``mask_render``; with ``geometry`` also ``depth`` [m], ``normal`` (camera
        frame, towards the camera), ``uv`` (texture coordinates, v up); 0 beyond the surface.
        """
        problem = self.problem
        with dr.suspend_grad():
            rgb, alpha = problem.image(
                mi.Point3f(np.ascontiguousarray(vertices.T, dtype=np.float32))
            )
            render = np.array(rgb)
            more = self._geometry() if geometry else {}
        mask_render = np.array(alpha).reshape(render.shape[:2])
        image, mask = problem.sequence.frame(frame), problem.sequence.mask(frame)
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
        """The layers ``depth``, ``normal`` and ``uv`` of the surface that was rendered last."""
        geometry = np.array(
            self._raster.image(self.problem.experiment.scene, self.problem.experiment.sensor, spp=1)
        )[..., -6:]
        normal = geometry[..., 1:4] @ self.problem.camera.axes.T.astype(np.float32)
        uv = np.where(
            geometry[..., :1] > 0, np.stack([geometry[..., 4], 1 - geometry[..., 5]], -1), 0
        )
        return {"depth": geometry[..., 0], "normal": normal, "uv": uv}


class Album:
    """The pictures of a run in the making: frames are drawn one by one, in any order and as often
    as need be, and bound into a video at the end.

    ``out``: folder of the run; ``about``: what the EXRs' headers say of it; ``folder``: where the
    frames' pictures lie until the end. ``rows``: of the contact sheet
    (:func:`polysft_mi.pictures.figures.contact_sheet`), once :meth:`finish` has chosen them.
    """

    def __init__(self, problem, out, about, folder):
        self.problem, self.out, self.about, self.folder = problem, out, about, folder
        self._renderings, self._texcoords, self._view = Renderings(problem), None, None
        self._masked = problem.sequence.mask(0) is not None
        self._pool = ThreadPoolExecutor(_THREADS)
        self._drawn = {}  # frame: future of its figures
        self._plots = None  # future of the sheet and the curves
        self.rows = []

    def draw(self, frame, vertices, texcoords=None, exr=False):
        """Draw a frame whose surface has ``vertices`` (N, 3) [m, world], and ``texcoords`` (2V,)
        other than the template's own, if any.
        """
        if texcoords is not None and not np.array_equal(texcoords, self._texcoords):
            self._texcoords = texcoords
            self.problem.set_texcoords(mi.Float(texcoords))
        surface = self.problem.camera.to_camera(vertices)
        if self._view is None:
            self._view = figures.View.around(surface).wider(_MARGIN)
        layers = self._renderings(vertices, frame, geometry=exr)
        waiting = [f for f in self._drawn.values() if not f.done()]
        if len(waiting) >= _WAITING:
            waiting[0].result()
        if frame in self._drawn:
            self._drawn[frame].result()
        self._drawn[frame] = self._pool.submit(self._draw, frame, surface, layers, exr)

    def _draw(self, frame, surface, layers, exr):
        index = self.problem.sequence.indices[frame]
        if exr:
            os.makedirs(os.path.join(self.out, "comparison"), exist_ok=True)
            write_exr(
                os.path.join(self.out, "comparison", f"{index:03d}.exr"),
                layers,
                {"frame": int(index), **self.about},
            )
        target, render, error = (_panel(layers[n]) for n in ("target", "render", "error"))
        target, render = (np.round(255 * srgb(x)).astype(np.uint8) for x in (target, render))
        self._write(frame, "images", np.concatenate([target, render, _heat(error)], axis=1))
        self._write(frame, "surface", self._shaded(surface, target.shape))
        return {"frame": int(index), **_figures(layers, self._masked)}

    def _shaded(self, surface, shape):
        template = self.problem.template
        return figures.shade_surface(
            surface, template.faces, self._view, uv=template.uv, size=(shape[1], shape[0])
        )

    def _place(self, frame, name):
        return os.path.join(self.folder, f"{frame}-{name}.png")

    def _write(self, frame, name, picture):
        cv2.imwrite(self._place(frame, name), picture, _PNG)

    def _panels(self, frame):
        """Target, rendering, error and surface of a frame, each (h, w, 3) uint8."""
        images = cv2.imread(self._place(frame, "images"))
        return [*np.split(images, 3, axis=1), cv2.imread(self._place(frame, "surface"))]

    def finish(self, surfaces):
        """Once all frames are drawn and the log is whole: the figures of each. Plots are begun,
        beside whatever comes next.

        ``surfaces`` (T, N, 3) [m, camera frame]. Where some leave the view of the first one, all
        are shaded again in one that holds them.
        """
        found = [self._drawn[k].result() for k in range(len(surfaces))]
        if not self._view.holds(surfaces):
            self._view = figures.View.around(surfaces)
            shape = self._panels(0)[0].shape
            list(
                self._pool.map(
                    lambda k: self._write(k, "surface", self._shaded(surfaces[k], shape)),
                    range(len(surfaces)),
                )
            )
        self.rows = []
        for k in spread(len(surfaces), _ROWS):
            target, render, heat, surface = self._panels(k)
            error = heat.sum(axis=2, dtype=np.float32) * (PEAK / 765)
            self.rows.append(
                {
                    "target": target,
                    "render": render,
                    "error": error,
                    "surface": surface,
                    "label": f"frame {found[k]['frame']}",
                }
            )
        self._plots = self._pool.submit(self._plot)
        return found

    def bind(self, count, fps):
        """Write comparison.mp4 of the first ``count`` frames, ``fps`` a second; returns its path,
        or its folder where no encoder is.
        """
        pictures = self._pool.map(lambda k: np.concatenate(self._panels(k), axis=1), range(count))
        return write_video(os.path.join(self.out, "comparison.mp4"), pictures, fps)

    def plot(self):
        """Once comparison.png, the contact sheet, and loss.png, of the run's log, are written."""
        self._plots.result()

    def close(self):
        """Once nothing is drawn or written any more; what has not been begun is left."""
        self._pool.shutdown(cancel_futures=True)

    def _plot(self):
        figures.contact_sheet(os.path.join(self.out, "comparison.png"), self.rows)
        with open(os.path.join(self.out, "log.jsonl"), encoding="utf-8") as file:
            figures.loss_plot(
                os.path.join(self.out, "loss.png"), [json.loads(line) for line in file]
            )


def _figures(layers, masked):
    """PSNR and SSIM of the rendering, in sRGB, inside the surface (the target's mask, else the
    rendered interior).
    """
    inside = layers["mask_target"] > 0.5 if masked else layers["mask_render"] > 0.999
    rows, columns = (np.flatnonzero(inside.any(axis=k)) for k in (1, 0))
    if not len(rows):
        return {"psnr_mask": float("nan"), "ssim_mask": float("nan")}
    near = (
        slice(max(0, rows[0] - 5), rows[-1] + 6),
        slice(max(0, columns[0] - 5), columns[-1] + 6),
    )  # with the margin of SSIM's window
    a, b, inside = srgb(layers["render"][near]), srgb(layers["target"][near]), inside[near]
    return {"psnr_mask": metrics.psnr(a, b, inside), "ssim_mask": metrics.ssim(a, b, inside)}


def _panel(image):
    """An image shrunk to at most _WIDTH pixels across, for the video and the contact sheet."""
    scale = _WIDTH / image.shape[1]
    return (
        image
        if scale >= 1
        else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    )


def _heat(error, peak=PEAK):
    """An error (H, W) in [0, peak] as a picture, black to white through red and yellow."""
    x = np.clip(np.nan_to_num(error) / peak, 0, 1)[..., None]
    return np.round(255 * np.clip(x * 3 - np.array([0, 1, 2]), 0, 1)).astype(np.uint8)
