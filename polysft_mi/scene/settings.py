"""The settings of an experiment: names, types, defaults and meanings, in one place.

A scene file carries each of them as a ``<default>`` and hands it to the ``polysft`` plugin; a
preset overrides those of a scene, and ``-D name=value`` overrides both. ``python -m
polysft_mi.scene.settings`` prints them as the table in ``docs/scene.md``.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from polysft_mi.errors import InputError

AUTO = -1.0  # of a weight: what suits the template


def _setting(default, doc, **more):
    """A field; ``more``: its bounds or choices; ``auto``: whether :data:`AUTO` is accepted too;
    ``solver``: the only one that reads it.
    """
    usual = dict(choices=None, low=-math.inf, high=math.inf, above=None, auto=False, solver=None)
    assert set(more) <= set(usual)
    return field(default=default, metadata={"doc": doc, **usual, **more})


@dataclass(frozen=True)
class Settings:
    """Everything about an experiment but its files. The metadata of each field holds its meaning
    and its bounds.
    """

    preset: str = _setting(
        "none", "values of many settings at once; paper: the paper's", choices=("none", "paper")
    )
    first: int = _setting(0, "first image to use, counted from 0 in the sorted list", low=0)
    last: int = _setting(-1, "last image to use, inclusive; -1 for the end of the video", low=-1)
    stride: int = _setting(1, "use every stride-th image", low=1)
    fps: float = _setting(
        0.0,
        "frames a second of the images; comparison.mp4 and exports have that over stride; 0: not"
        " known, they have 15",
        low=0,
        high=1000,
    )
    tracks: str = _setting(
        "",
        "file of point tracks (.npz, as CoTracker, TAPIR, AllTracker have them), beside the scene;"
        " empty: none",
    )
    track_centre: float = _setting(
        0.5,
        "coordinate that the tracks give the centre of the first pixel: 0.5 or 0",
        low=0,
        high=1,
    )
    cameras: str = _setting(
        "",
        "folder of further cameras: of each a folder with camera.json (or a <sensor> of its name),"
        " frames and masks; empty: none",
    )
    depth: str = _setting(
        "",
        "folder of depth images, one a frame: 16 bit PNG, or EXR in metres; 0 is unknown; empty:"
        " none",
    )
    depth_unit: float = _setting(
        0.001, "metres that a whole number of a depth image stands for", above=0
    )
    depth_known_to: str = _setting(
        "metric",
        "what depth is known up to: nothing (metric); a scale and a shift, of depth (affine) or of"
        " its inverse (disparity), as networks guess it",
        choices=("metric", "affine", "disparity"),
    )
    body: str = _setting(
        "",
        "file of a body's motion (.npz: poses, translation; or vertices, faces), or a folder of its"
        " meshes, in whose rest the template is given, and which carries it; empty: none",
    )
    body_model: str = _setting(
        "",
        "file of a body of SMPL's family (.npz or .pkl), whose motion it then is; empty: Anny's",
    )
    body_up: str = _setting(
        "z", "axis of the world that points up, where a body moves", choices=("z", "y", "-y")
    )
    order: int = _setting(
        0,
        "order n of the jets; 0: 8, or 5 where the template has several patches, or less if the"
        " template has too few vertices",
        low=0,
        high=10,
    )
    patches: int = _setting(
        0,
        "jets that hold the template; 0: as few as can; 1: one (refused where the template is no"
        " height graph)",
        low=0,
        high=1,
    )
    canonical_frame: str = _setting(
        "pca",
        "frame of a single jet: by principal components, or from there by the trained spatial"
        " transformer (needs the extra learn)",
        choices=("pca", "stn"),
    )
    k_rgb: float = _setting(1.0, "weight of the photometric loss", low=0)
    k_silhouette: float = _setting(
        AUTO,
        "weight of the silhouette loss (needs masks); -1: 0.1, for masks are ragged, or 1 where the"
        " template has several patches: an outline shows a bend that no texture shows",
        low=0,
        auto=True,
    )
    k_shading: float = _setting(
        9.0,
        "weight of shading: the triangles' brightness under a light that is learned along with the"
        " video; 0: off",
        low=0,
    )
    k_chroma: float = _setting(
        9.0,
        "weight of chromaticity: the triangles' colours but for their brightness, which light does"
        " not change; 0: off",
        low=0,
    )
    k_cameras: float = _setting(1.0, "weight of the further cameras; 1: as the scene's own", low=0)
    k_tracks: float = _setting(
        1.0, "weight of the tracks; 1: as their noise, and the images', says", low=0
    )
    k_depth: float = _setting(
        1.0, "weight of the depth images; 1: as their noise, and the images', says", low=0
    )
    k_drape: float = _setting(
        1.0, "weight of the drape on a body; 1: as its error, and the images', says", low=0
    )
    k_pose: float = _setting(
        1.0, "weight of a body's poses as given; 1: as their error, and the images', says", low=0
    )
    k_mi: float = _setting(
        AUTO,
        "weight of mesh inextensibility; -1: 100, or 30 where the template has several patches: a"
        " sheet bends and keeps its lengths, a closed surface cannot",
        low=0,
        auto=True,
    )
    k_volume: float = _setting(
        0.0,
        "weight of the squared relative change of the volume within a closed template",
        low=0,
    )
    k_tc: float = _setting(5e-5, "weight of temporal consistency", low=0)
    k_bend: float = _setting(1e-6, "weight of the jets' mean squared second derivatives", low=0)
    k_coupling: float = _setting(
        1.0,
        "weight of the squared distances of overlapping patches, over the template's radius",
        low=0,
    )
    k_uv: float = _setting(1e-4, "weight of the differences of neighbours' uv displacements", low=0)
    k_relief: float = _setting(
        AUTO,
        "weight of the slopes of the relief, the vertices' heights over the jet; its bending has a"
        " few thousandths of this weight (templates of at most 3,000 vertices); 0: no relief; -1:"
        " 0.001, or 0.0001 where the template has several patches, whose jets leave it more of a"
        " bend",
        low=0,
        auto=True,
        solver="gauss-newton",
    )
    rgb_norm: str = _setting(
        "cauchy",
        "norm of the photometric residual; phi-sft: the absolute difference of each channel of the"
        " colours as sRGB, a mean over all pixels of the image, as in φ-SfT's program",
        choices=("cauchy", "l1", "l2", "charbonnier", "phi-sft"),
    )
    rgb_scale: float = _setting(
        0.3,
        "residual at which the norms cauchy and charbonnier turn robust, in local deviations with"
        " brightness = local; of cauchy in the first frame, later it follows the residuals",
        above=0,
    )
    silhouette_norm: str = _setting(
        "l2",
        "norm of the masks' difference; phi-sft: the absolute difference, a mean over all pixels of"
        " the image",
        choices=("l2", "phi-sft"),
    )
    mask_blur: float = _setting(
        0.0,
        "standard deviation of the Gaussian blur of both masks before they are compared [pixels]",
        low=0,
        high=100,
    )
    rgb_region: str = _setting(
        "sheet",
        "pixels that are compared: those that the sheet and the mask both fill, or the whole image,"
        " the sheet over black and the frame cut out by its mask",
        choices=("sheet", "image"),
    )
    brightness: str = _setting(
        "local",
        "lighting compensation before images are compared: local means and deviations are taken"
        " out, one gain is, or nothing",
        choices=("local", "gain", "none"),
    )
    mi_norm: str = _setting(
        "charbonnier",
        "norm of an edge's stretch: charbonnier lets cloth give where it hangs from a point, and on"
        " a body where it folds",
        choices=("charbonnier", "l2"),
    )
    tc_basis: str = _setting(
        "legendre",
        "basis in which temporal consistency measures coefficients",
        choices=("legendre", "monomial"),
    )
    tc_ties: str = _setting(
        "before",
        "what ties the first frame of a window: the frame before it, or nothing",
        choices=("before", "window"),
    )
    texture_fit: str = _setting(
        "auto",
        "auto: moves the texture on the template if the first image shows it elsewhere",
        choices=("auto", "none"),
    )
    blur: float = _setting(
        AUTO,
        "standard deviation of the Gaussian blur of both images before they are compared [pixels];"
        " -1: coarse to fine, in three stages, by the size of the sheet",
        low=0,
        high=100,
        auto=True,
    )
    starts: str = _setting(
        "auto",
        "where a frame begins: auto also tries where the motion leads and, where that does not"
        " explain the image, farther away and at the pose that features tell (where all terms have"
        " a quadratic model); previous: at the frame before, all frames of a window together",
        choices=("auto", "previous"),
    )
    spp: int = _setting(
        0,
        "samples a pixel; raster takes square numbers (1, 4, 9, ...); 0: 1 by raster, 4 by path"
        " replay",
        low=0,
        solver="adam",
    )
    sppi: int = _setting(
        0,
        "samples a pixel of edges that are met indirectly, by path replay: 0 gives shadows and"
        " reflections that move no gradient, and takes a tenth of the time",
        low=0,
        solver="adam",
    )
    seed: int = _setting(
        0, "seed of the renderer's random numbers (path replay)", low=0, solver="adam"
    )
    solver: str = _setting(
        "auto",
        "solver of each window; auto: gauss-newton where each term has a quadratic model, else"
        " adam",
        choices=("auto", "gauss-newton", "adam"),
    )
    window: int = _setting(1, "frames W of the sliding window, solved together", low=1)
    smooth: float = _setting(
        0.0,
        "weight that holds each frame to the mean of its neighbours, in a last pass over the video,"
        " back and forth; 0: no such pass",
        low=0,
    )
    sweeps: int = _setting(
        0,
        "how often the tracked video is gone over again, backward and then forward: each frame is"
        " solved anew from its neighbour's surface, and the surface of the lower cost is kept",
        low=0,
    )
    patience: int = _setting(
        100,
        "iterations of adam without improvement after which the window moves on",
        low=1,
        solver="adam",
    )
    period: int = _setting(
        500, "largest number of iterations of adam in a window", low=1, solver="adam"
    )
    lr_uv: float = _setting(1e-3, "Adam's step size of the displacements", low=0, solver="adam")
    lr_alpha: float = _setting(
        1e-2, "Adam's step size of the jet coefficients", low=0, solver="adam"
    )
    lr_rigid: float = _setting(
        1e-4, "Adam's step size of rotation and translation", low=0, solver="adam"
    )

    @property
    def rate(self) -> float:
        """Frames a second of the images that are used."""
        return self.fps / self.stride if self.fps else 15.0

    @property
    def compares_triangles(self) -> bool:
        """Whether triangles are compared by their colours."""
        return self.k_shading > 0 or self.k_chroma > 0

    def jet_order(self, patches: int) -> int:
        """The order of the jets of so many patches, where the template's vertices determine it."""
        return self.order or (8 if patches == 1 else 5)

    def for_patches(self, patches: int) -> Settings:
        """The same, with what is left to the template's number of patches decided."""
        values = {"k_silhouette": (0.1, 1.0), "k_mi": (100.0, 30.0), "k_relief": (1e-3, 1e-4)}
        decided: dict[str, Any] = {
            name: value[patches > 1]
            for name, value in values.items()
            if getattr(self, name) == AUTO
        }
        return dataclasses.replace(self, **decided)

    def check_read(self, solver: str, where: str) -> None:
        """Raise InputError where a value that is not the default, nor a weight of 0, is for another
        solver; ``where``: the scene's path.
        """
        for f in dataclasses.fields(self):
            value, reader = getattr(self, f.name), f.metadata["solver"]
            off = f.name.startswith("k_") and value == 0
            if reader not in (None, solver) and value != f.default and not off:
                raise InputError(
                    f"{where}: setting {f.name} = {value:g} is read by solver = {reader} alone, and"
                    f" this is {solver}; leave it at {f.default:g}, or take solver = {reader}"
                )

    def __post_init__(self):
        for f in dataclasses.fields(self):
            value, meta = getattr(self, f.name), f.metadata
            if meta["choices"] and value not in meta["choices"]:
                raise InputError(
                    f"setting {f.name} = {value!r}; known values: {', '.join(meta['choices'])}"
                )
            if f.type in ("int", "float", int, float):
                inside = math.isfinite(value) and meta["low"] <= value <= meta["high"]
                inside |= meta["auto"] and value == AUTO
                if not inside or (meta["above"] is not None and value <= meta["above"]):
                    raise InputError(
                        f"setting {f.name} = {value!r}; {_NOUN[_type_name(f)]}, {_accepted(meta)},"
                        " is needed"
                    )


