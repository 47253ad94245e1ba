"""Templates in other units than metres are noted, by the preparation and by a run."""

import numpy as np
import pytest
import synthetic

from polyfit.mesh import size_note
from polysft_mi import prepare, run
from polysft_mi.surface.meshio import read_template


@pytest.mark.parametrize(
    "extent, said",
    [
        (297.0, "if it is in millimetres, scale it by 0.001, to 0.297 m"),
        (70.0, "scale it by 0.001, to 0.07 m; if it is in centimetres, scale it by 0.01, to 0.7 m"),
        (1800.0, "if it is in millimetres, scale it by 0.001, to 1.8 m"),
        (297e3, "if it is in micrometres, scale it by 1e-06, to 0.297 m"),
        (0.0003, "if it is in kilometres, scale it by 1000, to 0.3 m"),
        (1e12, "if it is in another unit"),
        (0.297, None),
        (0.01, None),
        (9.0, None),  # a sheet over a house
    ],
)
def test_size_note(extent, said):
    vertices = np.array([[0, 0, 1], [extent, 0, 1], [0, 0.7 * extent, 1]])
    note = size_note(vertices, "a.obj", "template")
    assert (note is None) == (said is None)
    if note:
        assert note.startswith("note: a.obj: the template is ") and said in note
        assert "\n" not in note


def test_prepare_and_run_tell(tmp_path, capsys):
    """A sequence in millimetres is prepared and tracked as before, with a line on stderr."""
    truth = synthetic.cloth(tmp_path / "data", frames=1)
    folder = truth.folder
    prepare.main([str(folder)])
    assert capsys.readouterr().err == ""
    vertices, faces, uv = read_template(folder / "template.obj")
    synthetic.write_obj(folder / "template.obj", 1000 * vertices, uv, faces)
    prepare.main([str(folder), "--overwrite"])
    (line,) = capsys.readouterr().err.splitlines()
    assert "template.obj: the template is " in line and "scale it by 0.001" in line
    out = tmp_path / "out"
    words = [str(folder / "scene.xml"), "-o", str(out), "-q", "--no-report", "-D", "order=4"]
    assert run.main(words) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "scene.xml: the template is " in line and "scale it by 0.001" in line
