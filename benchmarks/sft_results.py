"""The results of ``sft.py``: what identifies one, and the file ``sft.json`` that keeps them.

A result is a dict: sequence, method, setup, figures, seconds.
"""

import json
import os

from polyfit.files import aside
from polysft_mi.errors import InputError

SIMULATED = ("roll", "pillow", "skirt")  # by benchmarks/simulate.py
SEQUENCES = (
    *("flag", "bend", "paper", "curtain", "corner", "hand", "poster"),
    *("ball", "shirt", "tube", *SIMULATED),  # no sheets
    *("kinect_paper", "phi_sft_R1"),
)
METHODS = ("gauss-newton", "adam", "adam-reweighted", "per-vertex")
JET = "best jet"  # the method of a result that no command made: the jet nearest to the truth


def read(path):
    """The results in ``sft.json``, a list; empty where there is no such file."""
    if not os.path.exists(path):
        return []
    try:
        with open(path, encoding="utf-8") as file:
            return json.load(file)["results"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a file of results ({error}); remove it") from None


def add(path, result):
    """Write a result into the file, in place of an earlier one of the same sequence, method, order
    (of a best jet) and setup.
    """
    mine = identity(result)
    kept = [other for other in read(path) if identity(other) != mine]
    with aside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        json.dump({"results": [*kept, result]}, file, indent=1, default=float)
        file.write("\n")


def identity(result):
    """What no two results in the file share: sequence, method, order (of a best jet), setup."""
    return (
        result["sequence"],
        result["method"],
        result["orders"][1] if result["method"] == JET else None,
        result["setup"],
    )


def find(results, sequence, method, setup, order=None):
    """The good result of one sequence, method and setup, or None."""
    wanted = (sequence, method, order, setup)
    return next((r for r in results if identity(r) == wanted and "error" not in r), None)
