"""The comparison of cuts at a tiny size: patches are halved, jets are fitted to true surfaces."""

import numpy as np
import pytest
import synthetic
from scripts import load

cuts = load("benchmarks/atlas_cuts.py")


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    """The folder of a sequence with a sleeve that bends."""
    folder = tmp_path_factory.mktemp("data") / "tube"
    synthetic.cloth(folder, frames=2, rows=13, columns=24, shape=synthetic.tube)
    return str(folder)


def test_halves_hold_the_same_template(tube):
    whole, half = (cuts.cut(tube, how) for how in ("as it is", "patches halved"))
    assert len(half) == 2 * len(whole) and half.order == whole.order
    assert (half.patch[:, 0] // 2 == whole.patch[:, 0]).all()
    count = np.bincount(half.patch[:, 0])
    assert count.min() > 0.4 * count.max()
    assert half.weight.sum(1) == pytest.approx(1, abs=1e-12)


def test_jets_of_more_patches_or_a_higher_order_leave_less(tube):
    left = [cuts.held(cuts.cut(tube, how), tube, 1) for how in cuts.CUTS]
    assert left[2] < 0.6 * left[0] and left[1] < left[0] < 0.1


def test_the_table_shows_what_chance_does():
    result = {"patches": 3, "order": 5, "left": 1.234, "errors": [0.0102, 0.0097], "seconds": [2]}
    found = {f"tube/{how}": result for how in cuts.CUTS} | {"ball/as it is": result}
    found["tube/patches halved"] = {**result, "patches": 6, "errors": [0.01]}
    head, _, row = cuts.table(found).splitlines()
    assert head.count("|") == row.count("|") == 12
    assert row.startswith("| tube | 3, 5 | 1.23 | 1.23 | 1.23 | 0.0097 to 0.0102 | 0.01 | 0.0097")
    assert row.endswith("| 2.00 | 2.00 | 2.00 |")
