"""The scripts beside the packages say what they are for."""

import pytest
from places import ROOT
from processes import python

_EACH = """
import runpy, sys
from pathlib import Path

found = sys.path.copy()
for path in sys.argv[1:]:
    sys.path[:], sys.argv = [str(Path(path).parent), *found], [path, "--help"]
    try:
        runpy.run_path(path, run_name="__main__")
    except SystemExit as end:
        assert not end.code, (path, end.code)
    else:
        raise AssertionError(f"{path}: ran")
"""


@pytest.mark.slow  # what the scripts import takes seconds
def test_help_is_all_that_a_script_does_where_it_is_asked_for():
    """In one process, for what they import takes seconds."""
    folders = ("docs", "benchmarks", "examples", "scenes")
    scripts = [p for name in folders for p in sorted((ROOT / name).glob("*.py"))]
    scripts = [p for p in scripts if '__name__ == "__main__"' in p.read_text(encoding="utf-8")]
    done = python("-c", _EACH, *scripts)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("usage: ") == len(scripts) > 40
