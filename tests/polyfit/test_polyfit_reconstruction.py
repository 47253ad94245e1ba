"""The benchmark of reconstruction: that its measures measure what they say, on surfaces whose
distance is known.
"""

import json

import numpy as np
import pytest
import surfaces
from scripts import load

from polyfit import write_ply

benchmark = load("benchmarks/polyfit_reconstruction.py")


def test_distance_and_angle_between_surfaces():
    V, F = surfaces.sheet(n=7)
    tilted = V + np.column_stack([np.zeros((len(V), 2)), 0.01 + 0.1 * V[:, 0]])
    rms, p95, angle = benchmark.between(V, F, V + (0, 0, 0.01), F[:, ::-1], 500)
    assert (rms, p95, angle) == pytest.approx((0.01, 0.01, 0), abs=1e-6)
    assert benchmark.between(V, F, tilted, F, 500)[2] == pytest.approx(
        np.degrees(np.arctan(0.1)), abs=1e-6
    )
    half = F[
        V[F][:, :, 0].max(axis=1) <= 0
    ]  # what is missing counts: points of the sheet are far from its half
    assert benchmark.between(V, F, V, half, 4000)[0] == pytest.approx(
        np.sqrt(0.5 * 0.5 * 0.3**2 / 3), rel=0.3
    )


def test_chamfer_is_the_sum_of_both_mean_squares():
    a, b = np.zeros((4, 3)), np.array([[1.0, 0, 0], [2, 0, 0]])
    assert benchmark.chamfer(a, b) == 1 + (1 + 4) / 2


def test_samples_are_even():
    points = benchmark.sampled(*surfaces.sheet(n=4), 8000, 0)
    assert np.histogram2d(*points[:, :2].T, bins=4, range=[[-0.3, 0.3]] * 2)[0] == pytest.approx(
        np.full((4, 4), 500), abs=120
    )


@pytest.mark.slow
def test_tables_at_a_small_size(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "PATCHES", (10,))
    monkeypatch.setattr(benchmark, "POINTS", 1000)
    write_ply(tmp_path / "tube.ply", *surfaces.tube())
    benchmark.main([str(tmp_path / "tube.ply"), "--iterations", "20", "-o", str(tmp_path)])
    report = json.loads((tmp_path / "polyfit_reconstruction.json").read_text())
    (paper,), (size,) = report["paper"], report["sizes"]
    assert paper["patches"] == 100 and abs(paper["over_floor"]) < 0.2 and paper["rms_mm"] < 0.5
    assert size["numbers"] == 220 and 200 <= size["atlasnet_numbers"] <= 240
    assert size["rms_mm"] < 1 < size["atlasnet_rms_mm"]
    turned = {row["way"]: row["turned"] for row in report["ways"]}
    assert turned["ours"] == turned["plain ACVD"] == 0 and len(turned) == len(benchmark.WAYS)
