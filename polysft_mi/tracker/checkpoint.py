"""The state of a run, and its file."""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from polyfit.files import aside
from polysft_mi.errors import InputError
from polysft_mi.images import Light
from polysft_mi.objective import FrameMemory, Stage
from polysft_mi.scene import Rules
from polysft_mi.surface import Unknowns

CHECKPOINT = "checkpoint.npz"
# of a memory
_NUMBERS = ("misfit", "outlier_share", "least_misfit", "explained", "nat", "colours", "bold")
_BRANCHES = ("other", "again")  # tracks of a track


@dataclass
class Track:
    """The state of a run: unknowns of the frames reached so far, and what each window took.

    ``states``: one dict of arrays (:meth:`Unknowns.to_numpy`) a frame; ``next_window``: first frame
    of the next window to solve; ``iterations``, ``seconds``: one entry a solved window; ``totals``:
    its terms at the minimum; ``memories``: what its newest frame tells those that follow, None
    where it was lost; ``lost``: frame -> reason for those that keep the state of the frame before;
    ``unusable``: those among them whose image breaks the objective; ``certainty``: frame ->
    standard deviation of each vertex along its ray and its score, (2, N) [m], where they are known;
    ``swept``: frames gone over by the setting ``sweeps``, each as often as it was; ``finished``:
    whether the tracker has looked back over the whole; ``solver``: its name.

    ``other``: a second track that explains the frames from ``fork`` on about as well, or None;
    ``mirror_at``: the frame from which on one is looked for; ``rim_at``: the one from which on the
    rim is tried again.

    ``again``: a second pass over the video that is under way, or None; ``second``: what became of
    it, "kept" or "dropped"; empty where there was none.
    """

    states: list = field(default_factory=list)
    next_window: int = 0
    iterations: list = field(default_factory=list)
    seconds: list = field(default_factory=list)
    totals: list = field(default_factory=list)
    memories: list = field(default_factory=list)
    lost: dict = field(default_factory=dict)
    unusable: dict = field(default_factory=dict)
    certainty: dict = field(default_factory=dict)
    swept: int = 0
    finished: bool = False
    solver: str = ""
    fork: int = 0
    mirror_at: int = 1
    rim_at: int = 1
    other: Track | None = None
    again: Track | None = None
    second: str = ""

    def certainties(self, count: int) -> list[np.ndarray]:
        """``certainty`` of ``count`` vertices in all frames: sigma and score, (T, N) float32 [m],
        NaN where they are not known; none where no frame has them.
        """
        if not self.certainty:
            return []
        unknown = np.full((2, count), np.nan, np.float32)
        frames = [self.certainty.get(k, unknown) for k in range(len(self.states))]
        return list(np.stack(frames, axis=1))

    def save(self, path: str | os.PathLike[str], stages: Sequence[Stage]) -> None:
        """Write it; ``stages``: those that memories have robust scales of."""
        with aside(path) as temporary:
            np.savez(temporary, **self._arrays(stages))

    def _arrays(self, stages):
        arrays: dict[str, Any] = {
            name: np.stack([s[name] for s in self.states]) for name in Unknowns.NAMES
        }
        arrays["meta"] = json.dumps({k: getattr(self, k) for k in _META})
        known = sorted(self.certainty)
        if known:
            arrays["certain_frames"] = np.array(known, dtype=np.int64)
            arrays["certainty"] = np.stack([self.certainty[k] for k in known])
        for branch in _BRANCHES:
            if track := getattr(self, branch):
                arrays |= {f"{branch}_{name}": x for name, x in track._arrays(stages).items()}
        return arrays | _memory_arrays(self.memories, stages)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], stages: Sequence[Stage] = (), rules: Rules | None = None
    ) -> Track:
        """Read it; ``stages``: as they were saved, ``rules``: of the light. Without them memories
        are left out. Raises InputError where the file is no checkpoint.
        """
        try:
            with np.load(path) as data:
                return cls._of(dict(data), stages, rules)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(
                f"{path}: not a checkpoint of a run ({error}); start again with --overwrite"
            ) from None

    @classmethod
    def _of(cls, arrays, stages, rules):
        meta, branches = json.loads(str(arrays["meta"])), {}
        for branch in _BRANCHES:
            first = f"{branch}_"
            branches[branch] = {
                name.removeprefix(first): x for name, x in arrays.items() if name.startswith(first)
            }
        for name in ("lost", "unusable"):
            meta[name] = {int(k): v for k, v in meta[name].items()}
        certain = arrays.get("certain_frames", np.empty(0, np.int64)).tolist()
        return cls(
            states=[
                {name: arrays[name][k] for name in Unknowns.NAMES}
                for k in range(len(arrays["rotation"]))
            ],
            certainty=dict(zip(certain, arrays.get("certainty", ()))),
            memories=_memories(arrays, stages, rules or Rules()),
            **{name: cls._of(found, stages, rules) for name, found in branches.items() if found},
            **meta,
        )


_META = "next_window iterations seconds totals lost unusable swept finished solver".split()
_META += ["fork", "mirror_at", "rim_at", "second"]


def _memory_arrays(memories, stages):
    """Memories as float64 arrays of a row each, NaN where nothing is known."""
    rows: dict[str, Any] = {f"memory_{name}": [] for name in (*_NUMBERS, "scales", "light")}
    kinds = sorted({kind for memory in memories if memory for kind in memory.noises})
    rows |= {f"memory_noise_{kind}": [] for kind in kinds}
    size = len(Light.unknown(Rules()).numbers())
    for memory in memories:
        known = memory or FrameMemory(explained=math.nan)
        for name in _NUMBERS:
            rows[f"memory_{name}"].append(getattr(known, name))
        scales = [known.scales.get(stage, math.nan) for stage in stages]
        rows["memory_scales"].append(scales)
        for kind in kinds:
            rows[f"memory_noise_{kind}"].append(known.noises.get(kind, math.nan))
        light = known.light.numbers() if known.light else [math.nan] * size
        rows["memory_light"].append(light)
    return {name: np.array(row, dtype=np.float64) for name, row in rows.items()}


def _memories(data, stages, rules):
    found, prefix = [], "memory_noise_"
    kinds = [name.removeprefix(prefix) for name in data if name.startswith(prefix)]
    for k, explained in enumerate(data["memory_explained"]):
        if math.isnan(explained):
            found.append(None)
            continue
        numbers = {name: float(data[f"memory_{name}"][k]) for name in _NUMBERS}
        numbers["bold"] = bool(numbers["bold"])
        noises = {kind: float(data[f"memory_noise_{kind}"][k]) for kind in kinds}
        light, scales = data["memory_light"][k].tolist(), data["memory_scales"][k].tolist()
        found.append(
            FrameMemory(
                **numbers,
                light=None if math.isnan(light[-1]) else Light.of(light, rules),
                scales={s: x for s, x in zip(stages, scales) if not math.isnan(x)},
                noises={kind: x for kind, x in noises.items() if not math.isnan(x)},
            )
        )
    return found
