"""The interactive viewer: what it draws, and its one line where it cannot."""

import os
import sys

import cv2
import numpy as np
import pytest
from processes import python

from polysft_mi import view
from polysft_mi.errors import InputError

SCRIPT = """
import sys
import polyscope
from polysft_mi.errors import cli
from polysft_mi.pictures import viewer
from polysft_mi.results import Run

def main():
    window = viewer.Viewer(Run.open(sys.argv[1]), viewer._polyscope(True))
    for k in (0, 3):
        window.show(k)
        polyscope.screenshot(f"{sys.argv[2]}/{k}.png", transparent_bg=False)

cli(main)
"""


def test_draws_the_textured_surface_of_a_frame(finished_run, tmp_path):
    """In a process of its own, without a display."""
    pytest.importorskip("polyscope", reason="polyscope is not installed (the extra 'view')")
    done = python("-c", SCRIPT, finished_run[1], tmp_path)
    if "cannot open a window" in done.stderr:
        pytest.skip("polyscope finds no OpenGL here (EGL, or a display)")
    assert done.returncode == 0, done.stderr
    first, last = (cv2.imread(str(tmp_path / f"{k}.png")).astype(int) for k in (0, 3))
    assert (np.ptp(first, axis=2) > 40).mean() > 0.05
    assert (np.abs(first - last).max(2) > 40).mean() > 0.01


def test_one_line_where_there_is_no_display_or_no_polyscope(finished_run, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if sys.platform.startswith("linux"):
        with pytest.raises(InputError, match="no display"):
            view.main([str(finished_run[1])])
    monkeypatch.setitem(sys.modules, "polyscope", None)
    with pytest.raises(InputError, match=r"polyscope is not installed.*\[view\]"):
        view.main([str(finished_run[1]), "--screenshot", "a.png"])
    assert not os.path.exists("a.png")


def test_refusals(finished_run, tmp_path):
    for arguments, words in [
        ([tmp_path], "not the folder of a run"),
        ([finished_run[1], "--frame", "9"], "frames 0 to 3"),
        ([finished_run[1], "--screenshot", "a.jpg"], "a .png file"),
    ]:
        with pytest.raises(InputError, match=words):
            view.main([str(a) for a in arguments])
