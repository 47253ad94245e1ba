"""What a run left in its folder, read back without Mitsuba."""

from __future__ import annotations

import json
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from polyfit import jets
from polyfit.mesh import TexCoords
from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.scene import known_defaults, list_images, located, read_cameras

from .folder import OTHER
from .truth import load_npz, read_surface, texcoords_of


@dataclass(frozen=True)
class Run:
    """A finished run: ``folder``; ``vertices`` (T, N, 3) float32 [m, camera frame], ``faces`` (F,
    3), ``texcoords``: its :class:`polyfit.mesh.TexCoords`, ``frames`` (T,) the index of each,
    ``sigma`` and ``score`` (T, N) [m] or None; ``metrics`` and ``about``: its metrics.json and
    run.json.
    """

    folder: str
    vertices: np.ndarray
    faces: np.ndarray
    texcoords: TexCoords
    frames: np.ndarray
    sigma: np.ndarray | None = None
    score: np.ndarray | None = None
    metrics: dict = field(default_factory=dict)
    about: dict = field(default_factory=dict)

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Run:
        """Read a run's folder. Raises InputError where it is not one, or where the run has not
        ended.
        """
        folder = os.fspath(folder)
        if not os.path.isdir(folder):
            raise InputError(
                f"{folder}: {'is a file' if os.path.exists(folder) else 'no such folder'}; the"
                " folder of a run is needed"
            )
        if not os.path.isfile(os.path.join(folder, "run.json")):
            raise InputError(f"{folder}: is not the folder of a run (it holds no run.json)")
        if not os.path.isfile(os.path.join(folder, "metrics.json")):  # which a run writes last
            raise InputError(
                f"{folder}: the run has not ended; continue it with the command in its run.json and"
                " --resume"
            )
        surface = read_surface(folder)
        return cls(
            folder,
            surface["vertices"],
            surface["faces"],
            texcoords_of(surface, os.path.join(folder, "surface.npz")),
            surface["frames"],
            sigma=surface.get("sigma"),
            score=surface.get("score"),
            metrics=_read_json(os.path.join(folder, "metrics.json")),
            about=_read_json(os.path.join(folder, "run.json")),
        )

    def path(self, *names: str) -> str:
        """A path in the run's folder."""
        return os.path.join(self.folder, *names)

    @property
    def fps(self) -> float:
        """Frames a second that the run was given."""
        return float(self.about.get("fps", 15))

    @cached_property
    def other(self) -> np.ndarray | None:
        """Vertices (T, N, 3) [m, camera frame] of a second surface that explains the video about as
        well, None where there is none.
        """
        path = self.path(OTHER)
        return read_surface(path)["vertices"] if os.path.exists(path) else None

    @cached_property
    def camera(self) -> Intrinsics | None:
        """The :class:`polysft_mi.camera.Intrinsics` of the images, None in a folder of an older
        version, which has no camera.json.
        """
        path = self.path("camera.json")
        return Intrinsics.from_json(path) if os.path.exists(path) else None

    @cached_property
    def cameras(self) -> dict[str, tuple[Intrinsics, np.ndarray]]:
        """Intrinsics and world_to_camera (4, 4) [m] of the further cameras, by name; the world is
        that of the scene.
        """
        path = self.path("cameras.json")
        return read_cameras(path) if os.path.exists(path) else {}

    @cached_property
    def settings(self) -> dict[str, str]:
        """Name to value of every ``<default>`` in force."""
        return known_defaults(self.path("scene.xml"))

    @cached_property
    def texture(self) -> str | None:
        """The path of the template's texture as the scene names it, or None where it names none.
        The file may be gone.
        """
        return self.texture_of(self.path("scene.xml"))

    @staticmethod
    def texture_of(path: str) -> str | None:
        """:attr:`texture` of the scene file ``path``."""
        defaults, root = known_defaults(path), ET.parse(path).getroot()
        shapes = root.findall("shape[@id='template']") or root.findall("shape")
        ids = {ref.get("id") for shape in shapes for ref in shape.iter("ref")}
        places = shapes + [e for e in root if e.get("id") in ids]
        for texture in (t for place in places for t in place.iter("texture")):
            name = texture.find("string[@name='filename']")
            if name is not None:
                return located(path, _filled(name.get("value", ""), defaults))
        return None

    @cached_property
    def images(self) -> list[str]:
        """The paths of the frames' images (T,), as the scene names them; none where they are
        gone.
        """
        path, settings = self.path("scene.xml"), self.settings
        name = ET.parse(path).getroot().find("integrator/string[@name='frames']")
        text = _filled(name.get("value", ""), settings) if name is not None else ""
        try:
            found = list_images(located(path, text))
        except InputError:
            return []
        return [found[k] for k in self.frames] if self.frames.max() < len(found) else []

    @property
    def uv(self) -> np.ndarray | None:
        """Texture coordinates (N, 2), one a vertex, v up; None where the texture has seams."""
        return self.texcoords.of_vertices(self.faces)

    @cached_property
    def params(self) -> dict[str, np.ndarray]:
        """The arrays of params.npz. Those of an older version, whose template was one patch, are
        brought into the form of this one.
        """
        path = self.path("params.npz")
        p = load_npz(path)
        if "alpha" in p and p["alpha"].ndim == 1:
            p = _of_one_patch(p)
        missing = [name for name in _PARAMS if name not in p]
        if missing:
            raise InputError(f"{path}: holds no {', '.join(missing)}; run the scene anew")
        return p

    def log(self) -> list[dict]:
        """The records of log.jsonl."""
        path = self.path("log.jsonl")
        if not os.path.exists(path):
            return []
        with open(path, encoding="utf-8") as file:
            try:
                records = [json.loads(line) for line in file if line.strip()]
            except ValueError as error:
                raise InputError(f"{path}: not JSON lines ({error})") from None
        if not all(isinstance(record, dict) for record in records):
            raise InputError(f"{path}: a line is no JSON object")
        return records

    def mean_curvature(self) -> np.ndarray:
        """Mean curvature (T, N) [1/m] of the jets, without relief, at the vertices, each in its own
        patch; positive where the surface bulges to the side that the patch nearest to the camera
        shows there, by its pose in the first frame.
        """
        from scipy.spatial.transform import Rotation

        p = self.params
        first = Rotation.from_quat(p["rotation"][0]).as_matrix()
        nearest = int(p["frame_origin"][:, 2].argmin())
        up = p["frame_rotation"][nearest] @ first[nearest, :, 2]  # its z in the camera frame
        out = np.empty(p["delta_u"].shape)
        for k, (alpha, radius) in enumerate(zip(p["alpha"], p["radius"])):
            own = p["patch"][:, 0] == k
            to_chart = p["frame_rotation"][k].T @ p["axes"][own] * (p["scale"] / radius)
            offset = np.stack([p[f"delta_{name}"][:, own] for name in "uvw"], -1)
            uv = p["chart"][own, 0] + np.einsum("nij,tnj->tni", to_chart[:, :2], offset)
            moved = alpha + p["delta_alpha"][:, k]
            out[:, own] = jets.mean_curvature(moved, uv) / radius
        return np.sign(up[2]) * out


