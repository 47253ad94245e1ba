"""The comparison of solvers at tiny sizes: results are kept, shown and not made twice."""

import shutil
from pathlib import Path

import best_jets
import pytest
import sequences
import sft_report
import sft_results
import sft_runs
import synthetic
from scripts import load

from polysft_mi.errors import InputError
from polysft_mi.results import evaluation, metrics

sft = load("benchmarks/sft.py")
SETUP = {"frames": None, "threads": None, "define": [], "mode": None, "iterations": None}


# ---- results and tables --------------------------------------------------------------------------


def result(sequence="flag", method="adam", setup=SETUP, **more):
    figures = {"frames": 45, "e3d": 0.02, "e3d_proc": 0.0123, "en_deg": 7.5}
    base = {
        "sequence": sequence,
        "method": method,
        "setup": setup,
        "machine": "Some CPU, 2 cores",
        "frames": 45,
        "orders": [4, 4],
    }
    return {
        **base,
        "seconds_a_frame": 5.25,
        "iterations": 150.4,
        "figures": figures,
        "versions": {"variant": "llvm_ad_rgb"},
        **more,
    }


def test_table_shows_each_kind_of_truth_apart():
    depth = {
        "frames": 97,
        "depth_rmse_mm": 6.5,
        "depth_rmse_mm_worst": 12.25,
        "depth_rmse_allpix_mm": 2.75,
        "hit": 1.0,
    }
    mesh = {"e3d": 0.002, "e3d_proc": 0.001, "en_deg": 2.0}
    best = result(
        method=sft_results.JET, orders=[6, 6], figures=mesh, seconds_a_frame=None, iterations=None
    )
    rows = [
        best,
        result("kinect_paper", "gauss-newton", orders=[4, 6], figures=depth, lost=3),
        result(),
        result("corner", "adam", figures={}, error="error: it broke"),
    ]
    meshes, points, failed = sft_report.table(rows).split("\n\n## ")
    assert meshes.startswith("## True vertices")
    cells = [[x.strip() for x in line.strip("|").split("|")] for line in meshes.splitlines()[2:]]
    assert {len(row) for row in cells} == {9}
    assert cells[2] == ["flag", "`adam`", "4", "45", "0.0123", "7.5", "0.02", "5.25", "150"]
    assert cells[3] == ["flag", "*best jet*", "6", "45", "0.001", "2", "0.002", "–", "–"]
    assert points.startswith("Depth points")
    assert (
        "| kinect_paper | `gauss-newton` | 4–6 | 45, 3 lost | 6.5 | 12.25 | 2.75 | 5.25 | 150 |"
        in points
    )
    assert failed.splitlines()[-1] == "- corner, `adam`: error: it broke"


def test_where_it_is_known_what_is_in_view_that_is_shown():
    figures = {"e3d": 0.03, "e3d_proc": 0.02, "en_deg": 9.0}
    figures |= {"e3d_proc_seen": 0.01, "en_deg_seen": 5.0}
    sheets, rest = sft_report.table([result("tube", figures=figures), result()]).split("\n\n## ")
    assert "tube" not in sheets and "flag" in sheets and rest.startswith("True vertices, with")
    assert rest.splitlines()[-1] == "| tube | `adam` | 4 | 45 | 0.01 | 5 | 0.02 | 5.25 | 150 |"


def test_report_writes_page_and_plot(tmp_path):
    text = sft_report.report(
        [result(), result(method="gauss-newton", seconds_a_frame=0.5)], str(tmp_path / "docs")
    )
    page = (tmp_path / "docs" / "sft.md").read_text()
    assert text in page and "Some CPU, 2 cores, `llvm_ad_rgb`" in page and "](sft.png)" in page
    assert (tmp_path / "docs" / "sft.png").read_bytes().startswith(b"\x89PNG")


def test_results_replace_those_of_the_same_setup_only(tmp_path):
    path = str(tmp_path / "sft.json")
    short = {**SETUP, "frames": 3}
    jets = [result(method=sft_results.JET, orders=[n, n]) for n in (4, 10)]
    for r in (result(seconds_a_frame=9.0), result(setup=short), *jets, result()):
        sft_results.add(path, r)
    kept = sft_results.read(path)
    assert len(kept) == 4
    assert sft_results.find(kept, "flag", "adam", SETUP)["seconds_a_frame"] == 5.25
    assert sft_results.find(kept, "flag", "adam", short)["setup"] == short
    assert sft_results.find(kept, "flag", sft_results.JET, SETUP, 10)["orders"] == [10, 10]
    assert sft_results.find(kept, "flag", "per-vertex", SETUP) is None


