"""Where the repository, its scenes, and the sequences that are not in it lie."""

import os

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
SCENES = os.path.join(ROOT, "scenes")
# Simulated surfaces that are no sheet (benchmarks/simulate.py) have no scene of their own
_SCENE_OF = {"skirt": "tube", "pillow": "tube", "roll": "tube", "pushed": "bend"}
DATA = os.environ.get("POLYSFT_DATA") or os.path.join(os.path.dirname(ROOT), "shared", "data")


def scene_of(sequence):
    """The path of the scene file of a sequence."""
    return os.path.join(SCENES, f"{_SCENE_OF.get(sequence, sequence)}.xml")


def folder_of(data, sequence):
    """The folder of a sequence in ``data`` or one folder further down; None where there is none."""
    places = (
        [data] + sorted(entry.path for entry in os.scandir(data) if entry.is_dir())
        if os.path.isdir(data)
        else []
    )
    return next(
        (
            path
            for path in (os.path.join(place, sequence) for place in places)
            if os.path.isdir(path)
        ),
        None,
    )
