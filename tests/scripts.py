"""Scripts of the repository that are no modules of a package, as modules."""

import importlib.util
import sys
from pathlib import Path

from places import ROOT


def load(path):
    """The script at ``path``, counted from the repository's root, as a module."""
    name = "script_" + Path(path).stem
    spec = importlib.util.spec_from_file_location(name, ROOT / path)
    module = sys.modules[name] = importlib.util.module_from_spec(
        spec
    )  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module
