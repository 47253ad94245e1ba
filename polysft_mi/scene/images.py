"""Single images as people have them: any orientation, bit depth and alpha, read as 8-bit sRGB."""

import os

import numpy as np

from polysft_mi.errors import InputError

from .sequence import image_size, read_pixels


def read_rgb(path):
    """The image (H, W, 3), uint8 sRGB, upright.

    Turned as its Exif orientation says; 16 bits become 8, float pixels are taken as linear, grey
    becomes RGB; what is transparent becomes white. Raises InputError where it is not a readable
    image.
    """
    if os.fspath(path).lower().endswith((".heic", ".heif", ".avif")):
        raise InputError(f"{path}: HEIC and AVIF are not read; export it as JPEG or PNG")
    path = os.fspath(path)
    image_size(path)  # by Pillow, whose words on a broken file are clear
    pixels = read_pixels(path)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif pixels.dtype.kind == "f":
        if not np.isfinite(pixels).all():
            raise InputError(f"{path}: holds pixels that are not finite")
        pixels = _encoded(pixels)
    channels = pixels.shape[2]
    alpha = pixels[..., -1:] if channels in (2, 4) else None
    colour = pixels[..., 2::-1] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if alpha is not None:
        a = alpha.astype(np.uint16)
        colour = ((colour * a + 255 * (255 - a) + 127) // 255).astype(np.uint8)
    return np.ascontiguousarray(upright(colour, _exif(path).get(0x0112, 1)))


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
        with Image.open(path) as image:
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
    colours = x[..., :3] if x.shape[2] >= 3 else x[..., :1]
    x = np.concatenate(
        [
            np.where(colours <= 0.0031308, 12.92 * colours, 1.055 * colours ** (1 / 2.4) - 0.055),
            x[..., colours.shape[2] :],
        ],
        axis=2,
    )
    return np.round(255 * x).astype(np.uint8)
