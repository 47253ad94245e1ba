"""Depth images as recording programs leave them: where they lie, and which camera sees them.

Record3D's export "EXR + RGB" (``depth``, ``rgb``, ``metadata.json``), ScanNet's exports (``depth``,
``color``, ``intrinsic``), and what ``rs-convert`` makes of a RealSense recording
(``*_Depth_*.csv``).
"""

import glob
import json
import os
from dataclasses import dataclass

import numpy as np

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.scene import EXTENSIONS, image_size, list_images, read_pixels

from .output import write_png

DEPTH = "depth"  # in the scene's folder
_NAME = "{:05d}.png"
_IMAGES = (*EXTENSIONS, ".csv")
_UNIT = 1e-4  # metres of a whole number of the depth images that are written
_MOST = 65535  # what they hold; farther off there is no sheet
_FEW = 0.01  # share of an image that tells nothing of a sheet
_UNITS = (1e-3, 1e-4, 1e-2, 1e-5, 1.0)  # of depth cameras, the likely ones first [m]
_APART = 0.5  # pixels up to which two cameras see alike
_STRAIGHT = 1e-3  # how far a pose may be from another's


@dataclass(frozen=True)
class DepthFolder:
    """``images``: a folder or a pattern; ``form``: what they are, in words; ``camera``: theirs,
    where it is known (:class:`polysft_mi.camera.Intrinsics`), at the colour camera's place, or None
    where they show what the colour images do; ``colour``: that of the colour images, or None;
    ``note``: a line for a person, or "".
    """

    images: str
    form: str = ""
    camera: Intrinsics | None = None
    colour: Intrinsics | None = None
    note: str = ""

    def is_seen_by(self, view):
        """Whether the images, scaled, show what a camera does."""
        if self.camera is None:
            return True
        c = self.camera
        x, y = view.width / c.width, view.height / c.height
        off = [
            abs(a - b)
            for f, m, g, n, side in (
                (c.fx * x, c.cx * x, view.fx, view.cx, view.width),
                (c.fy * y, c.cy * y, view.fy, view.cy, view.height),
            )
            for a, b in ((n - m * g / f, 0), (n + (side - m) * g / f, side))
        ]
        return max(off) <= _APART

    def seen_by(self, depth, view):
        """Depth (H, W) [m] as a camera at the same place sees it (view.height, view.width): the
        nearest pixel of each, 0 beyond the image.
        """
        (height, width), c = depth.shape, self.camera
        x, y = width / c.width, height / c.height
        columns = ((np.arange(view.width) + 0.5 - view.cx) / view.fx * c.fx + c.cx) * x
        rows = ((np.arange(view.height) + 0.5 - view.cy) / view.fy * c.fy + c.cy) * y
        inside = ((rows >= 0) & (rows < height))[:, None] & (columns >= 0) & (columns < width)
        rows, columns = (
            np.clip(at, 0, side - 1).astype(int) for at, side in ((rows, height), (columns, width))
        )
        return np.where(inside, depth[rows[:, None], columns], 0)


def recognise_depth(path):
    """The :class:`DepthFolder` of a folder, of the folder ``depth`` in one, or of a pattern. Raises
    InputError where its form is known and cannot be used.
    """
    path = os.path.normpath(path)
    record = f"{path}: depth in it is compressed as by Apple (LZFSE); export EXR + RGB in Record3D"
    if path.lower().endswith(".r3d"):
        raise InputError(record)
    if os.path.isfile(path) and not path.lower().endswith(_IMAGES):
        hint = ", as ScanNet's SensReader exports it" if path.lower().endswith(".sens") else ""
        raise InputError(f"{path}: a folder of depth images, one a frame, is needed{hint}")
    if not os.path.isdir(path):
        return DepthFolder(path)
    if glob.glob(os.path.join(glob.escape(path), "rgbd", "*.depth")):
        raise InputError(record)
    inside = os.path.basename(path).lower() == "depth"
    for folder in (path, os.path.dirname(path)) if inside else (path,):
        if os.path.isdir(os.path.join(folder, "depth")):
            found = _scannet(folder) or _record3d(folder)
            if found:
                return found
    found = _realsense(path) or DepthFolder(path)
    within = os.path.join(path, "depth")
    if os.path.isdir(within) and not any(n.lower().endswith(_IMAGES) for n in os.listdir(path)):
        raise InputError(
            f"{path}: depth of no known program: metadata.json with K, w and h (Record3D), or"
            f" intrinsic/intrinsic_depth.txt (ScanNet), is needed; {within} names the images alone"
        )
    return found


