"""The moving surface of a run in the formats of other programs: USD, glTF, OBJ, PLY, arrays."""

import os

import numpy as np

from polyfit.errors import require
from polyfit.files import aside, folder_for
from polysft_mi.errors import InputError

from .truth import uv_arrays

FORMATS = ("usd", "glb", "obj", "ply", "npz")
# of each format that is one file, the first is the default; the others are folders
EXTENSIONS = {
    "usd": (".usdz", ".usdc", ".usda", ".usd"),
    "glb": (".glb",),
    "npz": (".npz",),
}


def export(run, kind, path=None, *, up="y", fps=None, texture=None):
    """Write the surface of a :class:`~polysft_mi.results.run.Run` in the format ``kind``; returns
    the path written.

    ``path``: the file, for "obj" and "ply" the folder, by default in the run's ``export`` folder.
    ``up``: "y", "z", or "camera" for the OpenCV camera frame as it is (which USD and glTF do not
    have); ``fps``: frames a second, by default the run's; ``texture``: another image than the
    scene's. Raises InputError.
    """
    from polyfit import animation

    fps = run.fps if fps is None else fps
    if not (np.isfinite(fps) and 0 < fps <= 1000):
        raise InputError(f"--fps {fps:g}: a rate above 0, at most 1000, is needed")
    if (kind == "glb" and up != "y") or (kind == "usd" and up == "camera"):
        raise InputError(
            f"--up {up}: {'glTF has y up' if kind == 'glb' else 'USD has y or z up'}; leave it"
            f" out{' or give z' if kind == 'usd' else ''}"
        )
    if kind == "usd":
        require("pxr")
    path = _place(run, kind, path)
    vertices = run.vertices if up == "camera" else animation.from_camera(run.vertices, up)
    image = _texture(run, texture) if kind in ("usd", "glb", "obj") else None
    with folder_for(os.path.dirname(path) or "."):
        if kind == "usd":
            animation.write_usd(path, vertices, run.faces, run.texcoords, image, fps=fps, up=up)
        elif kind == "glb":
            animation.write_glb(path, vertices, run.faces, run.texcoords, image, fps=fps)
        elif kind == "npz":
            arrays = {
                "vertices": vertices,
                "faces": run.faces,
                **uv_arrays(run.texcoords, run.faces),
                "frames": run.frames,
                "fps": np.float64(fps),
                "up": up,
            }
            with aside(path) as temporary:
                np.savez_compressed(temporary, **arrays)
        else:
            animation.write_frames(
                path, kind, vertices, run.faces, run.texcoords, image, labels=run.frames, up=up
            )
    return path


def _place(run, kind, path):
    """The file or folder to write; refused where it cannot be one."""
    known = EXTENSIONS.get(kind)
    if path is None:
        path = run.path("export", f"surface{known[0]}" if known else kind)
        return path
    folder = os.path.dirname(os.path.abspath(path))
    if known and not path.lower().endswith(known):
        raise InputError(f"-o {path}: {', '.join(known)} is needed for --format {kind}")
    if known and os.path.isdir(path):
        raise InputError(f"-o {path}: is a folder; a file is written for --format {kind}")
    if not os.path.isdir(folder):
        raise InputError(f"-o {path}: {folder}: no such folder")
    place, own = (os.path.realpath(x) for x in (path, run.folder))
    inside = os.path.relpath(place, own).split(os.sep)
    if inside[0] not in (os.pardir, "export"):
        raise InputError(
            f"-o {path}: lies in the run's own folder; another one is needed, or no -o, for"
            f" {run.path('export')}"
        )
    return path


def _texture(run, given):
    """The path of the image, or InputError where the one that the scene names is gone. None where
    the scene names none.
    """
    path = given if given is not None else run.texture
    if path is not None and not os.path.isfile(path):
        raise InputError(
            f"{path}: no such file;"
            f" {'--texture' if given else 'the scene names it as the texture: --texture'} takes an"
            " image"
        )
    return path