#: what the presets set; what the paper leaves open stands in docs/conventions.md
PRESETS: dict[str, dict[str, object]] = {
    "none": {},
    "paper": {
        "solver": "adam",
        "order": 4,
        "patches": 1,
        "canonical_frame": "stn",
        "window": 3,
        "patience": 100,
        "period": 500,
        "lr_uv": 1e-3,
        "lr_alpha": 1e-2,
        "lr_rigid": 1e-4,
        "k_rgb": 1.0,
        "k_silhouette": 0.5,
        "k_mi": 0.1,
        "k_tc": 0.05,
        **dict.fromkeys(
            ("k_shading", "k_chroma", "k_volume", "k_bend", "k_coupling", "k_uv", "k_relief"), 0.0
        ),
        "rgb_norm": "phi-sft",
        "rgb_region": "image",
        "silhouette_norm": "phi-sft",
        "mask_blur": 5.0,
        "brightness": "none",
        "mi_norm": "l2",
        "tc_basis": "monomial",
        "tc_ties": "window",
        "cameras": "",
        "tracks": "",
        "depth": "",
        "body": "",
        "texture_fit": "none",
        "blur": 0.0,
        "starts": "previous",
        "spp": 0,
        "sppi": 0,
        "smooth": 0.0,
        "sweeps": 0,
    },
}

