"""Sewing patterns as GarmentCode and its datasets write them: ``*_specification.json`` (Korosteleva
and Lee 2021, "Generating Datasets of 3D Garments with Sewing Patterns"; Korosteleva and
Sorkine-Hornung 2023, "GarmentCode").

A pattern has panels, flat pieces of cloth, each a loop of edges and a place around the body; and
stitches, each of two edges that are sewn together. In the file y is up, and the body, which stands
on the ground, faces z; here all is metres in OneFit's axes.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from polyfit.errors import InputError
from polyfit.files import text_encoding

_FINE = 200  # parts of a curve, by which its length is measured
_LONGEST = 20.0  # [m] that an edge spans
_SUFFIX = "_specification"


@dataclass(frozen=True)
class Panel:
    """A piece of cloth: ``edges``, each a curve (n, 2) [m] in its plane, which begins where the one
    before ends; ``rotation`` (3, 3) and ``place`` (3,) [m] take the plane's points (x, y, 0) to the
    body.
    """

    name: str
    edges: tuple[np.ndarray, ...]
    rotation: np.ndarray
    place: np.ndarray

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Where points (n, 2) [m] of the panel lie around the body, (n, 3) [m]."""
        return points @ self.rotation[:, :2].T + self.place


@dataclass(frozen=True)
class Stitch:
    """Two edges that are sewn together, each the numbers of a panel and of its edge; ``along``:
    begin to begin and end to end, not, as where right side lies beside right side, end to begin.
    """

    one: tuple[int, int]
    two: tuple[int, int]
    along: bool


@dataclass(frozen=True)
class Pattern:
    """``panels`` and the ``stitches`` between them."""

    name: str
    panels: tuple[Panel, ...]
    stitches: tuple[Stitch, ...]


def read(path: str | os.PathLike[str]) -> Pattern:
    """The pattern of a file. Raises InputError, in one line that starts with its name."""
    try:
        with open(path, encoding=text_encoding(path)) as file:
            found = json.load(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: no JSON: {error}") from None
    name = os.path.splitext(os.path.basename(path))[0].removesuffix(_SUFFIX)
    return _pattern(name, found, str(path))


def _pattern(name, found, where):
    try:
        panels, stitches = found["pattern"]["panels"], found["pattern"]["stitches"]
        properties = found.get("properties", {})
        units = properties.get("units_in_meter", 100)
        relative = properties.get("curvature_coords", "relative") == "relative"
        items, pairs = list(panels.items()), list(stitches)
    except (KeyError, TypeError, AttributeError):
        raise InputError(
            f"{where}: no sewing pattern; GarmentCode's *_specification.json is needed, with"
            " 'pattern' of 'panels' and 'stitches'"
        ) from None
    if not items:
        raise InputError(f"{where}: no panels")
    if not isinstance(units, int | float) or not 0 < units < float("inf"):
        raise InputError(
            f"{where}: units_in_meter is {units!r}; a number above 0 is needed, 100 for centimetres"
        )
    scale = 1 / units
    made = tuple(_panel(n, panel, scale, relative, f"{where}: panel {n}") for n, panel in items)
    number = {n: k for k, (n, _) in enumerate(items)}
    return Pattern(name, made, tuple(_stitches(pairs, made, number, where)))


def _panel(name, panel, scale, relative, where):
    try:
        corners = np.array(panel["vertices"], dtype=float).reshape(-1, 2)
        angles = np.array(panel["rotation"], dtype=float).reshape(3)
        place = np.array(panel["translation"], dtype=float).reshape(3)
        edges = [([_whole(e) for e in edge["endpoints"]], edge) for edge in panel["edges"]]
        ends = np.array([e for e, _ in edges]).reshape(-1, 2)
        if ends.min() < 0:
            raise IndexError
        sides, bends = corners[ends], [edge.get("curvature") for _, edge in edges]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError):
        raise InputError(
            f"{where}: needs 'vertices' (x, y), 'edges' with two whole numbers of vertices as their"
            " 'endpoints', 'translation' and 'rotation'"
        ) from None
    curves = [
        _curve(*side, bend, relative, f"{where}: edge {k}")
        for k, (side, bend) in enumerate(zip(sides, bends))
    ]
    if not all(np.isfinite(x).all() for x in (corners, angles, place, *curves)):
        raise InputError(f"{where}: has numbers that are not finite")
    if len(ends) < 2 or (ends[:, 1] != np.roll(ends[:, 0], -1)).any():
        raise InputError(f"{where}: its edges are no loop: each begins where the last one ends")
    spans = [np.ptp(curve, axis=0).max() * scale for curve in curves]
    if min(spans) < 1e-4:
        raise InputError(f"{where}: an edge is shorter than 0.1 mm; units_in_meter may be wrong")
    if max(spans) > _LONGEST:
        raise InputError(
            f"{where}: edge {np.argmax(spans)} spans {max(spans):.3g} m, more than {_LONGEST:g};"
            " units_in_meter may be wrong, or its curvature"
        )
    up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up, z forward, to z up, -y forward
    rotation = up @ Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return Panel(name, tuple(scale * curve for curve in curves), rotation, scale * up @ place)


