"""The video: images, and silhouettes where there are any, checked once at the start and read one
frame at a time.
"""

import functools
import glob
import os
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from polysft_mi.errors import InputError

EXTENSIONS = (
    ".png",
    ".jpg",
    ".jpeg",
    ".jpe",
    ".bmp",
    ".tif",
    ".tiff",
    ".webp",
    ".ppm",
    ".pgm",
    ".pnm",
    ".exr",
    ".hdr",
)


class Sequence:
    """The selected frames of a video; ``frame(i)`` and ``mask(i)`` count from 0 in the selection,
    ``len()`` is its length.

    ``files``, ``mask_files``: paths (``mask_files`` is None without masks); ``indices``: for each
    selected frame its index in the sorted list of all images; ``size``: (width, height) [pixels].
    """

    def __init__(self, files, mask_files, indices, size, drop_stray):
        self.files, self.mask_files, self.indices, self.size = files, mask_files, indices, size
        self._drop_stray = drop_stray

    @classmethod
    def open(cls, frames, masks="", first=0, last=-1, stride=1, size=None, drop_stray=True):
        """Find, select and check the images.

        ``frames``, ``masks``: a folder of images or a glob pattern, sorted by name, numbers in
        names by value; masks pair with images in that order, ``""`` is for none. ``first`` to
        ``last`` (inclusive, -1 for the end) in steps of ``stride`` are used. ``size``: the (width,
        height) that the frames must have, None for any. ``drop_stray``: see :meth:`mask`.

        Every selected file is read here once, so that a bad one is known before the work starts.
        Raises InputError.
        """
        paths = list_images(frames, "frames")
        if not 0 <= first < len(paths):
            raise InputError(f"first = {first}; {frames} holds {len(paths)} images, counted from 0")
        if last != -1 and not first <= last < len(paths):
            raise InputError(
                f"last = {last}; it must lie in [{first}, {len(paths) - 1}] ({frames} holds"
                f" {len(paths)} images), or be -1 for the end"
            )
        if stride < 1:
            raise InputError(f"stride = {stride}; at least 1 is needed")
        indices = list(range(first, len(paths) if last == -1 else last + 1, stride))
        files = [paths[k] for k in indices]
        mask_files = None
        if masks:
            mask_paths = list_images(masks, "masks")
            if len(mask_paths) != len(paths):
                raise InputError(
                    f"{masks}: {len(mask_paths)} masks for the {len(paths)} images of {frames}; one"
                    " mask an image is needed"
                )
            mask_files = [mask_paths[k] for k in indices]

        everything = files + (mask_files or [])
        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
            sizes = dict(zip(everything, pool.map(_checked_size, everything)))
        wanted, why = (
            (tuple(size), "the camera's film has") if size else (sizes[files[0]], f"{files[0]} has")
        )
        for path in everything:
            if sizes[path] != wanted:
                raise InputError(
                    f"{path}: {_text(sizes[path])} pixels; {why} {_text(wanted)}, and all images"
                    " must be of that size"
                )
        sequence = cls(files, mask_files, indices, wanted, drop_stray)
        if mask_files and not sequence.mask(0).any():
            raise InputError(
                f"{mask_files[0]}: the mask is empty; the template must be seen in the first frame"
            )
        return sequence

    def __len__(self):
        return len(self.files)

    def frame(self, i):
        """Image i, (H, W, 3) float32, linear RGB in [0, 1].

        8 and 16 bit images are taken as sRGB and decoded; float images (EXR, HDR, TIFF) as linear.
        Grey becomes RGB, alpha is ignored.
        """
        image = read_pixels(self.files[i])
        if image.ndim == 2:
            image = image[..., None]
        image = np.ascontiguousarray(
            image[..., 2::-1] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
        )  # OpenCV's order is BGR
        return _linear(image, self.files[i])

    def mask(self, i):
        """Silhouette i, (H, W) float32 in [0, 1]; None without masks.

        The largest of the colour channels, in parts of the type's maximum (an 8 or 16 bit mask with
        no value above 1 is taken as it is). With ``drop_stray``, blobs away from the sheet are
        removed (:func:`drop_stray_components`).
        """
        if self.mask_files is None:
            return None
        path = self.mask_files[i]
        image = read_pixels(path)
        if image.ndim == 3:
            image = image[..., :3].max(axis=2) if image.shape[2] >= 3 else image[..., 0]
        scale = 1 if image.dtype.kind == "f" or image.max() <= 1 else np.iinfo(image.dtype).max
        mask = np.clip(_finite(image, path).astype(np.float32) / scale, 0, 1)
        return drop_stray_components(mask) if self._drop_stray else mask


