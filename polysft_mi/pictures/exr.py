"""Multi-layer OpenEXR files: several images of one frame in one file, each layer a group of
channels by its prefix.

A layer ``name`` becomes the channels ``name.R``, ``name.G``, ... in the way that viewers group them
(tev, mrViewer, Nuke, Blender). The layer ``render`` is written once more as plain R, G, B (and A),
which is what programs without layers show.
"""

import json
import os

import numpy as np

from polyfit.files import aside

# by the layer's name, and float32; the others by their count, and half
_KINDS = {
    "depth": "Z",
    "normal": "XYZ",
    "uv": "UV",
    "patch": "Y",
    "depth_a": "Z",
    "depth_b": "Z",
    "depth_difference": "Z",
    "distance": "Y",
}
_COLOURS = {1: "Y", 3: "RGB", 4: "RGBA"}
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_DEFAULT_LAYER = "render"


def _channel_names(layer, count):
    """The names of the ``count`` channels of a layer, for example ``["render.R", "render.G",
    "render.B"]``.

    Raises ValueError where the layer's kind has another number of channels.
    """
    suffixes = _KINDS.get(layer, _COLOURS.get(count))
    if suffixes is None or len(suffixes) != count:
        raise ValueError(
            f"layer {layer} has {count} channels;"
            f" {len(_KINDS[layer]) if layer in _KINDS else '1, 3 or 4'} are needed"
        )
    return [f"{layer}.{s}" for s in suffixes]


def write_exr(path, layers, metadata=None, plain=_DEFAULT_LAYER):
    """Write ``layers`` (name -> (H, W) or (H, W, C)) to the EXR file ``path``, ZIP-compressed; the
    layer ``plain`` once more as plain R, G, B.

    Colours, errors and masks are linear values (Rec.709 primaries) and are stored as half;
    ``depth`` and its kin [m], ``normal`` (camera frame), ``uv`` and ``patch`` as float32.
    ``metadata`` (name -> str, int, float, or anything that JSON holds, as a string) goes into the
    header. Raises ValueError for layers of different sizes and OSError where the file cannot be
    written.
    """
    import OpenEXR

    channels, size = {}, None
    for layer, image in layers.items():
        image = np.asarray(image)
        image = image[..., None] if image.ndim == 2 else image
        if image.ndim != 3 or image.size == 0 or size not in (None, image.shape[:2]):
            raise ValueError(
                f"layer {layer} has shape {image.shape}; (H, W) or (H, W, C) and one size for all"
                " are needed"
            )
        size = image.shape[:2]
        names = _channel_names(layer, image.shape[2])
        if layer in _KINDS:
            image = image.astype(np.float32)
        else:
            image = np.clip(image, -65504, 65504).astype(
                np.float16
            )  # beyond half's range lies only infinity
        for k, name in enumerate(names):
            plane = np.ascontiguousarray(image[..., k])
            channels[name] = OpenEXR.Channel(plane)
            if layer == plain and name[-1] in "RGBA":
                channels[name[-1]] = OpenEXR.Channel(plane)
    if not channels:
        raise ValueError("no layers; at least one is needed")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": _REC709,
    }
    for name, value in (metadata or {}).items():
        header[name] = _attribute(value)
    with aside(path) as temporary:
        try:
            with OpenEXR.File(header, channels) as file:
                file.write(temporary)
        except RuntimeError as error:
            raise OSError(None, f"cannot write the image: {error}", os.fspath(path)) from None


def _attribute(value):
    if isinstance(value, np.generic):
        value = value.item()
    return (
        value
        if isinstance(value, (str, int, float)) and not isinstance(value, bool)
        else json.dumps(value)
    )


def read_exr(path):
    """``(layers, header)`` of a file of :func:`write_exr`: name -> (H, W, C), without the plain
    copy of ``render``.

    Raises OSError where the file cannot be read.
    """
    import OpenEXR

    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels().items()}
            header = dict(file.header())
    except RuntimeError as error:
        raise OSError(None, f"cannot read the image: {error}", os.fspath(path)) from None
    layers = {}
    for layer in sorted({name.rpartition(".")[0] for name in planes} - {""}):
        count = sum(name.rpartition(".")[0] == layer for name in planes)
        layers[layer] = np.stack([planes[name] for name in _channel_names(layer, count)], axis=-1)
    return layers, header
