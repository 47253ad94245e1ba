"""Comparisons of runs and of runs with the truth: figures, and pictures whose values are known."""

import json
import shutil

import cv2
import numpy as np
import OpenEXR
import pytest

from polyfit.pictures import Triangles
from polysft_mi import compare
from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.pictures import comparison as drawn
from polysft_mi.pictures import figures
from polysft_mi.pictures.exr import read_exr
from polysft_mi.results import comparison
from polysft_mi.results.evaluation import evaluate
from polysft_mi.results.metrics import ray_depth
from polysft_mi.results.run import Run


@pytest.fixture
def moved(finished_run, tmp_path):
    """A copy of the run whose surfaces lie 2 mm nearer to the camera, and a function that changes
    its surface.npz.
    """
    out = tmp_path / "moved"
    shutil.copytree(finished_run[1], out)

    def change(**arrays):
        with np.load(out / "surface.npz") as file:
            kept = {name: file[name] for name in file}
        np.savez(out / "surface.npz", **{**kept, **arrays})

    change(vertices=Run.open(out).vertices - np.float32([0, 0, 0.002]))
    return out, change


def test_what_the_camera_sees_agrees_with_rays(finished_run):
    run = Run.open(finished_run[1])
    V, F = run.vertices[-1].astype(float), run.faces.astype(int)
    camera = Intrinsics(25, 23, 10.2, 7, 20, 15)
    depth, x, height = Triangles(V, F).seen(camera, [V[:, 0], 2 * V[:, 2] + 1])
    rows, columns = np.mgrid[:15, :20]
    rays = np.stack(
        [
            (columns.ravel() + 0.5 - camera.cx) / camera.fx,
            (rows.ravel() + 0.5 - camera.cy) / camera.fy,
            np.ones(300),
        ],
        1,
    )
    expected = ray_depth(V, F, rays).reshape(15, 20)
    inside = np.isfinite(expected) & np.isfinite(depth)
    assert (np.isfinite(expected) != np.isfinite(depth)).mean() < 0.02 < inside.mean()
    np.testing.assert_allclose(depth[inside], expected[inside], atol=5e-5)
    np.testing.assert_allclose(
        x[inside], (expected * rays[:, 0].reshape(15, 20))[inside], atol=5e-5
    )  # perspective: x = z times the ray's
    np.testing.assert_allclose(height[inside], 2 * expected[inside] + 1, atol=5e-5)
    twice = np.concatenate([F, F + len(V)])
    (again,) = Triangles(np.concatenate([V, V * (1, 1, -1)]), twice).seen(camera)  # and behind
    np.testing.assert_array_equal(again, depth)
    (nearer,) = Triangles(np.concatenate([V, 0.9 * V]), twice).seen(camera)
    np.testing.assert_allclose(nearer[inside], 0.9 * depth[inside], rtol=1e-5)


@pytest.mark.parametrize(("line", "said"), [("3", "a line is no JSON"), ("{", "not JSON lines")])
def test_a_log_that_is_no_log_is_told(finished_run, tmp_path, line, said):
    out = shutil.copytree(finished_run[1], tmp_path / "out")
    (out / "log.jsonl").write_text(line + "\n")
    with pytest.raises(InputError, match=said):
        Run.open(out).log()


def test_a_run_against_the_truth_has_the_figures_of_evaluate(finished_run):
    truth, out = finished_run
    ours, theirs = (
        comparison.compare(str(out), str(truth.folder)).figures,
        evaluate(str(out), str(truth.folder)),
    )
    for name in ("rmse_mm", "rmse_mm_worst", "e3d", "e3d_proc", "en_deg"):
        assert ours["difference"][name] == pytest.approx(theirs[name])
    assert ours["frames"] == 4 and ours["own"] == {}


