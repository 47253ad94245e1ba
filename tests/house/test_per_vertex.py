"""The per-vertex baseline at tiny sizes: its objective is Adam's, and it descends to the truth."""

import json

import numpy as np
import pytest
import synthetic
from scripts import load

from polysft_mi import prepare
from polysft_mi.errors import InputError
from polysft_mi.results import evaluation, metrics, truth
from polysft_mi.scene import PRESETS

per_vertex = load("benchmarks/per_vertex.py")


@pytest.fixture
def large_steps():
    pytest.importorskip("cholespy", reason="mi.ad.LargeSteps needs cholespy")


def test_objective_of_the_baseline_is_adams(large_steps, tmp_path):
    from polysft_mi.objective import Objective, Problem
    from polysft_mi.scene import experiment as scene

    # an even number of rows: none lies on the centres of a row of pixels, where a ray may slip
    # through
    sheet = synthetic.cloth(tmp_path / "flag", frames=2, rows=10, bend=1.5, shift=0.005)
    prepare.main([str(sheet.folder)])
    losses = {name: PRESETS["paper"][name] for name in per_vertex.OVER_SHEET}
    baseline = per_vertex.load(str(sheet.folder / "scene.xml"), losses)
    paper = {"preset": "paper", "canonical_frame": "pca", "k_tc": "0"}
    experiment = scene.load(str(sheet.folder / "scene.xml"), paper)
    problem = Problem(experiment, experiment.sequence())
    # moved off the template's place, where the sheet's edges lie along pixel centres
    rest = problem.patch.rest().to_numpy()
    moved = {**rest, "translation": rest["translation"] + np.float32([0.013, 0.007, 0.011])}
    moved = type(problem.patch.rest()).from_numpy(moved)
    points = problem.surface(moved) - sheet.vertices[0].mean(0)
    patch = baseline.problem.patch
    form = patch._form.to_differential(patch._flat(points / problem.template.scale))
    mine, terms = per_vertex.frozen(baseline, 1).evaluate([form])
    theirs, wanted = per_vertex.frozen(Objective(problem), 1).evaluate([moved])
    assert mine == pytest.approx(theirs, rel=1e-3) and mine > 0
    assert terms["silhouette"] == pytest.approx(wanted["silhouette"], rel=1e-3)


def test_baseline_descends_towards_the_truth(sheet, large_steps, tmp_path):
    out = tmp_path / "out"
    arguments = [
        str(sheet.folder / "scene.xml"),
        "-o",
        str(out),
        "--iterations",
        "60",
        "--step",
        "0.01",
        "-q",
    ]
    assert not per_vertex.main(arguments)
    _first, second = json.loads((out / "metrics.json").read_text())["per_frame"]
    assert second["loss"] < 0.5 * second["first_loss"] and second["iterations"] == 60
    surface = truth.read_surface(str(out))
    assert surface["vertices"].shape == sheet.vertices.shape and surface["uv"].shape == (
        len(sheet.uv),
        2,
    )
    assert np.array_equal(surface["faces"], sheet.faces) and surface["frames"].tolist() == [0, 1]
    still = metrics.rmse(sheet.vertices[0], sheet.vertices[1])
    assert metrics.rmse(surface["vertices"][1].astype(float), sheet.vertices[1]) < 0.6 * still
    with pytest.raises(InputError, match="holds another result"):
        per_vertex.main(arguments)


def test_baseline_takes_a_template_whose_texture_has_a_seam(large_steps, tmp_path):
    tube = synthetic.cloth(tmp_path / "tube", frames=2, shape=synthetic.tube, shift=0.005)
    prepare.main([str(tube.folder)])
    arguments = [str(tube.folder / "scene.xml"), "-o", str(tmp_path / "out"), "-q"]
    assert not per_vertex.main([*arguments, "--iterations", "60", "--step", "0.01"])
    surface = truth.read_surface(str(tmp_path / "out"))
    assert surface["vertices"].shape == tube.vertices.shape  # each vertex of the seam once
    assert len(surface["uv"]) > len(tube.vertices[0])
    row = json.loads((tmp_path / "out" / "metrics.json").read_text())["per_frame"][1]
    assert row["loss"] < 0.5 * row["first_loss"]
    assert "e3d_proc_seen" in evaluation.evaluate(str(tmp_path / "out"), str(tube.folder))