def test_commands_are_those_of_a_user():
    setup = {**SETUP, "frames": 5, "define": ["period=7"], "mode": "llvm_ad_rgb", "iterations": 9}
    line = sft_runs.command("bend", "gauss-newton", "/data/bend", "out/x", setup)
    assert (
        line[1:3] == ["-m", "polysft_mi.run"]
        and line[3].endswith("scenes/bend.xml")
        and "--iterations" not in line
    )
    assert [line[k + 1] for k, x in enumerate(line) if x == "-D"] == [
        "data=/data/bend",
        "period=7",
        "last=4",
        "solver=gauss-newton",
    ]
    line = sft_runs.command("bend", "per-vertex", "/data/bend", "out/x", setup)
    assert line[1].endswith("per_vertex.py") and line[line.index("--iterations") + 1] == "9"
    assert [line[k + 1] for k, x in enumerate(line) if x == "-D"] == [
        "data=/data/bend",
        "period=7",
        "last=4",
    ]
    for sequence in sft_results.SEQUENCES:
        assert Path(sft_runs.command(sequence, "adam", "/data", "out", SETUP)[3]).is_file()
    assert sft_runs.command("roll", "adam", "/data", "out", SETUP)[3].endswith("scenes/tube.xml")


def test_the_documentation_is_drawn_from_the_results_beside_it():
    docs = Path(sft.ROOT) / "docs"
    results = sft_results.read(docs / "sft.json")
    assert all(sft_runs.is_whole(r["setup"]) for r in results)
    assert sft_report.page(results, "sft.png") == (docs / "sft.md").read_text(encoding="utf-8")


def test_a_damaged_file_of_results_is_told(tmp_path):
    (tmp_path / "sft.json").write_text("{")
    with pytest.raises(InputError, match="not a file of results"):
        sft.main(["--data", str(tmp_path), "-o", str(tmp_path), "--docs", str(tmp_path)])


def test_one_command_is_run_timed_and_scored(sheet, tmp_path, monkeypatch):
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    shutil.copy(sheet.folder / "scene.xml", scenes / "flag.xml")
    monkeypatch.setattr(sequences, "SCENES", str(scenes))
    setup = {**SETUP, "threads": 1, "define": ["period=3"], "mode": "llvm_ad_rgb"}
    r = sft_runs.run("flag", "adam", str(sheet.folder), str(tmp_path / "runs" / "flag-adam"), setup)
    assert "error" not in r and r["frames"] == 2 and r["iterations"] == 3 and r["orders"] == [4, 4]
    assert r["seconds_a_frame"] == r["seconds"] / 2 > 0
    assert (
        r["figures"]["e3d_proc"]
        == evaluation.evaluate(str(tmp_path / "runs" / "flag-adam"), str(sheet.folder))["e3d_proc"]
    )
    assert r["versions"]["variant"] == "llvm_ad_rgb" and "core" in r["machine"]
    broken = sft_runs.run(
        "flag",
        "adam",
        str(sheet.folder),
        str(tmp_path / "runs" / "broken"),
        {**setup, "define": ["perod=3"]},
    )
    assert "perod" in broken["error"] and "figures" not in broken


# ---- best jets -----------------------------------------------------------------------------------


def template_of(sheet, order):
    from polysft_mi.surface.template import Template

    return Template.fit(sheet.vertices[0], sheet.faces, sheet.uv, order)


def test_best_jets_get_better_with_their_order(sheet):
    truth = synthetic.sheet(1.0, 9, 11, bend=11.0)  # a cylinder of 150 degrees
    distance = {}
    for order in (2, 4, 6):
        template = template_of(sheet, order)
        distance[order] = metrics.rmse(best_jets.best_jets(template, truth[None])[0], truth)
    assert distance[6] < distance[4] < distance[2]
    assert distance[2] > 1e-4


def test_best_jet_of_a_sequence_is_scored_like_a_run(sheet):
    r = sft_runs.jet_result("flag", str(sheet.folder), 4, {**SETUP, "frames": 1})
    assert r["frames"] == 1 and r["orders"] == [4, 4] and r["figures"]["e3d_proc"] < 1e-5
    whole = sft_runs.jet_result("flag", str(sheet.folder), 4, SETUP)
    assert whole["frames"] == 2 and whole["figures"]["e3d_proc"] < 1e-3
