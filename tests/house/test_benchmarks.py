"""The benchmarks at tiny sizes: that they measure what they say. Their times are no part of the
tests.
"""

import dataclasses
import json

import numpy as np
import pytest
from clips import CAMERA, HEIGHT, WIDTH, photo, placed, rendered, write_png
from places import ROOT
from scripts import load

from polyfit.errors import InputError
from polyfit.patches.atlas import Cover
from polysft_mi import run
from polysft_mi.camera import Intrinsics
from polysft_mi.results.truth import load_npz
from polysft_mi.scene import plugins

SIZE, POINTS = (64, 48), 9
iteration, lit, outline, raster, raster_cuda, raster_figures, scaling, stability, stretch = (
    load(f"benchmarks/{name}.py")
    for name in (
        "iteration lit outline raster raster_cuda raster_figures scaling stability stretch".split()
    )
)


@pytest.fixture(autouse=True)
def registered():
    plugins.register()


@pytest.mark.slow
def test_contenders_show_the_same_sheet_on_half_of_the_image(tmp_path):
    result = raster.measure_times(
        (640, 480), POINTS, str(tmp_path), seconds=0
    )  # large enough for the texture's detail
    assert {len(ms) for ms in result["passes"].values()} == {raster.LEAST_TURNS}
    assert result["coverage"] == pytest.approx(0.5, abs=0.03)
    assert result["mean_difference"] == pytest.approx(0, abs=0.01)
    assert result["mean_absolute_difference"] < 0.1 * result["mean_colour"]


def test_contenders_take_the_same_gradient(tmp_path):
    gradients = {}
    for name in raster.CONTENDERS[:3]:
        contender = raster.contender(name, SIZE, POINTS, str(tmp_path))
        contender.place(-2.0)
        gradients[name] = np.array(contender.forward_backward(0), dtype=np.float64)
    g, through_mi, noisy = (gradients[name] for name in raster.CONTENDERS[:3])
    assert np.linalg.norm(g) > 0
    assert through_mi == pytest.approx(g, rel=1e-3, abs=1e-3 * np.abs(g).max())
    assert noisy.shape == g.shape and np.linalg.norm(noisy) > 0


def test_deodr_takes_about_the_same_gradient(tmp_path):
    """It has another antialiasing, and no perspective in the texture."""
    pytest.importorskip("deodr", reason="deodr is not installed")
    gradients = []
    for name in ("raster", "deodr"):
        contender = raster.contender(name, (640, 480), 33, str(tmp_path))
        contender.place(-2.0)
        gradients.append(np.array(contender.forward_backward(0), dtype=np.float64))
    assert np.corrcoef(gradients)[0, 1] > 0.9


def test_rasterisers_on_the_gpu_see_each_vertex_at_its_pixel():
    """As nvdiffrast counts pixels (the centre of column x at 2 (x + 0.5) / width - 1) and as DRTK
    does (at x).
    """
    pytest.importorskip("torch", reason="torch is not installed")
    camera = Intrinsics(700.0, 650.0, 300.3, 260.1, 640, 480)
    vertices, faces, uv = raster.sheet(POINTS, (640, 480))
    wanted = camera.project(vertices) - 0.5

    matrix, offset = raster_cuda.clip_from_camera(camera)
    clip = vertices @ matrix + offset
    seen = clip[:, :3] / clip[:, 3:]
    assert (seen[:, :2] + 1) / 2 * (640, 480) - 0.5 == pytest.approx(wanted, abs=1e-9)
    assert np.abs(seen[:, 2]).max() < 1
    assert np.diff(seen[np.argsort(vertices[:, 2]), 2]).min() > -1e-12

    class Placed(raster_cuda.DrtkContender):
        def forward(self, seed):
            """No picture, which would need DRTK."""

    placed = Placed(
        vertices, faces, uv, camera, np.ones((2, 2, 3)), np.zeros_like(vertices), device="cpu"
    )
    pixels = placed.pixels()[0].detach().numpy()
    assert pixels == pytest.approx(np.column_stack([wanted, vertices[:, 2]]), abs=1e-3)


