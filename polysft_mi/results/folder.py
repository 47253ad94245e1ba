"""The folder that a run writes to: whether it may be used, and what of an earlier run goes."""

import glob
import hashlib
import json
import os
import shutil
from collections.abc import Iterable

from polysft_mi.errors import InputError

OTHER = "other.npz"  # a second surface, in the form of the first one's file
FILES = (
    "scene.xml",
    "camera.json",
    "cameras.json",
    "run.json",
    "checkpoint.npz",
    "log.jsonl",
    "surface.npz",
    OTHER,
    "params.npz",
    "body.npz",
    "metrics.json",
    "loss.png",
    "comparison.png",
    "comparison.mp4",
    "report.html",
)
FOLDERS = ("meshes", "comparison")


def check_output(out, *, resume=False, overwrite=False):
    """Raise InputError where a run cannot write to the folder ``out``: before anything is
    computed.
    """
    if os.path.exists(out) and not os.path.isdir(out):
        raise InputError(f"{out}: is a file; OUT must be a folder")
    existing = os.path.abspath(out)
    while not os.path.lexists(existing):
        existing = os.path.dirname(existing)
    if not out or not os.path.isdir(existing) or not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(
            f"-o '{out}': {existing} is not a folder that can be written to; another one is needed"
        )
    holds_run = os.path.exists(os.path.join(out, "run.json"))
    if resume and not holds_run:
        raise InputError(f"{out}: holds no run to resume; leave out --resume to start one")
    if holds_run and not (overwrite or resume):
        raise InputError(
            f"{out}: holds a run; give --overwrite to replace it or --resume to continue it"
        )
    if os.path.isdir(out) and os.listdir(out) and not holds_run:
        raise InputError(f"{out}: is not empty and holds no run; give an empty or new folder")


def clear(out):
    """Remove what an earlier run left in the folder ``out``; nothing else."""
    of_cameras = glob.glob("comparison_*.png", root_dir=out)
    for name in (*FILES, *of_cameras):
        if os.path.exists(os.path.join(out, name)):
            os.remove(os.path.join(out, name))
    for name in (*FOLDERS, "comparison.mp4", "export"):
        shutil.rmtree(os.path.join(out, name), ignore_errors=True)


def digest(files: Iterable[str]) -> str:
    """What tells the contents of these files, in this order, from others."""
    found = hashlib.blake2b(digest_size=8)
    for path in files:
        with open(path, "rb") as file:
            found.update(hashlib.blake2b(file.read()).digest())
    return found.hexdigest()


def check_same(out, scene, inputs):
    """Raise InputError where the run in ``out`` had another resolved scene (text) than ``scene``,
    or files of another :func:`digest` than ``inputs``: resumed, it would give a result that no
    scene describes.
    """
    found = {}
    for name in ("scene.xml", "run.json"):
        path = os.path.join(out, name)
        try:
            with open(path, encoding="utf-8") as file:
                found[name] = file.read() if name == "scene.xml" else json.load(file)
        except (OSError, ValueError) as error:
            why = "missing" if isinstance(error, OSError) else "broken"
            raise InputError(
                f"{path}: {why}; the run cannot be resumed, give --overwrite to start again"
            ) from None
    if found["scene.xml"] != scene:
        path = os.path.join(out, "scene.xml")
        raise InputError(
            f"{out}: was run with another scene or other settings (see {path}); resume with those,"
            " or give --overwrite"
        )
    if found["run.json"].get("inputs", inputs) != inputs:
        raise InputError(
            f"{out}: the template, a texture, frames, masks or evidence have changed since the run"
            " began; put them back to resume it, or give --overwrite"
        )
