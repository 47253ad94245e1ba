"""What is compared with a track: the same frames, solved from the true surface."""

import numpy as np
import pytest
import synthetic
from scripts import load

from polysft_mi import prepare
from polysft_mi.errors import InputError
from polysft_mi.results.truth import Truth
from polysft_mi.scene import experiment

from_truth = load("benchmarks/from_truth.py")


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    truth = synthetic.cloth(
        tmp_path_factory.mktemp("truth") / "flag", frames=3, bend=1.0, turn=0.02, shift=0.002
    )
    prepare.main([str(truth.folder)])
    loaded = experiment.load(str(truth.folder / "scene.xml"), {"data": str(truth.folder)})
    return from_truth.probed(loaded, Truth.open(truth.folder), 1)


def test_both_are_costs_of_one_objective(rows):
    assert [row["frame"] for row in rows] == [1, 2]
    for row in rows:
        track, truth = row["track"]["terms"], row["truth"]["terms"]
        assert set(track) == set(truth) and sum(truth.values()) > 0
        # an easy sheet: both ways lead to about the same surface
        assert sum(truth.values()) == pytest.approx(sum(track.values()), rel=0.3)
        assert row["track"]["left"] == pytest.approx(row["truth"]["left"], abs=1.0)


def test_a_truth_of_other_vertices_is_refused(tmp_path):
    truth = synthetic.cloth(tmp_path / "flag", frames=2)
    prepare.main([str(truth.folder)])
    loaded = experiment.load(str(truth.folder / "scene.xml"), {"data": str(truth.folder)})
    points = Truth(str(tmp_path), "points", {0: np.zeros((3, 3))})
    with pytest.raises(InputError, match="the template's [0-9]+ vertices"):
        from_truth.probed(loaded, points, 1)


def test_the_page_has_both(rows):
    text = from_truth.page({"flag": rows})
    (line,) = [line for line in text.splitlines() if line.startswith("| flag | 2 |")]
    costs = [1e3 * sum(rows[1][which]["terms"].values()) for which in ("track", "truth")]
    assert f"| {costs[0]:.1f} | {costs[1]:.1f} |" in line