def test_two_runs(finished_run, moved, tmp_path, capsys):
    out, b = finished_run[1], moved[0]
    options = "-o", str(tmp_path / "pictures"), *"--frames 2 --scale 4 --json".split()
    assert compare.main([str(out), str(b), *options]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["difference"]["rmse_mm"] == pytest.approx(2, abs=1e-3) and printed["difference"][
        "depth_difference_mm"
    ] == pytest.approx(2, rel=0.1)
    assert printed["own"]["psnr_mask"] == [Run.open(out).metrics["psnr_mask"]] * 2
    folder = tmp_path / "pictures"
    wanted = "000.exr 000.png 003.exr 003.png compare.json figures.png".split()
    assert sorted(p.name for p in folder.iterdir()) == wanted
    assert json.loads((folder / "compare.json").read_text())["false_colour_mm"] == 4
    layers, header = read_exr(folder / "003.exr")
    assert (header["frame"], header["a"], header["b"], header["false_colour_mm"]) == (
        3,
        str(out),
        str(b),
        4,
    )
    assert "mitsuba" in header and "chromaticities" in header
    distance, difference = layers["distance"][..., 0], layers["depth_difference"][..., 0]
    inside = np.isfinite(difference)
    np.testing.assert_allclose(distance[np.isfinite(distance)], 0.002, atol=5e-5)
    assert np.median(difference[inside]) == pytest.approx(0.002, rel=0.05)  # A lies farther away
    np.testing.assert_allclose(
        layers["depth_a"] - layers["depth_b"], layers["depth_difference"], atol=5e-5
    )
    run_layers = read_exr(out / "comparison" / "003.exr")[0]
    np.testing.assert_array_equal(layers["a"], run_layers["render"])
    np.testing.assert_array_equal(layers["target"], run_layers["target"])
    assert (layers["difference"] == 0).all()
    own = (
        np.isfinite(run_layers["depth"][..., 0])
        & (run_layers["depth"][..., 0] > 0)
        & np.isfinite(layers["depth_a"][..., 0])
    )
    assert (
        own.mean() > 0.1 and np.abs(run_layers["depth"] - layers["depth_a"])[own].max() < 1e-4
    )  # Mitsuba's depth is ours
    with OpenEXR.File(str(folder / "003.exr"), separate_channels=True) as file:
        names = set(file.channels())
    known = "target.R a.R b.R difference.R distance.Y depth_a.Z depth_difference.Z false_colour.R"
    assert {*known.split(), *"RGB"} <= names
    colour = layers["false_colour"][np.isfinite(distance)]
    np.testing.assert_allclose(
        colour,
        np.broadcast_to(
            figures.false_colour("distance", np.full((1, 1), 2.0), 4.0)[0, 0], colour.shape
        ),
        atol=6e-3,
    )  # half, and a colour map of 256 steps
    image = cv2.imread(str(folder / "003.png"))
    viridis = np.array([140, 145, 33])  # B, G, R at the middle of the scale
    assert (np.abs(image.astype(int) - viridis).max(-1) < 12).sum() > 1000


def test_surfaces_of_other_vertices_are_compared_in_depth(finished_run, moved):
    out, (b, change) = finished_run[1], moved
    run = Run.open(b)
    half = run.faces[: len(run.faces) // 2]
    change(faces=half)
    made = comparison.compare(str(out), str(b))
    ours = made.figures
    assert set(ours["difference"]) == {"depth_difference_mm", "depth_difference_mm_worst", "shared"}
    assert ours["difference"]["depth_difference_mm"] == pytest.approx(
        2, rel=0.1
    ) and "distance" not in drawn.difference_maps(made, 0)


def test_against_points_and_clouds(finished_run, tmp_path):
    run = Run.open(finished_run[1])
    points = run.vertices[2:3, ::5] * np.float32(1.01)
    np.savez(tmp_path / "points.npz", points=points, frames=[2])
    made = comparison.compare(run.folder, str(tmp_path / "points.npz"))
    ours = made.figures
    assert ours["difference"]["depth_rmse_mm"] == pytest.approx(
        1e3 * np.sqrt(((0.01 * run.vertices[2, ::5, 2]) ** 2).mean()), rel=0.05
    )
    map_ = drawn.difference_maps(made, 2)["depth_difference"]
    assert 5 < np.isfinite(map_).sum() <= points.shape[1] and np.nanmedian(map_) == pytest.approx(
        -0.01 * np.median(run.vertices[2, :, 2]), rel=0.2
    )
    drawn.write_comparison(made, tmp_path / "p")
    wanted = "002.exr 002.png compare.json figures.png".split()
    assert sorted(p.name for p in (tmp_path / "p").iterdir()) == wanted
    (tmp_path / "clouds").mkdir()
    np.savez(
        tmp_path / "clouds" / "cloud_1.npz", points=run.vertices[1] + np.float32([0, 0, 0.003])
    )
    made = comparison.compare(run.folder, str(tmp_path / "clouds"))
    ours = made.figures
    distance = drawn.difference_maps(made, 1)["distance"]
    assert np.nanmax(distance) <= 0.003 + 1e-6 and ours["difference"]["chamfer_1e4"] > 0


def test_refusals_leave_nothing(finished_run, moved, tmp_path):
    truth, out = finished_run
    b, change = moved
    (b / "camera.json").unlink()
    with pytest.raises(InputError, match="holds no camera.json"):
        compare.main([str(b), str(out), "-o", str(tmp_path / "p")])
    change(frames=np.arange(10, 14))
    with pytest.raises(InputError, match="no frame in common"):
        compare.main([str(b), str(out)])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "000.png").write_text("mine")
    for arguments, words in [
        ([str(out), str(tmp_path / "mine")], "holds no ground truth"),
        ([str(truth.folder), str(out)], "not the folder of a run"),
        ([str(out), str(truth.folder), "--frames", "0"], "--frames 0: at least one"),
        ([str(out), str(truth.folder), "--scale", "-1"], "--scale -1: a positive number"),
        ([str(out), str(truth.folder), "-o", str(tmp_path / "a" / "b")], "no such folder"),
        ([str(out), str(truth.folder), "-o", str(tmp_path / "mine")], "holds other files"),
    ]:
        with pytest.raises(InputError, match=words):
            compare.main(arguments)
    assert (
        sorted(p.name for p in tmp_path.iterdir()) == ["mine", "moved"]
        and (tmp_path / "mine" / "000.png").exists()
    )