def _curve(start, end, bend, relative, where):
    """Points (n, 2) from ``start`` to ``end`` (2,)."""
    if bend is None:
        return np.stack([start, end])
    along = end - start
    try:
        kind = "quadratic" if isinstance(bend, list) else bend["type"]
        values = [bend] if isinstance(bend, list) else bend["params"]
        if kind == "circle":
            radius, large, right = (float(v) for v in values)
            return _arc(start, end, radius, bool(large), bool(right))
        controls = np.array(values, dtype=float).reshape({"quadratic": 1, "cubic": 2}[kind], 2)
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{where}: curvature {bend!r}; one of 'type' quadratic (1 point), cubic (2 points) or"
            " circle (radius, large arc, right) is needed, with 'params'"
        ) from None
    if relative:
        across = np.array([-along[1], along[0]])
        controls = start + controls[:, :1] * along + controls[:, 1:] * across
    return _bezier(np.stack([start, *controls, end]))


def _whole(value):
    """A whole number of the file. Raises ValueError for anything else."""
    if not isinstance(value, int | float) or not float(value).is_integer():
        raise ValueError
    return int(value)


def _bezier(controls):
    from scipy.special import comb

    n, t = len(controls) - 1, np.linspace(0, 1, _FINE + 1)[:, None]
    weights = [comb(n, k) * t**k * (1 - t) ** (n - k) for k in range(n + 1)]
    return sum(w * c for w, c in zip(weights, controls))


def _arc(start, end, radius, large, right):
    """On the ``right`` of the way from start to end it is walked with the angle, as SVG's sweep in
    axes whose y is up.
    """
    along = end - start
    chord = np.linalg.norm(along)
    radius = max(radius, chord / 2)  # as SVG has it
    half = np.arcsin(min(chord / 2 / radius, 1.0))
    half = np.pi - half if large else half
    turn = 1 if right else -1
    across = np.array([-along[1], along[0]]) / chord
    centre = (start + end) / 2 + turn * radius * np.cos(half) * across
    angle = turn * np.linspace(0, 2 * half, _FINE + 1)
    c, s = np.cos(angle), np.sin(angle)
    x, y = start - centre
    out = centre + np.stack([c * x - s * y, s * x + c * y], axis=1)
    out[0], out[-1] = start, end
    return out


def _stitches(pairs, panels, number, where):
    seen: set = set()
    for k, pair in enumerate(pairs):
        try:
            words = [s for s in pair if isinstance(s, str)]
            sides = [(number[s["panel"]], _whole(s["edge"])) for s in pair if s not in words]
            one, two = sides
        except (KeyError, TypeError, ValueError):
            raise InputError(
                f"{where}: stitch {k}: needs two sides, each with the 'panel' and 'edge' of one"
                " that there is"
            ) from None
        if wrong := [word for word in words if word != "right_wrong"]:
            raise InputError(
                f"{where}: stitch {k}: {wrong[0]!r} beside its sides; only 'right_wrong' is known"
            )
        for panel, edge in sides:
            if not 0 <= edge < len(panels[panel].edges):
                raise InputError(
                    f"{where}: stitch {k}: panel {panels[panel].name} has no edge {edge}; it has"
                    f" {len(panels[panel].edges)}, counted from 0"
                )
            if (panel, edge) in seen:
                raise InputError(
                    f"{where}: stitch {k}: edge {edge} of panel {panels[panel].name} is sewn twice"
                )
            seen.add((panel, edge))
        yield Stitch(one, two, "right_wrong" in words)