def test_a_contender_that_fails_is_left_out(tmp_path, capsys, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("not\nhere")

    monkeypatch.setitem(raster.CUDA_CONTENDERS, "drtk", fail)
    result = raster.measure_times(SIZE, POINTS, str(tmp_path), 0, ["raster", "drtk"])
    assert list(result["passes"]) == ["raster"]
    assert capsys.readouterr().err == "drtk is left out: RuntimeError: not here\n"


@pytest.mark.parametrize(("name", "cores"), [("raster", 1), ("raster_cuda", 16)])
def test_the_page_has_the_table_of_its_figures(name, cores):
    page = (ROOT / "docs" / "raster.md").read_text(encoding="utf-8")
    report = json.loads((ROOT / "docs" / f"{name}.json").read_text(encoding="utf-8"))
    assert report["cores"] == cores
    assert raster_figures.marked(report)[0] in page


DEMO = (str(ROOT / "scenes" / "demo.xml"), {"last": "1", "period": "4"})


@pytest.mark.slow
def test_snapshots_are_what_shorter_runs_return(tmp_path):
    long = stability.run(*DEMO, [3, 40], str(tmp_path), say=str)
    (tmp_path / "log.jsonl").unlink()
    short = stability.run(*DEMO, [3], str(tmp_path), say=str)
    _problem, frame, surfaces, _, watched = long
    assert frame == 1
    assert np.abs(surfaces[3] - short[2][3]).max() < 1e-6
    assert np.abs(surfaces[40] - surfaces[3]).max() > 1e-5
    assert watched.losses[40][0] < watched.losses[3][0]
    assert 0 < watched.seconds[3] < watched.seconds[40]


@pytest.mark.slow
def test_a_stretch_begins_where_a_run_is(tmp_path):
    out, words = str(tmp_path / "run"), "order=4 patches=1 canonical_frame=stn k_relief=0 last=4"
    defines = [w for word in words.split() for w in ("-D", word)]
    run.main([str(ROOT / "scenes" / "demo.xml"), *defines, "-o", out])
    asked = [out, "--first", "3", "--last", "4", "-o", str(tmp_path / "docs"), "--only"]
    with pytest.raises(InputError, match="--only no such one: known are preset; "):
        stretch.main([*asked, "no such one"])
    assert not (tmp_path / "docs").exists()
    stretch.main([*asked, "preset"])
    found = json.loads((tmp_path / "docs" / "stretch.json").read_text())
    assert list(found) == ["3 to 4"] and list(found["3 to 4"]) == ["preset"]
    near, next_one = found["3 to 4"]["preset"]
    template = load_npz(ROOT / "scenes" / "demo" / "gt.npz")["vertices"][0]
    assert 0 < near < 0.01 * np.ptp(template, axis=0).max() and 0 < next_one < 3 * near + 0.01


def test_stability_writes_figures_and_picture(tmp_path, capsys):
    stability.main(
        [DEMO[0], "-D", "first=3", "-D", "last=3", "--counts", "2", "6", "-o", str(tmp_path)]
    )
    report = json.loads((tmp_path / "stability_demo.json").read_text())
    assert report["frame"] == 3 and list(report["counts"]) == ["2", "6"]
    assert report["counts"]["6"]["change_rms_mm"] == 0 < report["counts"]["2"]["change_rms_mm"]
    truth = load_npz(ROOT / "scenes" / "demo" / "gt.npz")["vertices"][3]
    assert report["counts"]["2"]["rmse_mm"] == pytest.approx(
        1e3 * np.linalg.norm(truth) / np.sqrt(len(truth)) * report["counts"]["2"]["e3d"], rel=1e-5
    )
    assert (tmp_path / "stability_demo.png").read_bytes().startswith(b"\x89PNG")
    assert "stability_demo.json" in capsys.readouterr().out


def test_the_lit_sheet_keeps_its_lengths_and_is_the_truth():
    truth = load_npz(ROOT / "scenes" / "demo_lit" / "gt.npz")
    made = np.array([lit.sheet(t / (lit.FRAMES - 1)) for t in range(lit.FRAMES)])
    assert np.abs(truth["vertices"] - made).max() < 1e-6
    edges = np.diff(made[:, truth["faces"]], axis=2)
    lengths = np.linalg.norm(edges, axis=3)
    assert np.abs(lengths / lengths[0] - 1).max() < 0.01  # chords of a curve
    assert np.ptp(made[-1], axis=0)[2] > 0.05


def test_iteration_times_every_part(capsys):
    found = iteration.main(["--turns", "2"])
    assert len(found) == 9 and all(x > 0 for x in found.values())
    table = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0].strip("| ") for line in table[2:]] == list(found)


