"""Many runs: what one call leaves, what the next one does, and that a bad scene costs its own line
alone.
"""

import json
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import synthetic
from places import ROOT

from polysft_mi import batch, batches, prepare
from polysft_mi.errors import InputError

QUICK = ["--", "--exr", "0", "--no-report"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two scenes, and one whose images are gone."""
    folder = tmp_path_factory.mktemp("scenes")
    for name, bend in (("flat", 1.0), ("bent", 2.5), ("gone", 1.0)):
        truth = synthetic.cloth(folder / name, frames=2, bend=bend)
        prepare.main([str(truth.folder), "-q"])
    (folder / "gone" / "frames").rename(folder / "gone" / "elsewhere")
    return folder


def rows(out):
    return {row["name"]: row for row in json.loads((out / "batch.json").read_text())["jobs"]}


def test_a_broken_scene_costs_its_own_line(scenes, tmp_path, capsys):
    out = tmp_path / "out"
    words = [str(scenes), "-o", str(out), "--workers", "2", "-D", "order=4"]
    assert batch.main([*words, *QUICK]) == 1
    assert "done: 2 of 3, failed: 1" in capsys.readouterr().out
    found = rows(out)
    assert {n: r["status"] for n, r in found.items()} == {
        "flat": "done", "bent": "done", "gone": "failed",
    }  # fmt: skip
    assert "gone/frames: no such folder" in found["gone"]["error"]
    for name in ("flat", "bent"):
        metrics = json.loads((out / name / "metrics.json").read_text())
        row = found[name]
        assert row["frames"] == metrics["frames"] == 2 and metrics["order"] == 4
        assert row["psnr_mask"] == metrics["psnr_mask"] and row["seconds"] > 0
    lines = (out / "batch.md").read_text().splitlines()
    assert len(lines) == 5 and "failed" in next(s for s in lines if s.startswith("| gone"))
    page = (out / "batch.html").read_text(encoding="utf-8")
    assert page.count("<img ") == 2 and all(f"{n}.log" in page for n in found)

    # the next call does what is left, and nothing else
    stamps = [(out / n / "metrics.json").stat().st_mtime_ns for n in ("flat", "bent")]
    moved = scenes / "gone" / "elsewhere"
    moved.rename(scenes / "gone" / "frames")
    try:
        assert batch.main([*words, "-q", *QUICK]) == 0
    finally:
        (scenes / "gone" / "frames").rename(moved)
    assert [(out / n / "metrics.json").stat().st_mtime_ns for n in ("flat", "bent")] == stamps
    assert {r["status"] for r in rows(out).values()} == {"done"} and "error" not in rows(out)[
        "gone"
    ]
    with pytest.raises(InputError, match=r"other options \(-D order=4 --exr 0 --no-report\)"):
        batch.main([str(scenes), "-o", str(out), "-D", "order=5"])


def test_options_may_change_while_nothing_came_out(scenes, tmp_path):
    words = [str(scenes / "gone"), "-o", str(tmp_path / "out"), "-q"]
    for wrong in "ordr=4", "order=4":
        assert batch.main([*words, "-D", wrong, *QUICK]) == 1
        about = json.loads((tmp_path / "out" / "batch.json").read_text())
        assert about["options"][:2] == ["-D", wrong]


def test_ctrl_c_keeps_what_is_done_and_the_next_call_goes_on(tmp_path):
    """However late the signal comes: of two runs, one after the other, the last has not begun."""
    truth = synthetic.cloth(tmp_path / "data", frames=6, bend=2.5, turn=0.1)
    prepare.main([str(truth.folder), "-q"])
    names = ["a", "b"]
    scenes = [shutil.copy(truth.folder / "scene.xml", truth.folder / f"{n}.xml") for n in names]
    out = tmp_path / "out"
    words = [*map(str, scenes), "-o", str(out), "--workers", "1", *QUICK]
    process = subprocess.Popen(
        [sys.executable, "-m", "polysft_mi.batch", *words],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 120
    while not list(out.glob("*/checkpoint.npz")):
        assert time.monotonic() < until and process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 130 and "interrupted: " in said and "Traceback" not in said
    before = rows(out)
    waiting = [name for name in names if before[name]["status"] == "waiting"]
    assert waiting and {before[name]["status"] for name in names} <= {"waiting", "done"}
    kept = {}
    for name in names:
        if (out / name / "surface.npz").exists():  # a run has time to write what it has
            with np.load(out / name / "surface.npz") as arrays:
                kept[name] = arrays["vertices"]
    assert kept
    assert batch.main(words) == 0
    for name in names:
        assert rows(out)[name]["frames"] == 6
        with np.load(out / name / "surface.npz") as arrays:
            done = kept.get(name, arrays["vertices"])
            assert len(arrays["vertices"]) == 6
            assert np.abs(arrays["vertices"][0] - done[0]).max() < 1e-3


def test_garments_are_draped_in_motions(tmp_path):
    pytest.importorskip("torch", reason="torch is not installed (the extra 'learn')")
    out = tmp_path / "out"
    words = ["--garments", "tank", "no_such.obj", "--motions", "walk", "-o", str(out), "-q"]
    options = ["--seconds", "0.1", "--weights", "six-garments", "--skip", "usd", "render"]
    assert batch.main([*words, "--workers", "2", "--", *options]) == 1
    found = rows(out)
    assert found["tank-walk"]["status"] == "done" and found["tank-walk"]["frames"] == 3
    assert found["tank-walk"]["collision"] >= 0 and (out / "tank-walk" / "drape.npz").exists()
    assert "no_such.obj" in found["no_such-walk"]["error"]


def test_names_tell_scenes_apart(tmp_path):
    for name in ("a/x/scene.xml", "b/x/scene.xml", "b/runs/scene.xml", "b/runs/run.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "b" / "flag one.xml").write_text("")
    jobs = batches.runs([str(tmp_path)], ["-D", "order=4"], tmp_path / "out")
    assert [job.name for job in jobs] == ["a-x", "b-x"]  # a run's own scene is none to run
    jobs = batches.runs([str(tmp_path / "b" / "flag one.xml")], [], tmp_path / "out")
    assert [job.name for job in jobs] == ["flag_one"]
    assert jobs[0].command()[3] == str(tmp_path / "b" / "flag one.xml")


def test_refusals(tmp_path):
    scene, out = str(ROOT / "scenes" / "demo.xml"), ["-o", str(tmp_path / "out")]
    full = tmp_path / "full"
    full.mkdir()
    (full / "else").write_text("")
    for arguments, words in [
        (out, "either scenes, or --garments"),
        ([scene, "--garments", "tank", "--motions", "walk", *out], "either scenes, or --garments"),
        (["--garments", "tank", *out], "belong together"),
        ([str(full), *out], "no scene.xml in this folder"),
        ([str(tmp_path / "nowhere"), *out], "no such file or folder"),
        ([scene, "--workers", "0", *out], "at least 1"),
        ([scene, "-D", "order", *out], "NAME=VALUE"),
        ([scene, "-o", str(full)], "holds no batch"),
        ([scene, *out, "--", "-o", "foo"], "-o after --: each result has its own folder"),
    ]:
        with pytest.raises(InputError, match=words):
            batch.main(arguments)
    assert not (tmp_path / "out").exists()
