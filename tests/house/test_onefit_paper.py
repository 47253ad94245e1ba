"""The benchmark of the paper's tables of OneFit, at tiny sizes: it trains by the preset, goes on
where it was, and measures the network alone.
"""

import json

import pytest
from PIL import Image
from scripts import load

import onefit

bench = load("benchmarks/onefit_paper.py")
TINY = "--epochs 1 --batch 100 --seeds 1 --shapes 0".split()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setattr(bench, "SHORT", TINY)
    monkeypatch.setitem(bench.TRAININGS, "six", ["tank"])
    tuned = ["tank", "--from", "RUNS/six/weights.safetensors"]
    monkeypatch.setitem(bench.TRAININGS, "jumpsuit-tuned", tuned)
    monkeypatch.setattr(bench, "COUNTS", (600,))
    monkeypatch.setattr(bench, "PICTURE", (48, 32))
    monkeypatch.setattr(bench, "POSES", (("tank", "bend"),))
    monkeypatch.setattr(bench, "STYLES", {"cropped": dict(hem=0.12, count=700)})


def test_every_training_has_a_command(capsys):
    bench.main(["RUNS", "--commands"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(bench.TRAININGS)
    assert all("--preset paper" in line and "-o RUNS/" in line for line in lines)


@pytest.mark.slow
def test_tables_of_what_is_trained(runs, tmp_path):
    bench.main([str(runs), "--train", "jumpsuit-tuned", "tank-no-col", "--short", "1"])
    assert sorted(p.name for p in runs.iterdir()) == ["jumpsuit-tuned", "six", "tank-no-col"]
    made = (runs / "six" / "weights.safetensors").stat().st_mtime_ns
    bench.main([str(runs), "--train", "six", "--short", "1"])  # is there already
    assert (runs / "six" / "weights.safetensors").stat().st_mtime_ns == made
    (tmp_path / "onefit_paper.json").write_text('{"jumpsuit": {"six": 7.0}, "losses": {"old": 1}}')
    tables = ["trained", "losses", "styles", "poses", "resolutions"]
    words = ["--tables", *tables, "--seconds", "0.1", "--shapes", "0", "-o", str(tmp_path)]
    bench.main([str(runs), *words])
    report = json.loads((tmp_path / "onefit_paper.json").read_text())
    assert report["jumpsuit"] == {"six": 7.0}  # not asked for
    assert set(report["trained"]) == {"six", "jumpsuit-tuned", "tank-no-col", "package"}
    assert report["trained"]["tank-no-col"]["steps"] == 1
    assert list(report["losses"]) == ["old", "no collision"]  # what RUNS lacks stays
    (row,) = report["resolutions"]
    assert 400 < row["vertices"] < 900 and row["ms"] > 0
    draper = onefit.load("paper")
    assert draper.network.shape["extras"] == []
    motion = onefit.Motion.generate("bend", seconds=0.1, seed=bench.accuracy.SEED)
    alone = draper.drape("tank", motion, post=False, eased=False).measures().collision
    assert report["poses"] == {"tank, bend": pytest.approx(alone)}
    with Image.open(tmp_path / "paper_poses.jpg") as picture:
        assert picture.size == (32, 48)
