"""The sequences of the paper that are not here, in their layout and small: the commands of
docs/paper.md take them.
"""

import json

import numpy as np
import pytest
import synthetic
from clips import CAMERA, HEIGHT, WIDTH, photo, placed, rendered, write_png

from polysft_mi import evaluate, prepare, run
from polysft_mi.results.truth import load_npz

PAPER = ["-q", "-D", "preset=paper", "-D", "period=12", "-D", "patience=12"]


def test_a_synthetic_sequence_of_phi_sft(tmp_path, capsys):
    """S1 to S4: rgbs/, masks/, an OBJ file of quads, a texture, camera.json, and the truth."""
    folder, out = tmp_path / "S1", tmp_path / "out"
    truth = synthetic.phi_sft(folder, frames=3, obj="0_S1_quad.obj", bend=0.3)
    np.savez(folder / "gt.npz", vertices=truth.vertices.astype(np.float32), faces=truth.faces)
    prepare.main([str(folder), "-o", str(tmp_path / "scene"), "-q"])
    assert run.main([str(tmp_path / "scene" / "scene.xml"), "-o", str(out), *PAPER]) == 0
    capsys.readouterr()
    assert evaluate.main([str(out), str(folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    figures = figures.get("figures", figures)
    assert 0 < figures["e3d"] < 0.05 and 0 < figures["en_deg"] < 30
    assert load_npz(out / "surface.npz")["vertices"].shape == truth.vertices.shape


@pytest.mark.slow
def test_images_of_a_sheet_without_truth(tmp_path):
    """Paper-Bend: images, a camera, and the sheet's corners in the first image."""
    print_ = photo()
    for k in range(3):
        write_png(tmp_path / "images" / f"frame_{k}.png", rendered(print_, 0.2 * k)[0])
    camera = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    R, shift = placed(0.0)
    flat = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2 * (WIDTH, HEIGHT, 0)
    corners = [f"{x:.1f},{y:.1f}" for x, y in CAMERA.project(flat @ R.T + shift)]
    words = [str(tmp_path / "images"), "--texture", "first-frame", "--size", "297mm", "210mm"]
    words += ["--camera", str(tmp_path / "camera.json"), "--no-masks", "--corners", *corners]
    prepare.main([*words, "-o", str(tmp_path / "bend"), "-q"])
    out = tmp_path / "out"
    assert run.main([str(tmp_path / "bend" / "scene.xml"), "-o", str(out), *PAPER]) == 0
    made = load_npz(out / "surface.npz")["vertices"]
    assert len(made) == 3
    # the sheet goes away to the side: its middle follows
    way = made.mean(1)[-1] - made.mean(1)[0]
    true = placed(0.4)[1] - placed(0.0)[1]
    assert way @ true > 0
