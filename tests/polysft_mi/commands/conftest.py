"""A sound sequence and its run, for the tests of bad input."""

import shutil

import pytest
import synthetic
from refusals import QUICK, SIZE

from polysft_mi import capture, run


@pytest.fixture(scope="session")
def good(tmp_path_factory):
    """A sound sequence with its scene; not to be changed."""
    truth = synthetic.cloth(tmp_path_factory.mktemp("inputs") / "sheet", frames=3, size=SIZE)
    capture.prepare_folder(str(truth.folder))
    return truth


@pytest.fixture
def sheet(good, tmp_path):
    """A copy of it, to be spoilt."""
    folder = tmp_path / "sheet"
    shutil.copytree(good.folder, folder)
    return folder


@pytest.fixture(scope="session")
def finished(good, tmp_path_factory):
    """A small whole run; not to be changed."""
    out = tmp_path_factory.mktemp("finished") / "out"
    assert run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK]) == 0
    return out