def check_range(images):
    """Raise InputError where :func:`write_depth` would keep hardly anything of the first of
    ``images`` (:class:`polysft_mi.scene.evidence.DepthImages`) that has depth.
    """
    if images.known_to != "metric":
        return
    each = ((k, images.read(k)) for k in range(len(images.files)))
    k, depth = next((k, depth) for k, depth in each if (depth > 0).any())
    known = depth[depth > 0]
    whole = np.round(known / _UNIT)
    if ((whole > 0) & (whole <= _MOST)).mean() > _FEW:
        return
    told, is_whole = np.median(known), images.is_whole(k)
    number = told / images.unit if is_whole else told
    likely = [unit for unit in _UNITS if 0.05 < number * unit < _UNIT * _MOST]
    hint = f", and {number:.4g} is likely in units of {likely[0]:g} m" if likely else ""
    needed = "--depth-unit says the unit" if is_whole else "EXR, TIFF and CSV are read in metres"
    raise InputError(
        f"{images.files[k]}: {told:.3g} m in the median is no distance of a sheet{hint}; {needed}"
    )


def write_depth(folder, images, converted):
    """Write depth images into ``folder``: of each of ``images``
    (:class:`polysft_mi.scene.evidence.DepthImages`) what ``converted(k)`` gives (H, W) [m].
    Returns the settings that say what they are.
    """
    os.makedirs(folder, exist_ok=True)
    for k in range(len(images.files)):
        depth = converted(k)
        # what is fitted to each frame anyway is known to no scale
        unit = _UNIT if images.known_to == "metric" else depth.max() / _MOST
        whole = np.round(depth / max(unit, 1e-12))
        whole = np.where(whole <= _MOST, whole, 0).astype(np.uint16)
        write_png(os.path.join(folder, _NAME.format(k)), whole)
    return {"depth_unit": _UNIT, "depth_known_to": images.known_to}


def _record3d(folder):
    """Depth has fewer pixels than the colour images, and shows what they do."""
    for name in ("metadata.json", "metadata"):
        try:
            with open(os.path.join(folder, name), encoding="utf-8-sig") as file:
                known = json.load(file)
            K = np.array(known["K"], dtype=np.float64).reshape(3, 3).T  # column by column
            size = int(known["w"]), int(known["h"])
        except (OSError, ValueError, TypeError, KeyError):
            continue
        colour = Intrinsics.from_matrix(K, *size, where=os.path.join(folder, name))
        return DepthFolder(os.path.join(folder, "depth"), "Record3D", None, colour)
    return None


def _scannet(folder):
    name = lambda kind, of: os.path.join(folder, "intrinsic", f"{kind}_{of}.txt")
    if not os.path.isfile(name("intrinsic", "depth")):
        return None
    poses = [name("extrinsic", of) for of in ("depth", "color")]
    if all(map(os.path.isfile, poses)):
        ours, theirs = map(_matrix, poses)
        if np.abs(ours - theirs).max() > _STRAIGHT:
            raise InputError(
                f"{poses[0]}: the depth camera stands elsewhere than the colour camera; depth as"
                " the camera of the frames sees it is needed"
            )
    cameras = []
    for of, images in (("depth", "depth"), ("color", "color")):
        where, images = name("intrinsic", of), os.path.join(folder, images)
        if not (os.path.isfile(where) and os.path.isdir(images)):
            cameras.append(None)
            continue
        K = _matrix(where)[:3, :3].copy()
        K[:2, 2] += 0.5  # it counts from the first pixel's centre
        size = image_size(list_images(images)[0])
        cameras.append(Intrinsics.from_matrix(K, *size, where=where))
    return DepthFolder(os.path.join(folder, "depth"), "ScanNet", *cameras)


def _realsense(folder):
    """Files of ``rs-convert -v``; or of 16 bit, as others write them by the same names."""
    for ending in ("csv", "png"):
        name = f"*_Depth_[0-9]*.{ending}"
        files = glob.glob(os.path.join(glob.escape(folder), name))
        if not files:
            continue
        if ending == "png" and read_pixels(min(files)).dtype == np.uint8:
            raise InputError(
                f"{min(files)}: rs-convert -p paints depth in colours, which do not tell it;"
                " rs-convert -v writes it as numbers"
            )
        note = (
            f"note: {folder}: a RealSense sees depth as its left infrared camera does; frames of"
            " that are needed, or depth that was aligned to colour"
        )
        return DepthFolder(os.path.join(folder, name), "RealSense", note=note)
    return None


def _matrix(path):
    """A matrix (4, 4) of a text file."""
    try:
        found = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a matrix ({error})") from None
    if found.shape != (4, 4) or not np.isfinite(found).all():
        raise InputError(f"{path}: {found.shape}; a matrix of 4 x 4 is needed")
    return found