_NOUN = {"int": "a whole number", "float": "a finite number", "str": "a text"}
_XML_TYPE = {"int": "integer", "float": "float", "str": "string"}


def _type_name(f):
    return f.type if isinstance(f.type, str) else f.type.__name__


def defaults_xml(indent="    ", **overrides):
    """One ``<default>`` line a setting, with ``overrides`` in place of the defaults."""
    settings = Settings(**overrides)
    return "\n".join(
        f'{indent}<default name="{f.name}" value="{getattr(settings, f.name)}"/>'
        for f in dataclasses.fields(Settings)
    )


def properties_xml(indent="        "):
    """One property line a setting, each reading the default of its name."""
    return "\n".join(
        f'{indent}<{_XML_TYPE[_type_name(f)]} name="{f.name}" value="${f.name}"/>'
        for f in dataclasses.fields(Settings)
    )


def from_properties(props):
    """Settings from a plugin's properties, or from texts (a mapping); what is not given keeps its
    default.
    """
    values = {}
    for f in dataclasses.fields(Settings):
        if f.name in props:
            value = props[f.name]
            kind = {"int": int, "float": float, "str": str}[_type_name(f)]
            if kind is int and isinstance(value, float) and value != int(value):
                raise InputError(f"setting {f.name} = {value!r}; {_NOUN['int']} is needed")
            try:
                values[f.name] = kind(value)
            except (TypeError, ValueError):
                raise InputError(
                    f"setting {f.name} = {value!r}; {_NOUN[_type_name(f)]} is needed"
                ) from None
    return Settings(**values)


def table():
    """All settings as a Markdown table."""
    rows = ["| setting | type | default | accepted | meaning |", "|---|---|---|---|---|"]
    for f in dataclasses.fields(Settings):
        rows.append(
            f"| `{f.name}` | {_type_name(f)} | `{f.default}` | {_accepted(f.metadata)} |"
            f" {f.metadata['doc']} |"
        )
    return "\n".join(rows)


def _accepted(meta):
    if meta["choices"]:
        return ", ".join(f"`{c}`" for c in meta["choices"])
    if meta["above"] is not None:
        return f"above {meta['above']}"
    if math.isinf(meta["high"]):
        found = f"at least {meta['low']}" if math.isfinite(meta["low"]) else "any"
    else:
        found = f"{meta['low']} to {meta['high']}"
    return f"{found}, or -1" if meta["auto"] else found


if __name__ == "__main__":
    print(table())
