"""A process that was forked from one that had rendered is refused: Dr.Jit would hang there."""

import os
import sys

import pytest
from processes import python

_FORK = """
import multiprocessing, os, sys
from polyfit import backend
from polyfit.errors import InputError

def child():
    try:
        print(backend.set_variant(), flush=True)
    except InputError as error:
        print(f"{error}", flush=True)

def forked():
    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join(50)
    process.kill()
"""
_RENDER = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(
    "before, refused",
    [
        ("", False),
        ("backend.set_variant()", False),  # nothing was computed, so there is nothing to miss
        ("backend.set_variant()" + _RENDER, True),
        (_RENDER, True),  # by one who did not know of us
    ],
)
def test_a_fork_of_a_process_that_has_rendered_is_refused(before, refused):
    """Where it is not, the next rendering would wait for ever."""
    if before == _RENDER and not sys.platform.startswith("linux"):
        pytest.skip("threads can be counted on Linux alone")
    done = python("-c", f"{_FORK}\n{before}\nforked()\nprint(backend.set_variant())")
    said, parents = done.stdout.splitlines()
    assert parents == "llvm_ad_rgb"
    assert said == "llvm_ad_rgb" if not refused else "forked from one that had rendered" in said
