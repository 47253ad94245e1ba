"""The examples run, and show what they say."""

import importlib.util
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT
from scripts import load

from polyfit import InputError

torch_loss, own_unknowns, drape_to_blender, bend_a_patch = (
    load(f"examples/{name}.py")
    for name in ("torch_loss", "own_unknowns", "drape_to_blender", "bend_a_patch")
)


def test_the_image_pulls_the_sheet_back():
    distances = torch_loss.main(steps=6)
    assert distances[-1] < 0.6 * distances[0] < 0.6 * 6


def test_curvature_and_distance_are_found():
    found = own_unknowns.main(steps=60, width=64)
    assert found == pytest.approx(own_unknowns.TRUE, rel=0.05)


def test_the_drape_moves(tmp_path):
    Usd, UsdGeom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    paths = drape_to_blender.main(tmp_path, "shorts", seconds=0.2)
    for path, name in zip(paths, ("shorts", "body"), strict=True):
        stage = Usd.Stage.Open(str(path))
        assert stage.GetEndTimeCode() == 5 and UsdGeom.GetStageMetersPerUnit(stage) == 1
        points = UsdGeom.Mesh(stage.GetPrimAtPath(f"/{name}/mesh")).GetPointsAttr()
        first, last = (np.array(points.Get(t)) for t in (0, 5))
        assert 0.005 < np.linalg.norm(last - first, axis=1).max() < 1


def test_one_patch_moves_and_the_rest_stays(tmp_path):
    before, after = bend_a_patch.main(tmp_path, parts=1)
    moved = np.linalg.norm(after - before, axis=1)
    assert 0.005 < moved.max() < 0.1 and 0 < (moved > 1e-6).mean() < 0.3
    assert (tmp_path / "before.ply").stat().st_size == (tmp_path / "after.ply").stat().st_size


def test_arguments_that_cannot_be_used_are_named(tmp_path):
    for how, message in (
        (dict(patch=9999), "--patch = 9999; a whole number, 0 to "),
        (dict(bend=np.nan), "--bend = nan; a finite number is needed"),
    ):
        with pytest.raises(InputError, match=message):
            bend_a_patch.main(tmp_path / "no", **how)
    with pytest.raises(InputError, match="--steps = 0; a whole number, 1 or more, is needed"):
        torch_loss.main(steps=0)
    assert not (tmp_path / "no").exists()


def test_the_notebook_runs_from_top_to_bottom(tmp_path, monkeypatch):
    """In a Jupyter kernel where there is nbclient, else as Python alone."""
    text = (ROOT / "examples" / "first_steps.ipynb").read_text(encoding="utf-8")
    cells = [c for c in json.loads(text)["cells"] if c["cell_type"] == "code"]
    assert all(c["outputs"] == [] and c["execution_count"] is None for c in cells)  # none is stored
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    if all(map(importlib.util.find_spec, ("nbclient", "ipykernel"))):
        import nbclient
        import nbformat

        notebook = nbformat.reads(text, as_version=4)
        where = {"metadata": {"path": str(tmp_path)}}
        nbclient.NotebookClient(notebook, timeout=300, resources=where).execute()
        printed = "".join(
            output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", [])
        )
    else:
        monkeypatch.chdir(tmp_path)
        code = "\n".join("".join(cell["source"]) for cell in cells)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        printed = done.stdout
    assert float(re.search(r"([\d.]+) mm, in the worst frame", printed)[1]) < 5
    assert (tmp_path / "out" / "first_steps" / "export" / "surface.glb").stat().st_size > 100_000


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda p: p.stem)
def test_examples_are_short_and_have_a_line_in_the_gallery(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 60
    assert f"examples/{path.name}" in (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
