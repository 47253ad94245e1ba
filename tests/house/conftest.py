"""Sequences that several tests of benchmarks read."""

import pytest
import synthetic

from polysft_mi import prepare


@pytest.fixture(scope="session")
def sheet(tmp_path_factory):
    """A sheet that bends and moves, as a folder ``flag`` with its scene.xml."""
    truth = synthetic.cloth(
        tmp_path_factory.mktemp("data") / "flag", frames=2, bend=1.5, turn=0.05, shift=0.005
    )
    prepare.main([str(truth.folder)])
    return truth
