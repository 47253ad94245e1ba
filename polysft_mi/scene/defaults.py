"""The ``<default>``s of a scene file, and where its paths lead. Needs no Mitsuba, so that a wrong
name is told at once.
"""

import dataclasses
import difflib
import os
import re
import xml.etree.ElementTree as ET

from polysft_mi.errors import InputError

from . import settings

_NAMES = {f.name for f in dataclasses.fields(settings.Settings)}


def known_defaults(path):
    """Name to value of every ``<default>`` of a scene file. Raises InputError where the file is
    missing or not XML, and for a default that nothing in it uses: its name is misspelt.
    """
    if not os.path.isfile(path):
        inside = os.path.join(path, "scene.xml")
        hint = f"; {inside} is one" if os.path.isfile(inside) else ""
        raise InputError(f"{path}: no such scene file{hint}")
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, ValueError, LookupError) as error:  # the latter two: encodings
        raise InputError(f"{path}: not a readable XML scene: {error}") from None
    known = {e.get("name"): e.get("value") for e in root.iter("default") if e.get("name")}
    values = " ".join(value for e in root.iter() for value in e.attrib.values())
    for name in known if root.find(".//include") is None else ():
        used = re.search(rf"\${re.escape(name)}(?![A-Za-z0-9_])", values)
        near = "" if used or name in _NAMES else _near(name, _NAMES - set(known))
        if near:
            raise InputError(f"{path}: <default name={name!r}>: nothing in it uses ${name}{near}")
    return known


def _near(name, names):
    near = difflib.get_close_matches(name, names, 1)
    return f", did you mean {near[0]}?" if near else ""


def resolved_defaults(path, overrides):
    """The defaults of a scene file with a preset and ``overrides`` (name to text) in force: a
    preset wins over the scene's own values, ``overrides`` over it. Raises InputError for a name
    that the file does not have, and for a value that its setting does not take (Mitsuba reads an
    empty number as 0)."""
    known = known_defaults(path)
    for name in overrides:
        if name not in known:
            raise InputError(
                f"-D {name}: {path} has no such setting{_near(name, known)}; known:"
                f" {', '.join(sorted(known)) or 'none'}"
            )
    preset = {**known, **overrides}.get("preset") or "none"
    if preset not in settings.PRESETS:
        raise InputError(
            f"{path}: setting preset = {preset!r}; known values: {', '.join(settings.PRESETS)}"
        )
    chosen = {name: str(value) for name, value in settings.PRESETS[preset].items()}
    if missing := sorted(set(chosen) - set(known)):
        raise InputError(
            f"{path}: preset = {preset} sets {missing[0]}, which the scene has no <default> of;"
            " write the scene again with polysft prepare"
        )
    resolved = {**known, **chosen, **overrides}
    try:
        settings.from_properties(
            {name: text for name, text in resolved.items() if text is not None and "$" not in text}
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return resolved


def located(scene, path):
    """A path of a scene file, found as Mitsuba finds it: beside the scene, else from the working
    directory.
    """
    path = path.removeprefix("./")
    beside = os.path.join(os.path.dirname(os.path.abspath(scene)), path)
    return os.path.abspath(path) if not os.path.exists(beside) and os.path.exists(path) else beside
