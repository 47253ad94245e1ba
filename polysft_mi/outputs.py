"""What a run leaves in its folder: surfaces, unknowns, pictures, figures.

Import only after a Mitsuba variant is set.
"""

import dataclasses
import json
import os
import platform
import shlex
import sys
import time
import xml.etree.ElementTree as ET
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np

from . import __version__, figures, meshio, metrics
from .defaults import located
from .exr import write_exr
from .files import aside
from .patch import Unknowns
from .raster import RasterIntegrator
from .results import PEAK
from .video import write_video

RUN = "run.json"
_DRAWING = 2  # threads that draw and write a frame's pictures


def srgb(linear):
    """Linear values (..., 3) as sRGB in [0, 1]."""
    x = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def versions():
    """What a result depends on besides its scene."""
    return {
        "polysft_mi": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "python": platform.python_version(),
        "variant": mi.variant(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def write_json(path, value):
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump(value, file, indent=1, default=float)
        file.write("\n")


def resolved_scene(experiment):
    """The scene file as text, with the defaults in force in place of its own and relative paths made absolute."""
    tree = ET.parse(experiment.path, parser=ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    for element in tree.getroot().iter():
        if element.tag == "default":
            value = experiment.defaults[element.get("name")]
        elif element.tag == "string" and element.get("name") in ("filename", "frames", "masks", "folder"):
            value = element.get("value")
        else:
            continue
        if value and "$" not in value:
            place = located(experiment.path, value)
            value = place if os.path.exists(place) or "*" in value else value
        element.set("value", value)
    return ET.tostring(tree.getroot(), encoding="unicode") + "\n"


class Pictures:
    """Renderings of the surface of a frame beside its image, as arrays."""

    def __init__(self, problem):
        self.problem = problem
        # geometry comes from the rasteriser whatever renders the colours
        self._raster = RasterIntegrator(mi.Properties("raster"))
        self._raster.aovs, self._raster.antialias = ["depth", "normal", "uv"], False

    def __call__(self, unknowns, frame, geometry=True):
        """Layers (H, W[, C]) float32: ``target``, ``render`` (linear RGB), ``error`` (root mean square over channels), ``mask_target``,
        ``mask_render``; with ``geometry`` also ``depth`` [m], ``normal`` (camera frame, towards the camera), ``uv`` (texture coordinates,
        v up); 0 beyond the surface.
        """
        problem = self.problem
        with dr.suspend_grad():
            vertices = problem.patch.vertices(unknowns)
            rgb, alpha = problem.image(vertices)
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
        geometry = np.array(self._raster.image(self.problem.experiment.scene, self.problem.experiment.sensor, spp=1))[..., -6:]
        normal = geometry[..., 1:4] @ self.problem.camera.axes.T.astype(np.float32)
        uv = np.where(geometry[..., :1] > 0, np.stack([geometry[..., 4], 1 - geometry[..., 5]], -1), 0)
        return {"depth": geometry[..., 0], "normal": normal, "uv": uv}


def _image_figures(layers, masked):
    """PSNR and SSIM of the rendering, in sRGB, inside the surface (the target's mask, else the rendered interior)."""
    inside = layers["mask_target"] > 0.5 if masked else layers["mask_render"] > 0.999
    rows, columns = (np.flatnonzero(inside.any(axis=k)) for k in (1, 0))
    if not len(rows):
        return {"psnr_mask": float("nan"), "ssim_mask": float("nan")}
    near = slice(max(0, rows[0] - 5), rows[-1] + 6), slice(max(0, columns[0] - 5), columns[-1] + 6)  # with the margin of SSIM's window
    a, b, inside = srgb(layers["render"][near]), srgb(layers["target"][near]), inside[near]
    return {"psnr_mask": metrics.psnr(a, b, inside), "ssim_mask": metrics.ssim(a, b, inside)}


def chosen(count, limit):
    """At most ``limit`` of ``count`` frames, spread evenly, first and last among them."""
    if limit >= count:
        return list(range(count))
    return sorted(set(np.linspace(0, count - 1, limit).round().astype(int).tolist())) if limit > 0 else []


def write(problem, track, out, *, exr_frames, fps, command, say=None):
    """Write everything for the frames that ``track`` holds. Returns the summary that ``metrics.json`` begins with.

    ``exr_frames``: how many comparison EXRs at most; ``say(text)``: told what is being written.
    """
    say = say or (lambda text: None)
    sequence, template = problem.sequence, problem.template
    count = len(track.states)
    indices = np.asarray(sequence.indices[:count], dtype=np.int64)
    unknowns = [Unknowns.from_numpy(s) for s in track.states]
    world = np.stack([problem.surface(u) for u in unknowns])
    vertices = problem.camera.to_camera(world).astype(np.float32)

    sigma = {}
    if track.sigma:
        unknown = np.full(vertices.shape[1], np.nan, np.float32)
        sigma["sigma"] = np.stack([track.sigma.get(k, unknown) for k in range(count)])
    with aside(os.path.join(out, "surface.npz")) as temporary:
        np.savez_compressed(
            temporary, vertices=vertices, faces=template.faces.astype(np.int32), uv=template.uv.astype(np.float32), frames=indices, **sigma
        )
    arrays = {name: np.stack([s[name] for s in track.states]) for name in Unknowns.NAMES}
    with aside(os.path.join(out, "params.npz")) as temporary:
        np.savez_compressed(
            temporary, frames=indices, alpha=template.alpha, chart=template.chart, scale=template.scale,
            frame_rotation=problem.camera.axes @ template.rotation, frame_origin=problem.camera.to_camera(template.origin), **arrays,
        )  # fmt: skip
    say("meshes")
    for folder in ("meshes", "comparison"):
        os.makedirs(os.path.join(out, folder), exist_ok=True)
    for index, v in zip(indices, vertices):
        meshio.write_ply(os.path.join(out, "meshes", f"{index:03d}.ply"), v, template.faces, template.uv)

    say("pictures")
    pictures = Pictures(problem)
    masked = sequence.mask(0) is not None
    exr = set(chosen(count, exr_frames))
    sheet, per_frame = set(chosen(count, 5)), []
    rows, view, known = [], figures.View.around(vertices), versions()

    def drawn(k, layers):
        """Figures of a frame, its part of the contact sheet (or None) and its picture in the video."""
        found = {"frame": int(indices[k]), **_image_figures(layers, masked)}
        if k in exr:
            metadata = {"frame": int(indices[k]), "scene": os.path.abspath(problem.experiment.path), **known}
            write_exr(os.path.join(out, "comparison", f"{indices[k]:03d}.exr"), layers, metadata)
        target, render, error = (_panel(layers[n]) for n in ("target", "render", "error"))
        target, render = (np.round(255 * srgb(x)).astype(np.uint8) for x in (target, render))
        surface = figures.shade_surface(vertices[k], template.faces, view, uv=template.uv, size=target.shape[1::-1])
        row = {"target": target, "render": render, "error": error, "surface": surface, "label": f"frame {indices[k]}"} if k in sheet else None
        return found, row, np.concatenate([target, render, _heat(error), surface], axis=1)

    def video_frames():
        waiting = deque()

        def finished():
            found, row, picture = waiting.popleft().result()
            per_frame.append(found)
            rows.extend([row] if row else [])
            return picture

        with ThreadPoolExecutor(_DRAWING) as pool:  # the next frames are rendered meanwhile
            for k, u in enumerate(unknowns):
                waiting.append(pool.submit(drawn, k, pictures(u, k, geometry=k in exr)))
                if len(waiting) > 2 * _DRAWING:
                    yield finished()
            while waiting:
                yield finished()

    video = write_video(os.path.join(out, "comparison.mp4"), video_frames(), fps)
    figures.contact_sheet(os.path.join(out, "comparison.png"), rows)
    with open(os.path.join(out, "log.jsonl"), encoding="utf-8") as file:
        figures.loss_plot(os.path.join(out, "loss.png"), [json.loads(line) for line in file])

    finite = {name: [p[name] for p in per_frame if np.isfinite(p[name])] for name in ("psnr_mask", "ssim_mask")}
    summary = {
        "frames": count,
        "frames_wanted": len(sequence.indices),
        "lost": {str(int(indices[k])): reason for k, reason in track.lost.items() if k < count},
        **{name: float(np.mean(values)) for name, values in finite.items() if values},
        "seconds_per_frame": float(sum(track.seconds) / count),
        "iterations_per_window": float(np.mean(track.iterations)) if track.iterations else 0.0,
        "order": template.order,
        "template_residual_rms_mm": 1e3 * template.residual_rms,
        "template_residual_max_mm": 1e3 * template.residual_max,
        "solver": problem.settings.solver,
    }
    windows = [
        {"frame": int(indices[count - len(track.iterations) + k]), "iterations": n, "seconds": t, **{name: x for name, x in terms.items()}}
        for k, (n, t, terms) in enumerate(zip(track.iterations, track.seconds, track.totals))
    ]
    write_json(
        os.path.join(out, "metrics.json"), {**summary, "versions": versions(), "per_frame": per_frame, "windows": windows, "command": command}
    )
    return {**summary, "video": video}


def _panel(image, width=640):
    """An image shrunk to at most ``width`` pixels across, for the video and the contact sheet."""
    import cv2

    scale = width / image.shape[1]
    return image if scale >= 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _heat(error, peak=PEAK):
    """An error (H, W) in [0, peak] as a picture, black to white through red and yellow."""
    x = np.clip(np.nan_to_num(error) / peak, 0, 1)[..., None]
    return np.round(255 * np.clip(x * 3 - np.array([0, 1, 2]), 0, 1)).astype(np.uint8)


def write_beginning(out, scene, camera, command, fps):
    """What stands in the folder from the first second: the resolved scene (text), the :class:`polysft_mi.pinhole.Pinhole`, and what the
    run is.
    """
    with aside(os.path.join(out, "scene.xml")) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(scene)
    write_json(os.path.join(out, "camera.json"), dataclasses.asdict(camera.intrinsics()))
    about = {"command": command, "started": time.strftime("%Y-%m-%dT%H:%M:%S"), "fps": fps, "versions": versions()}
    write_json(os.path.join(out, RUN), about)


def command_line():
    return f"python -m polysft_mi.run {shlex.join(sys.argv[1:])}"