def drop_stray_components(mask, share=0.1):
    """The mask (H, W) without its 8-connected components of less than ``share`` of the largest
    one's area. (Something before the sheet may split it into parts of some size.)
    """
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (mask > 0).astype(np.uint8), connectivity=8
    )
    if count <= 2:
        return mask
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return mask * (area >= share * area.max())[labels]


def list_images(pattern, what="images"):
    """The image files of a folder or a glob pattern, sorted by name, numbers in names by value.
    Raises InputError where there are none.
    """
    pattern = os.fspath(pattern)
    if os.path.isdir(pattern):
        found = [os.path.join(pattern, name) for name in os.listdir(pattern)]
    else:
        folder, name = os.path.split(pattern)
        if os.path.isdir(
            folder or "."
        ):  # a folder's own name may hold the letters that a pattern uses
            folder = glob.escape(folder)
        elif not glob.has_magic(folder):
            raise InputError(
                f"{what}: {pattern}: no such folder; a folder of images or a glob pattern is needed"
            )
        found = glob.glob(os.path.join(folder, name))
    images = [
        p
        for p in found
        if p.lower().endswith(EXTENSIONS)
        and not os.path.basename(p).startswith(".")
        and os.path.isfile(p)
    ]
    if not images:
        kind = "folder" if os.path.isdir(pattern) else "pattern"
        raise InputError(
            f"{what}: {pattern}: no images in this {kind}; PNG, JPEG, TIFF, EXR and the like are"
            " read"
        )
    return sorted(images, key=natural_key)


def natural_key(name):
    """Sort key by which ``frame_2`` comes before ``frame_10``."""
    return [
        int(part) if part.isdigit() else part.lower() for part in re.split(r"([0-9]+)", name)
    ], name


def image_size(path):
    """(width, height) of an image file, from its header. Raises InputError where it is not a
    readable image.
    """
    return _checked_size(path, decode=False)


def _checked_size(path, decode=True):
    """(width, height); reads the whole file by Pillow, which, other than OpenCV, reports one that
    breaks off: the pixels of most kinds, the checksums of PNG.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            size = image.size
            if decode and image.format == "PNG":
                image.verify()  # a tenth of the time
            elif decode:
                image.load()
            return size
    except UnidentifiedImageError:  # of another kind than Pillow knows, EXR among them
        return read_pixels(path).shape[1::-1]
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path}: not a readable image ({getattr(error, 'strerror', None) or error})"
        ) from None


def read_pixels(path):
    """Pixels as the file has them: (H, W) or (H, W, C) in OpenCV's channel order, uint8, uint16 or
    float32.
    """
    import cv2

    if path.lower().endswith(".exr"):
        return _read_exr(path)
    try:
        image = cv2.imread(path, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"{path}: not a readable image ({error.err})") from None
    if image is None:
        raise InputError(
            f"{path}: not a readable image" if os.path.isfile(path) else f"{path}: no such file"
        )
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(
            f"{path}: pixels of type {image.dtype}; 8 or 16 bit unsigned, or float, is needed"
        )
    return image


def _read_exr(path):
    """Plain R, G, B (in OpenCV's order), or Y, or the only channel. Not by OpenCV, whose wheels
    come without EXR.
    """
    import OpenEXR

    try:
        with OpenEXR.File(path, separate_channels=True) as file:
            planes = {
                name: np.asarray(channel.pixels, dtype=np.float32)
                for name, channel in file.channels().items()
            }
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: not a readable image ({error})") from None
    names = (
        "BGR"
        if {"R", "G", "B"} <= set(planes)
        else [n for n in planes if n == "Y" or len(planes) == 1]
    )
    if not names:
        raise InputError(
            f"{path}: has the channels {', '.join(sorted(planes))}; R, G and B, or Y, are needed"
        )
    return np.stack([planes[name] for name in names], axis=-1)


def _linear(image, path):
    if image.dtype.kind == "f":
        return np.clip(_finite(image, path), 0, 1)
    table = _srgb_table(np.iinfo(image.dtype).max)
    if image.dtype == np.uint8:
        import cv2

        return cv2.LUT(image, table)  # the same in a third of the time
    return table[image]


def _finite(image, path):
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise InputError(f"{path}: holds pixels that are not finite")
    return image


@functools.lru_cache(maxsize=2)
def _srgb_table(largest):
    """Linear value of each sRGB code 0..largest (IEC 61966-2-1), float32."""
    x = np.arange(largest + 1) / largest
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _text(size):
    return f"{size[0]}x{size[1]}"