_PARAMS = (
    *("alpha", "patch", "weight", "chart", "rest", "scale", "radius"),
    *("frame_rotation", "frame_origin", "axes"),
    *("delta_alpha", "delta_u", "delta_v", "delta_w", "rotation", "translation"),
)


def _of_one_patch(p: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of an older params.npz, which had one patch, as this version has them."""
    count = len(p["chart"])
    alone = {"patch": np.zeros((count, 1), dtype=np.int64), "weight": np.ones((count, 1))}
    for name in ("alpha", "frame_rotation", "frame_origin"):
        alone[name] = p[name][None]
    for name in ("delta_alpha", "rotation", "translation"):
        alone[name] = p[name][:, None]
    return {
        **p,
        **alone,
        "chart": p["chart"][:, None],
        "rest": np.zeros((count, 1)),
        "radius": p["scale"].reshape(1),
        "axes": np.tile(p["frame_rotation"], (count, 1, 1)),
    }


def _filled(text: str, defaults: Mapping[str, str]) -> str:
    """The text with ``$name`` replaced, and what those name."""
    for _ in range(8):  # $frames is $data/frames
        text = re.sub(r"\$(\w+)", lambda m: defaults.get(m[1], m[0]), text)
    return text


def _read_json(path: str) -> dict:
    """The object that a JSON file holds. Raises InputError."""
    try:
        with open(path, encoding="utf-8") as file:
            value = json.load(file)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: not readable JSON ({getattr(error, 'strerror', None) or error})"
        ) from None
    if not isinstance(value, dict):
        raise InputError(f"{path}: not a JSON object")
    return value
