"""Image files as people have them: found, checked, and read, of any orientation, bit depth and
alpha.
"""

import glob
import os
import re

import numpy as np

from polyfit.colours import srgb
from polyfit.files import silent_decoders
from polysft_mi.errors import InputError

_ORIENTATION = 0x0112  # the tag of Exif
EXTENSIONS = tuple(".png .jpg .jpeg .jpe .bmp .tif .tiff .webp .ppm .pgm .pnm .exr .hdr".split())


def list_images(pattern, what="images", endings=EXTENSIONS):
    """The image files of a folder or a glob pattern, by their ``endings``, sorted by name, numbers
    in names by value. Raises InputError where there are none, or two that differ by their ending
    alone.
    """
    pattern = os.fspath(pattern)
    if os.path.isdir(pattern):
        found = [os.path.join(pattern, name) for name in os.listdir(pattern)]
    elif not pattern:
        raise InputError(
            f"{what}: nothing is given; a folder of images or a glob pattern is needed"
        )
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
        if p.lower().endswith(endings)
        and not os.path.basename(p).startswith(".")
        and os.path.isfile(p)
    ]
    if not images:
        if not (glob.has_magic(pattern) or os.path.exists(pattern)):
            raise InputError(f"{what}: {pattern}: no such folder")
        kind = "folder" if os.path.isdir(pattern) else "pattern"
        raise InputError(
            f"{what}: {pattern}: no images in this {kind}; PNG, JPEG, TIFF, EXR and the like are"
            " read"
        )
    images.sort(key=_natural_key)
    named = {}
    for path in images:
        stem, ending = os.path.splitext(path)
        other = named.setdefault(stem, path)
        if other != path:
            raise InputError(
                f"{what}: {other} and {os.path.basename(path)} differ by their ending alone; one of"
                f" both is needed, or a pattern such as '*{ending}'"
            )
    return images


def _natural_key(name):
    """Sort key by which ``frame_2`` comes before ``frame_10``."""
    return [
        int(part) if part.isdigit() else part.lower() for part in re.split(r"([0-9]+)", name)
    ], name


def image_size(path):
    """(width, height) of an image file, from its header. Raises InputError where it is not a
    readable image.
    """
    return checked_size(path, decode=False)


def checked_size(path, decode=True):
    """(width, height) of an image file, which is read as a whole where ``decode``. Raises
    InputError.

    By Pillow, which reports a file that breaks off, unlike OpenCV: all pixels of most kinds, the
    checksums of PNG.
    """
    from PIL import Image, UnidentifiedImageError

    with silent_decoders():
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


def check_upright(path):
    """Raise InputError where an image is to be turned, as its Exif orientation says, to be seen as
    it was taken: its pixels would be used as they are.
    """
    if (orientation := _exif(path).get(_ORIENTATION, 1)) in range(2, 9):
        raise InputError(
            f"{path}: its Exif orientation ({orientation}) turns it; frames and masks are read as"
            " their pixels stand. Store them upright, without it; polysft prepare VIDEO, where"
            " VIDEO may be their folder, does so"
        )


def read_pixels(path, depth=False):
    """Pixels as the file has them: (H, W) or (H, W, C) in OpenCV's channel order, uint8, uint16 or
    float32. ``depth``: of an EXR that has a channel of depth, that one.
    """
    import cv2

    if path.lower().endswith(".exr"):
        return _read_exr(path, depth)
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


def _read_exr(path, depth):
    """Plain R, G, B (in OpenCV's order), or Y, or the only channel; where ``depth`` is looked for,
    before them Z, or one with "depth" in its name, as renderers write it beside colours. Not by
    OpenCV, whose wheels come without EXR.
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
    names = [n for n in sorted(planes) if depth and (n == "Z" or "depth" in n.lower())][:1]
    if not names and {"R", "G", "B"} <= set(planes):
        names = "BGR"
    names = names or [n for n in planes if n == "Y" or len(planes) == 1]
    if not names:
        needed = "Z, or one called depth, is needed" if depth else "R, G and B, or Y, are needed"
        raise InputError(f"{path}: has the channels {', '.join(sorted(planes))}; {needed}")
    return np.stack([planes[name] for name in names], axis=-1)


def finite(image, path):
    """The image itself. Raises InputError where it is of floats that are not all finite."""
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise InputError(f"{path}: holds pixels that are not finite")
    return image


def read_mask(path):
    """A silhouette (H, W), float32 in [0, 1]: of an image whose alpha varies that, else the largest
    of its colours. Of integers that are 0 or one other number, as in images of labels, that number
    is 1; others are in parts of their type's maximum.
    """
    image = finite(read_pixels(path), path)
    if image.ndim == 3:
        alpha = image[..., -1] if image.shape[2] in (2, 4) else None
        colours = image[..., : 3 if image.shape[2] >= 3 else 1].max(axis=2)
        image = colours if alpha is None or alpha.min() == alpha.max() else alpha
    scale = 1
    if image.dtype.kind != "f":
        highest = max(int(image.max()), 1)
        labels = ((image == 0) | (image == highest)).all()
        scale = highest if labels else np.iinfo(image.dtype).max
    return np.clip(image.astype(np.float32) / scale, 0, 1)


def read_rgb(path):
    """The image (H, W, 3), uint8 sRGB, upright.

    Turned as its Exif orientation says; 16 bits become 8, float pixels are taken as linear, grey
    becomes RGB; what is transparent becomes white. Raises InputError where it is not a readable
    image.
    """
    if os.fspath(path).lower().endswith((".heic", ".heif", ".avif")):
        raise InputError(f"{path}: HEIC and AVIF are not read; export it as JPEG or PNG")
    path = os.fspath(path)
    checked_size(path)
    with silent_decoders():
        pixels = read_pixels(path)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif pixels.dtype.kind == "f":
        pixels = _encoded(finite(pixels, path))
    channels = pixels.shape[2]
    alpha = pixels[..., -1:] if channels in (2, 4) else None
    colour = pixels[..., 2::-1] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if alpha is not None:
        a = alpha.astype(np.uint16)
        colour = ((colour * a + 255 * (255 - a) + 127) // 255).astype(np.uint8)
    return np.ascontiguousarray(upright(colour, _exif(path).get(_ORIENTATION, 1)))


def upright(image, orientation):
    """An image (H, W, ...) as its Exif ``orientation``, 1 to 8, means it to be seen."""
    if orientation in (5, 6, 7, 8):
        image = np.swapaxes(image, 0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return image


def focal_35mm(path):
    """The focal length [mm], for film of 36x24 mm, that an image's Exif data have; None where they
    have none.
    """
    exif, focal_length_in_35mm_film = 0x8769, 0xA405  # tags
    value = _exif(path).get_ifd(exif).get(focal_length_in_35mm_film)
    try:
        return float(value) if value and float(value) > 0 else None
    except (TypeError, ValueError):
        return None


def _exif(path):
    from PIL import Image

    try:
        with silent_decoders(), Image.open(path) as image:
            return image.getexif()
    except (
        OSError,
        SyntaxError,
        ValueError,
    ):  # EXR, and what Pillow does not know; the pixels are read by others
        return Image.Exif()


def _encoded(linear):
    """Linear colours as 8-bit sRGB (IEC 61966-2-1); alpha, the fourth channel, as it is."""
    x = np.clip(linear, 0, 1)
    colours = slice(3 if x.shape[2] >= 3 else 1)
    x[..., colours] = srgb(x[..., colours])
    return np.round(255 * x).astype(np.uint8)
