"""What a batch consists of: jobs, each a command with a folder of its own."""

from __future__ import annotations

import itertools
import json
import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from polysft_mi.errors import InputError


@dataclass(frozen=True)
class Job:
    """``name``: unique in the batch; ``kind``: "run" or "drape"; ``arguments``: of the command, but
    those for its folder; ``folder``: that folder; ``log``: where what it prints goes.
    """

    name: str
    kind: str
    arguments: tuple[str, ...]
    folder: Path
    log: Path

    def command(self) -> list[str]:
        """The command line that begins the job, or goes on with what was broken off."""
        module = {"run": "polysft_mi.run", "drape": "onefit.drape"}[self.kind]
        again = ["--resume"] if (self.folder / "run.json").exists() else []
        return [sys.executable, "-m", module, *self.arguments, "-o", str(self.folder), *again]

    def done(self) -> bool:
        """Whether the folder holds all frames."""
        if self.kind == "drape":
            return (self.folder / "figures.json").exists()  # the folder appears when it is whole
        figures = read_json(self.folder / "metrics.json")
        return bool(figures) and figures["frames"] == figures["frames_wanted"]


def runs(scenes: Sequence[str], options: Sequence[str], out: Path) -> list[Job]:
    """A job for each scene: files as they are, of a folder every ``scene.xml`` in it or below, or
    else its ``.xml`` files; folders of runs are left out. Raises InputError.
    """
    found: list[Path] = []
    for text in scenes:
        place = Path(text)
        if place.is_dir():
            inside = sorted(place.rglob("scene.xml")) or sorted(place.glob("*.xml"))
            inside = [p for p in inside if not (p.parent / "run.json").exists()]
            if not inside:
                raise InputError(f"{text}: no scene.xml in this folder or below it")
            found += inside
        elif place.is_file():
            found.append(place)
        else:
            raise InputError(f"{text}: no such file or folder; scenes are needed")
    paths = list(dict.fromkeys(p.resolve() for p in found))
    return [
        Job(name, "run", (str(path), *options), out / name, out / f"{name}.log")
        for name, path in zip(_names(paths), paths)
    ]


def drapes(
    garments: Sequence[str], motions: Sequence[str], options: Sequence[str], out: Path
) -> list[Job]:
    """A job for each garment in each motion, named as onefit.drape takes them. Raises
    InputError.
    """
    pairs = list(itertools.product(dict.fromkeys(garments), dict.fromkeys(motions)))
    names = [f"{_plain(Path(g).stem)}-{_plain(Path(m).stem)}" for g, m in pairs]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"two garments or motions have the same name: {twice[0]}")
    return [
        Job(name, "drape", (g, m, *options), out / name, out / f"{name}.log")
        for name, (g, m) in zip(names, pairs)
    ]


def read_json(path: Path) -> dict:
    """The object in a file; an empty one where there is none, or half of one."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _names(paths):
    """A short name for each path: of its last parts, as few as tell the paths apart."""
    parts = [
        [_plain(p) for p in (path.parent.parts[1:] if path.stem == "scene" else path.parts[1:-1])]
        + ([] if path.stem == "scene" else [_plain(path.stem)])
        for path in paths
    ]
    for count in range(1, 1 + max(map(len, parts))):
        names = ["-".join(p[-count:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    raise InputError(f"scenes that cannot be told apart by their paths: {paths[0]}")


def _plain(text):
    return re.sub(r"[^\w.+]+", "_", text).strip("_") or "scene"
