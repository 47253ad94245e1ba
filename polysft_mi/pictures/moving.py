"""What the viewer shows: a run, ended or still at work, or drapes, as one moving surface."""

from __future__ import annotations

import glob
import os
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle

import numpy as np

from polyfit.animation import AXES_FROM_CAMERA, from_camera
from polyfit.colours import patch_colours, range_of
from polyfit.mesh import TexCoords
from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.results import Run, load_npz
from polysft_mi.scene import located, open_cameras

from .panels import residual_at_vertices

_GREY = (176, 176, 176)
_CLOTH = (106, 141, 182), (182, 112, 84), (104, 152, 112), (186, 164, 92)  # of the garments


@dataclass(frozen=True)
class Colouring:
    """Colours of the vertices, ``rgb`` (T, N, 3) uint8 sRGB, or (1, N, 3) where no frame changes
    them; ``legend``: what they mean, in a line.
    """

    rgb: np.ndarray
    legend: str


@dataclass(frozen=True)
class Filming:
    """A camera that filmed: its ``name``, ``intrinsics``, its ``pose`` (4, 4) from its own frame
    (OpenCV's axes) to the frame that is shown [m], and the path of each frame's image, or none.
    """

    name: str
    intrinsics: Intrinsics
    pose: np.ndarray
    images: list[str]


@dataclass(frozen=True)
class Moving:
    """A surface that moves: ``vertices`` (T, N, 3) float32 [m, z up], ``faces`` (F, 3),
    ``texcoords`` or None, ``texture``: the path of an image or None; ``frames`` (T,): the number
    of each, ``fps`` of them a second.

    ``cameras``: the scene's own, at the origin and looking along y, and further ones.
    ``colourings``: by name, each a function that makes it. ``body``: (vertices (T, B, 3), faces (C,
    3)) of what the surface lies on, or None. ``state``: how far it is, in a line.
    """

    vertices: np.ndarray
    faces: np.ndarray
    frames: np.ndarray
    fps: float
    state: str
    texcoords: TexCoords | None = None
    texture: str | None = None
    cameras: list[Filming] = field(default_factory=list)
    colourings: dict[str, Callable[[], Colouring]] = field(default_factory=dict)
    body: tuple[np.ndarray, np.ndarray] | None = None