def test_scaling_tracks_the_sheet_that_it_makes(tmp_path):
    sheet = scaling.Surface(POINTS, POINTS)
    scaling.make(str(tmp_path), sheet, (160, 120), 3)
    with np.load(tmp_path / "gt.npz") as truth:
        vertices, faces = truth["vertices"], truth["faces"]
    a, b = vertices[:, faces], np.roll(vertices[:, faces], -1, axis=2)
    lengths = np.linalg.norm(a - b, axis=3)
    assert np.abs(lengths / lengths[0] - 1).max() < 0.01  # chords of a cylinder
    found = scaling.measure(str(tmp_path))
    assert len(found["seconds"]) == len(found["cpu"]) == len(found["evaluations"]) == 2
    moved = 1e3 * np.linalg.norm(vertices[-1] - vertices[0], axis=1).mean()
    assert 0 < found["rmse_mm"][-1] < 0.1 * moved and found["peak_mb"] >= found["started_mb"]
    case = scaling.summarise(
        sheet, "160x120", {**found, "versions": {"variant": "v", "machine": "m"}}
    )
    pleated = {**case, "vertices": 100, "pleats": 2, "patches": 4}
    text = scaling.report([case, {**case, "vertices": 4}, pleated], str(tmp_path), 3)
    assert (
        "| 81 | 160×120 |" in text
        and "| 100 | 4 | 160×120 |" in text
        and (tmp_path / "scaling.md").read_text(encoding="utf-8") == text
        and (tmp_path / "scaling.png").exists()
    )


def test_pleats_are_drawn_apart_and_keep_their_lengths():
    pleats = scaling.Surface(120, 6, 3)
    start, end = (pleats.at((640, 480), t) for t in (0, 1))
    faces, uv = pleats.faces_and_uv()
    sides = [np.linalg.norm(np.diff(v[faces], axis=1), axis=2) for v in (start, end)]
    assert np.abs(sides[1] / sides[0] - 1).max() < 0.01  # chords of a curve
    hanging_over = lambda v: np.diff(v.reshape(6, 120, 3)[0, :, 0]).min() < 0
    assert hanging_over(start) and not hanging_over(end)
    assert np.ptp(end[:, 0]) > 1.3 * np.ptp(start[:, 0]) and len(uv) == len(start) == 720
    assert Cover.of(start, faces).patch.max() == 5  # each half of a pleat


def test_poses_of_a_print_are_found_again(tmp_path):
    write_png(tmp_path / "frames" / "000.png", rendered(photo())[0])
    (tmp_path / "camera.json").write_text(json.dumps(dataclasses.asdict(CAMERA)))
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9)))
    R, shift = placed()
    points = np.column_stack([u * WIDTH, v * HEIGHT, 0 * u]) @ R.T + shift
    faces = [(k, k + 1, k + 10, k + 9) for k in range(71) if k % 9 != 8]
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*p) for p in points]
    lines += [f"vt {a + 0.5:.6f} {0.5 - b:.6f}" for a, b in zip(u, v, strict=True)]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in faces]
    (tmp_path / "template.obj").write_text("\n".join(lines) + "\n")
    rows, sure = outline.measure(str(tmp_path), 2)
    assert rows.shape == (2, 4) and sure == 2
    assert (
        rows[:, 0].min() > 1 and rows[:, 2].max() < 0.2 and (rows[:, 3] < 0.25 * rows[:, 1]).all()
    )


def test_the_network_alone_is_timed_with_its_vertices():
    import torch

    import onefit

    speed = load("benchmarks/onefit_speed.py")
    draper = onefit.load("six-garments")
    garment, motion = draper.garment("tank"), onefit.Motion.generate("walk", seconds=0.7, seed=1)
    made = speed.network_alone(draper, garment, motion)
    alone = draper.drape(garment, motion, post=False, eased=False).vertices
    assert torch.allclose(made, alone, atol=1e-5)
    assert not torch.allclose(alone, draper.drape(garment, motion, post=False).vertices, atol=1e-4)
    assert speed.network_alone(draper, garment, motion, vertices=False) is None
