"""The settings of an experiment: names, types, defaults and meanings, in one place.

A scene file carries each of them as a ``<default>`` and hands it to the ``polysft`` plugin; ``-D
name=value`` overrides it. ``python -m polysft_mi.scene.settings`` prints them as the table in
``docs/scene.md``.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

from polysft_mi.errors import InputError


def _setting(default, doc, *, choices=None, low=-math.inf, high=math.inf, above=None):
    return field(
        default=default,
        metadata={"doc": doc, "choices": choices, "low": low, "high": high, "above": above},
    )


@dataclass(frozen=True)
class Settings:
    """Everything about an experiment but its files. The metadata of each field holds its meaning
    and its bounds.
    """

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
    order: int = _setting(
        0,
        "order n of the jets; 0: 8 for gauss-newton, 5 where the template has several patches, 4"
        " (the paper's) for adam, or less if the template has too few vertices",
        low=0,
        high=10,
    )
    k_rgb: float = _setting(1.0, "weight of the photometric loss", low=0)
    k_silhouette: float = _setting(1.0, "weight of the silhouette loss (needs masks)", low=0)
    k_shading: float = _setting(
        9.0,
        "weight of shading: the triangles' brightness under a light that is learned along with the"
        " video (gauss-newton); 0: off",
        low=0,
    )
    k_mi: float = _setting(0.1, "weight of mesh inextensibility", low=0)
    k_volume: float = _setting(
        0.0,
        "weight of the squared relative change of the volume within a closed template; counts as"
        " inextensibility",
        low=0,
    )
    k_tc: float = _setting(0.05, "weight of temporal consistency", low=0)
    k_bend: float = _setting(
        1e-6, "weight of the jet's mean squared second derivatives (gauss-newton)", low=0
    )
    k_uv: float = _setting(
        1e-4, "weight of the differences of neighbours' uv displacements (gauss-newton)", low=0
    )
    k_relief: float = _setting(
        1e-3,
        "weight of the slopes of the relief, the vertices' heights over the jet; its bending has a"
        " few thousandths of this weight (gauss-newton, templates of at most 3,000 vertices); 0: no"
        " relief",
        low=0,
    )
    rgb_norm: str = _setting(
        "l1", "norm of the photometric residual", choices=("l1", "l2", "charbonnier")
    )
    rgb_scale: float = _setting(
        0.1, "residual at which the Charbonnier norm turns from quadratic to linear", above=0
    )
    brightness: str = _setting(
        "auto",
        "lighting compensation before images are compared; auto: local for gauss-newton, none"
        " for adam",
        choices=("auto", "none", "gain", "local"),
    )
    texture_fit: str = _setting(
        "auto",
        "auto: gauss-newton moves the texture on the template if the first image shows it"
        " elsewhere",
        choices=("auto", "none"),
    )
    blur: float = _setting(
        0.0,
        "standard deviation of the Gaussian blur of both images before they are compared [pixels]",
        low=0,
    )
    spp: int = _setting(1, "samples a pixel; raster takes square numbers (1, 4, 9, ...)", low=1)
    seed: int = _setting(0, "seed of the renderer's random numbers (path replay)", low=0)
    solver: str = _setting(
        "gauss-newton", "solver of each window", choices=("gauss-newton", "adam")
    )
    window: int = _setting(
        0,
        "frames W of the sliding window, solved together; 0: 1 for gauss-newton, 3 for adam",
        low=0,
    )
    smooth: float = _setting(
        0.0,
        "weight that holds each frame to the mean of its neighbours, in a last pass over the video,"
        " back and forth (gauss-newton); 0: no such pass",
        low=0,
    )
    sweeps: int = _setting(
        0,
        "how often the tracked video is gone over again, backward and then forward: each frame is"
        " solved anew from its neighbour's surface, and the surface of the lower cost is kept"
        " (gauss-newton)",
        low=0,
    )
    patience: int = _setting(
        100, "iterations of adam without improvement after which the window moves on", low=1
    )
    period: int = _setting(500, "largest number of iterations of adam in a window", low=1)
    lr_uv: float = _setting(1e-3, "Adam's step size of the uv displacements", low=0)
    lr_alpha: float = _setting(1e-2, "Adam's step size of the jet coefficients", low=0)
    lr_rigid: float = _setting(1e-4, "Adam's step size of rotation and translation", low=0)

    @property
    def rate(self) -> float:
        """Frames a second of the images that are used."""
        return self.fps / self.stride if self.fps else 15.0

    @property
    def width(self) -> int:
        """Frames that are solved together."""
        return self.window or {"gauss-newton": 1, "adam": 3}[self.solver]

    @property
    def lighting(self) -> str:
        """The compensation of lighting: none, gain or local."""
        return (
            self.brightness
            if self.brightness != "auto"
            else {"gauss-newton": "local", "adam": "none"}[self.solver]
        )

    def jet_order(self, patches: int) -> int:
        """The order of the jets of so many patches, where the template's vertices determine it."""
        return self.order or (4 if self.solver == "adam" else 8 if patches == 1 else 5)

    def __post_init__(self):
        for f in dataclasses.fields(self):
            value, meta = getattr(self, f.name), f.metadata
            if meta["choices"] and value not in meta["choices"]:
                raise InputError(
                    f"setting {f.name} = {value!r}; known values: {', '.join(meta['choices'])}"
                )
            if f.type in ("int", "float", int, float):
                inside = math.isfinite(value) and meta["low"] <= value <= meta["high"]
                if not inside or (meta["above"] is not None and value <= meta["above"]):
                    raise InputError(
                        f"setting {f.name} = {value!r}; {_NOUN[_type_name(f)]}, {_accepted(meta)},"
                        " is needed"
                    )


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
        return f"at least {meta['low']}" if math.isfinite(meta["low"]) else "any"
    return f"{meta['low']} to {meta['high']}"


if __name__ == "__main__":
    print(table())