class Source:
    """A folder to look at. :meth:`read` gives what it holds now; :meth:`changed` says whether that
    is more than was read. Raises InputError where it is neither a run's nor a drape's.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = os.fspath(folder)
        self._problem = self._loaded = None  # of a run at work, and when its scene was written
        self._stamp: list[int | None] = []
        if not _drapes(self.folder) and not os.path.isfile(self._path("run.json")):
            what = "is not the folder of a run or of a drape (it holds no run.json, no drape.npz)"
            if not os.path.isdir(self.folder):
                is_file = os.path.exists(self.folder)
                what = f"{'is a file' if is_file else 'no such folder'}; a run's folder is needed"
            raise InputError(f"{folder}: {what}")

    def _path(self, name):
        return os.path.join(self.folder, name)

    def _stamps(self):
        found = []
        own = (self._path(name) for name in ("metrics.json", "checkpoint.npz"))
        for path in (*own, *_drapes(self.folder)):
            try:
                found.append(os.stat(path).st_mtime_ns)
            except OSError:
                found.append(None)
        return found

    def changed(self) -> bool:
        """Whether a file was written since :meth:`read`."""
        return self._stamps() != self._stamp

    def read(self) -> Moving:
        """The surface as it is now. A run that is still at work is loaded as a scene, by Mitsuba,
        for until its end its folder holds nothing but unknowns.
        """
        stamp = self._stamps()
        if drapes := _drapes(self.folder):
            found = _of_drapes(drapes)
        elif os.path.isfile(self._path("metrics.json")):  # which a run writes last
            found, self._problem = _of_run(Run.open(self.folder)), None
        else:
            found = self._at_work()
        self._stamp = stamp
        return found

    def _at_work(self):
        from polyfit.backend import set_variant

        set_variant()
        from polysft_mi.objective import Problem
        from polysft_mi.scene import experiment as scenes
        from polysft_mi.surface import Unknowns
        from polysft_mi.tracker import CHECKPOINT, Track

        written = os.stat(self._path("scene.xml")).st_mtime_ns
        if self._problem is None or self._loaded != written:  # another run took its place
            experiment = scenes.load(self._path("scene.xml"))
            self._problem, self._loaded = Problem(experiment, experiment.sequence()), written
        problem = self._problem
        path, track = self._path(CHECKPOINT), Track()
        if os.path.isfile(path):
            track = Track.load(path)
        states = [Unknowns.from_numpy(s) for s in track.states] or [problem.patch.rest()]
        world = np.stack([problem.surface(state) for state in states])
        files, template = problem.sequence.files, problem.template
        certainties = track.certainties(world.shape[1])
        texture = Run.texture_of(self._path("scene.xml"))
        return Moving(
            from_camera(problem.camera.to_camera(world).astype(np.float32), "z"),
            template.faces,
            np.asarray(problem.sequence.indices[: len(states)]),
            problem.experiment.settings.rate,
            f"at work: {len(track.states)} of {len(files)} frames",
            template.texcoords,
            _existing(texture),
            _cameras(
                self._path("scene.xml"),
                problem.camera.intrinsics(),
                files[: len(states)],
                problem.sequence.cameras,
            ),
            _colourings(template.patch, template.weight, *certainties),
        )


def _of_run(run: Run) -> Moving:
    """A run that has ended."""
    p = run.params
    colourings = _colourings(p["patch"], p["weight"], run.sigma, run.score)
    if run.camera is not None:
        legend = "rendering beside image, freed from lighting [local contrast]"
        make = lambda: _scalar(residual_at_vertices(run), "inferno", legend)
        colourings["residual"] = make
    bent = "mean curvature of the jets [1/m]"
    make = lambda: _scalar(run.mean_curvature(), "RdBu_r", bent, signed=True)
    colourings["curvature"] = make
    lost = run.metrics.get("lost", {})
    return Moving(
        from_camera(run.vertices, "z"),
        run.faces,
        run.frames,
        run.fps,
        f"{len(run.frames)} frames" + (f", {len(lost)} of them lost" if lost else ""),
        run.texcoords,
        _existing(run.texture),
        _cameras(run.path("scene.xml"), run.camera, run.images, _further(run))
        if run.camera is not None
        else [],
        colourings,
    )


def _further(run):
    """The further cameras of a run that has ended; none where their files are gone."""
    s = run.settings
    if not s.get("cameras"):
        return []
    first, last, stride = (int(s[name]) for name in ("first", "last", "stride"))
    try:
        where = os.path.normpath(located(run.path("scene.xml"), s["cameras"]))
        return open_cameras(where, None, first, last, stride, run.cameras)
    except InputError:
        return []


def _cameras(scene, intrinsics, images, further):
    """The scene's own camera, and the ``further`` ones, where the scene says where its own is by a
    <lookat>, as all do that `prepare` writes.
    """
    upright = np.eye(4)
    upright[:3, :3] = AXES_FROM_CAMERA["z"]
    found = [Filming("own", intrinsics, upright, images)]
    look = ET.parse(scene).getroot().find("sensor/transform/lookat")
    if look is None:
        return found
    origin, target, up = (
        np.array([float(x) for x in look.get(name, "").replace(",", " ").split()])
        for name in ("origin", "target", "up")
    )
    forward = (target - origin) / np.linalg.norm(target - origin)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    own = np.eye(4)  # from its frame, x right and y down, to the scene's world
    own[:3] = np.stack([right, np.cross(forward, right), forward, origin], 1)
    for camera in further:
        pose = upright @ np.linalg.inv(camera.world_to_camera @ own)
        found.append(Filming(camera.name, camera.intrinsics, pose, camera.sequence.files))
    return found


def _drapes(folder: str) -> list[str]:
    """The drape.npz of a folder: its own, or those of an outfit's garments, each in a folder of its
    own, in the order in which they are put on.
    """
    own = os.path.join(folder, "drape.npz")
    garments = os.path.join(glob.escape(folder), "[1-9]_*", "drape.npz")
    return [own] if os.path.isfile(own) else sorted(glob.glob(garments))


def _of_drapes(paths: list[str]) -> Moving:
    """What onefit.drape or onefit.simulate left in files: all cloth, and the body under it."""
    meshes, colours, count = [], [], 0
    for path, colour in zip(paths, cycle(_CLOTH)):
        a = load_npz(path)
        missing = [n for n in ("vertices", "faces", "body", "body_faces", "fps") if n not in a]
        if missing:
            raise InputError(
                f"{path}: holds no {', '.join(missing)}; it is not the file of a drape"
            )
        kind = "mesh_" if "mesh_vertices" in a else ""  # that of the garment's file
        meshes.append((a[f"{kind}vertices"], a[f"{kind}faces"] + count))
        if len(meshes[-1][0]) != len(meshes[0][0]):
            raise InputError(
                f"{path}: {len(meshes[-1][0])} frames, where {paths[0]} has {len(meshes[0][0])};"
                " they are not of one outfit"
            )
        count += meshes[-1][0].shape[1]
        colours.append(np.tile(np.array(colour, np.uint8), (meshes[-1][0].shape[1], 1)))
    vertices, faces = (np.concatenate(parts, k) for parts, k in zip(zip(*meshes), (1, 0)))
    rgb = np.concatenate(colours)[None]
    return Moving(
        vertices,
        faces,
        np.arange(len(vertices)),
        float(a["fps"]),
        f"{len(vertices)} frames" + (f", {len(paths)} garments" if paths[1:] else ""),
        colourings={"cloth": lambda: Colouring(rgb, "")},
        body=(a["body"], a["body_faces"]),
    )


def _scalar(values: np.ndarray, colours: str, meaning: str, *, signed: bool = False) -> Colouring:
    """Values (T, N) in the ``colours`` of matplotlib, grey where they are not finite."""
    import matplotlib

    low, high = range_of(values, signed)
    known = np.isfinite(values)
    share = (np.where(known, values, low) - low) / (high - low)
    rgb = matplotlib.colormaps[colours](np.clip(share, 0, 1), bytes=True)[..., :3]
    rgb[~known] = _GREY
    return Colouring(rgb, f"{meaning}: {low:.3g} to {high:.3g}")


def _colourings(patch, weight, sigma=None, score=None):
    """What is known of a run from its first frame on."""
    out = {"plain": partial(_plain, len(patch), _GREY)}
    if patch.max() > 0:
        legend = f"the {patch.max() + 1} patches"
        out["patches"] = lambda: Colouring(patch_colours(patch, weight)[None], legend)
    for name, of, meaning in (
        ("sigma", sigma, "standard deviation along the ray, by the noise [mm]"),
        ("score", score, "how far off it may be along the ray [mm]"),
    ):
        if of is not None and np.isfinite(of).any():
            out[name] = partial(_scalar, 1e3 * of, "viridis", meaning)
    return out


def _plain(count, colour):
    return Colouring(np.tile(np.uint8(colour), (1, count, 1)), "")


def _existing(path):
    return path if path is not None and os.path.isfile(path) else None
