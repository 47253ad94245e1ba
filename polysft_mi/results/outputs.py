"""What a run leaves in its folder: surfaces, unknowns, pictures, figures.

Import only after a Mitsuba variant is set.
"""

import contextlib
import dataclasses
import math
import os
import platform
import time
import xml.etree.ElementTree as ET

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.files import aside, json_text
from polyfit.mesh import write_ply
from polysft_mi import __version__
from polysft_mi.scene import located, written
from polysft_mi.surface import Unknowns

from .folder import OTHER
from .truth import uv_arrays

# below these a frame's surface explains its image hardly better than any would
_LEAST_IOU, _LEAST_SSIM = 0.8, 0.4
_PARAMS = ("alpha", "patch", "weight", "chart", "rest", "scale", "radius")


def versions():
    """What a result depends on besides its scene."""
    return {
        "polysft_mi": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, dr.detail.llvm_version())),
        "python": platform.python_version(),
        "variant": mi.variant(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def write_json(path, value):
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(json_text(value, indent=1) + "\n")


def resolved_scene(experiment):
    """The scene file as text, with the defaults in force in place of its own and relative paths
    made absolute.
    """
    tree = ET.parse(
        experiment.path, parser=ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    )
    for element in tree.getroot().iter():
        if element.tag == "default":
            value = experiment.defaults[element.get("name")]
        elif element.tag == "string" and element.get("name") in (
            "filename",
            "frames",
            "masks",
            "folder",
        ):
            value = element.get("value")
        else:
            continue
        if value and "$" not in value:
            place = located(experiment.path, value)
            value = place if os.path.exists(place) or "*" in value else value
        element.set("value", value)
    return ET.tostring(tree.getroot(), encoding="unicode") + "\n"


def _vertices(problem, track):
    """Of all frames (T, N, 3) [m]: in the world, and float32 in the camera frame."""
    world = np.stack([problem.surface(Unknowns.from_numpy(s)) for s in track.states])
    return world, problem.camera.to_camera(world).astype(np.float32)


def write(problem, track, out, drawing, *, fps, command, say=None, fits=None):
    """Write everything for the frames that ``track`` holds. Returns the summary that
    ``metrics.json`` begins with, and a function to call in the end: it waits for the plots.

    ``drawing``: the :class:`polysft_mi.pictures.drawing.Drawing` of the run; ``fps``: of the video;
    ``say(text)``: told what is being written; ``fits(surfaces)``: how evidence fits them, as
    :meth:`polysft_mi.objective.Objective.fits` says it.
    """
    say = say or (lambda text: None)
    sequence, template = problem.sequence, problem.template
    count = len(track.states)
    indices = np.asarray(sequence.indices[:count], dtype=np.int64)
    world, vertices = _vertices(problem, track)
    drawn, bound, plotted = drawing.finish(world, vertices, fps)

    mesh = {
        "faces": template.faces.astype(np.int32),
        **uv_arrays(template.texcoords, template.faces),
        "frames": indices,
    }
    certainty = dict(zip(("sigma", "score"), track.certainties(vertices.shape[1])))
    with aside(os.path.join(out, "surface.npz")) as temporary:
        np.savez_compressed(temporary, vertices=vertices, **mesh, **certainty)
    undecided = {}
    if track.other and len(track.other.states) == count:
        others = _vertices(problem, track.other)[1]
        with aside(os.path.join(out, OTHER)) as temporary:
            np.savez_compressed(temporary, vertices=others, **mesh)
        apart = np.linalg.norm(others - vertices, axis=-1).max()
        undecided = {"from": int(indices[track.fork]), "apart_mm": 1e3 * float(apart)}
    else:  # what a run that was interrupted here did not know yet
        with contextlib.suppress(FileNotFoundError):
            os.remove(os.path.join(out, OTHER))
    names = [name for name in Unknowns.NAMES if name != "pose"]  # that is in body.npz
    arrays = {name: np.stack([s[name] for s in track.states]) for name in names}
    with aside(os.path.join(out, "params.npz")) as temporary:
        np.savez_compressed(
            temporary,
            frames=indices,
            **{name: getattr(template, name) for name in _PARAMS},
            frame_rotation=problem.camera.axes @ template.rotation,
            frame_origin=problem.camera.to_camera(template.origin),
            axes=problem.camera.axes @ template.axes,
            **arrays,
        )
    carrier = problem.atlas.carrier
    if carrier is not None:
        poses = [carrier.pose(state["pose"]) for state in track.states]
        with aside(os.path.join(out, "body.npz")) as temporary:
            np.savez_compressed(temporary, **carrier.motion(poses))
    say("meshes")
    os.makedirs(os.path.join(out, "meshes"), exist_ok=True)
    source, uv, faces = template.texcoords.split(template.faces)
    for index, v in zip(indices, vertices):
        write_ply(os.path.join(out, "meshes", f"{index:03d}.ply"), v[source], faces, uv)
    say("pictures")
    (per_frame, box, others), video = drawn(), bound()

    summary = {
        "frames": count,
        "frames_wanted": len(sequence.indices),
        "lost": {str(int(indices[k])): reason for k, reason in track.lost.items() if k < count},
        "doubtful": _doubtful(indices, per_frame),
        **({"undecided": undecided} if undecided else {}),
        **({"second_pass": track.second} if track.second else {}),
        **(fits(world) if fits else {}),
        **_means(per_frame),
        "seconds_per_frame": float(sum(track.seconds) / count),
        "iterations_per_window": float(np.mean(track.iterations)) if track.iterations else 0.0,
        "order": template.order,
        "template_residual_rms_mm": 1e3 * template.residual_rms,
        "template_residual_max_mm": 1e3 * template.residual_max,
        "solver": track.solver,
    }
    cameras = {name: {**_means(of), "per_frame": of} for name, of in others.items()}
    windows = [
        {"frame": int(indices[count - len(track.iterations) + k]), "iterations": n, "seconds": t}
        | terms
        | ({"misfit": memory.misfit, "outlier_share": memory.outlier_share} if memory else {})
        for k, (n, t, terms, memory) in enumerate(
            zip(track.iterations, track.seconds, track.totals, track.memories)
        )
    ]
    write_json(
        os.path.join(out, "metrics.json"),
        {
            **summary,
            "versions": versions(),
            "pictures": {"box": list(box)},
            "per_frame": per_frame,
            **({"cameras": cameras} if cameras else {}),
            "windows": windows,
            "command": command,
        },
    )
    return {**summary, "video": video}, plotted


def _doubtful(indices, per_frame):
    """Of each frame that its surface does not explain, why: its number, as text, to a reason."""
    found = {}
    for index, figures in zip(indices, per_frame):
        iou, ssim = (figures.get(name, math.nan) for name in ("iou", "ssim_mask"))
        reasons = []
        if iou < _LEAST_IOU:
            reasons.append(f"its silhouette does not meet the mask (IoU {iou:.2f})")
        if ssim < _LEAST_SSIM:
            reasons.append(f"it does not look like the image (SSIM {ssim:.2f})")
        if reasons:
            found[str(int(index))] = " and ".join(reasons)
    return found


def _means(per_frame):
    """The means of the figures of frames, where they are known."""
    names = ("psnr_mask", "ssim_mask", "iou")
    finite = {n: [p[n] for p in per_frame if n in p and np.isfinite(p[n])] for n in names}
    return {name: float(np.mean(values)) for name, values in finite.items() if values}


def write_beginning(out, scene, camera, others, command, fps, inputs):
    """What stands in the folder from the first second: the resolved scene (text), the
    :class:`polysft_mi.render.pinhole.Pinhole`, the ``others``
    (:class:`polysft_mi.scene.cameras.OtherCamera`), and what the run is; ``inputs``: what
    :func:`polysft_mi.results.folder.digest` says of its files.
    """
    with (
        aside(os.path.join(out, "scene.xml")) as temporary,
        open(temporary, "w", encoding="utf-8") as file,
    ):
        file.write(scene)
    write_json(os.path.join(out, "camera.json"), dataclasses.asdict(camera.intrinsics()))
    if others:
        cameras = {c.name: written(c.intrinsics, c.world_to_camera) for c in others}
        write_json(os.path.join(out, "cameras.json"), cameras)
    about = {
        "command": command,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S"),
        "fps": fps,
        "versions": versions(),
        "inputs": inputs,
    }
    write_json(os.path.join(out, "run.json"), about)
