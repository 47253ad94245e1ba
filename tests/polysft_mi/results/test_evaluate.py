"""The evaluate command: the same figures as the benchmark's own scorer, and one line for what
cannot be scored.
"""

import json
import math
import os
import sys

import numpy as np
import pytest
from places import ROOT
from processes import python

from polysft_mi import evaluate
from polysft_mi.errors import InputError
from polysft_mi.results import evaluation
from polysft_mi.results.truth import Truth, find_truth, read_surface

SHARED = os.path.join(os.path.dirname(ROOT), "shared")
SCORER = os.path.join(SHARED, "tools", "score_sft.py")
needs_scorer = pytest.mark.skipif(
    not os.path.exists(SCORER), reason="needs ../shared/tools/score_sft.py and ../shared/data"
)


def agree(surface, truth, tmp_path):
    """Both programs on the same surface; every figure of the scorer, found in ours to 1e-6."""
    np.savez(tmp_path / "surface.npz", **surface)
    theirs = json.loads(python(SCORER, tmp_path / "surface.npz", truth, "--json").stdout)
    ours = evaluation.evaluate(tmp_path, truth)
    assert len(theirs) >= 3
    for name, value in theirs.items():
        if isinstance(value, dict):
            assert set(ours[name]) == set(value)
            assert all(math.isclose(ours[name][k], v, rel_tol=1e-6) for k, v in value.items()), name
        else:
            assert math.isclose(ours[name], value, rel_tol=1e-6), (name, ours[name], value)
    return ours


def bent(V, rng, size):
    """Perturbed surfaces (T, N, 3): smooth bending and noise, as float32."""
    wave = size * np.sin(20 * V + rng.uniform(0, 6, size=(len(V), 1, 3)))[..., ::-1]
    return (V + wave + 0.2 * size * rng.normal(size=V.shape)).astype(np.float32)


@needs_scorer
def test_agrees_with_the_scorer_on_meshes(tmp_path):
    truth = os.path.join(SHARED, "data", "cloth", "bend", "gt.npz")
    gt = np.load(truth)
    frames = np.array([2, 5, 11, 30, 44, 60])  # one past the end of the truth
    V = bent(gt["vertices"][np.minimum(frames, 44)], np.random.default_rng(0), 0.004)
    ours = agree({"vertices": V, "faces": gt["faces"], "frames": frames}, truth, tmp_path)
    assert ours["frames"] == 5 and 2 < ours["rmse_mm"] < 10


def sheet_in_view(points, n=25):
    """A sheet through points (P, 3): a quadratic fit of their depth over their directions, smaller
    than their extent.
    """
    xy = points[:, :2] / points[:, 2:]
    basis = lambda p: np.stack(
        [p[:, 0] ** i * p[:, 1] ** j for i in range(3) for j in range(3 - i)], 1
    )
    c = np.linalg.lstsq(basis(xy), points[:, 2], rcond=None)[0]
    low, high = np.quantile(xy, [0.1, 0.9], axis=0)
    u, v = np.meshgrid(*(np.linspace(low[k], high[k], n) for k in (0, 1)))
    p = np.stack([u.ravel(), v.ravel()], 1)
    k = np.arange(n * n).reshape(n, n)
    F = np.stack(
        [k[:-1, :-1], k[1:, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:], k[:-1, 1:]], -1
    ).reshape(-1, 3)
    return np.column_stack([p, np.ones(len(p))]) * (basis(p) @ c)[:, None], F


@needs_scorer
def test_agrees_with_the_scorer_on_depth_points(tmp_path):
    folder = os.path.join(SHARED, "data", "kinect_paper")
    gt = np.load(os.path.join(folder, "gt_points.npz"))
    sheets = [sheet_in_view(P.astype(float)) for P in gt["points"][:5]]
    V = bent(np.stack([V for V, _ in sheets]), np.random.default_rng(1), 0.003)
    surface = {"vertices": V, "faces": sheets[0][1], "frames": gt["frames"][:5]}
    ours = agree(surface, os.path.join(folder, "gt_points.npz"), tmp_path)
    assert ours["frames"] == 5 and 0.3 < ours["hit"] < 0.95 and "depth_rmse_allpix_mm" in ours
    assert (
        evaluation.evaluate(tmp_path, folder) == ours
    )  # the sequence's folder names the same truth


@needs_scorer
def test_agrees_with_the_scorer_on_clouds(tmp_path):
    folder = os.path.join(SHARED, "data", "phi_sft_R1")
    clouds = [
        np.load(os.path.join(folder, "clouds", f"cloud_{k:03d}.npz"))["points"].astype(float)
        for k in (0, 6)
    ]
    sheets = [sheet_in_view(P) for P in clouds]
    V = bent(np.stack([V for V, _ in sheets]), np.random.default_rng(2), 0.003)
    surface = {"vertices": V, "faces": sheets[0][1], "frames": np.array([0, 6])}
    ours = agree(surface, os.path.join(folder, "clouds"), tmp_path)
    assert ours["frames"] == 2 and ours["chamfer_1e4"] > 0


@pytest.fixture
def run_folder(tmp_path):
    """A run's folder and its truth, a triangle that is 1 cm too far in two frames."""
    G = np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]]] * 2, dtype=np.float32)
    F = np.array([[0, 1, 2]])
    (tmp_path / "out").mkdir()
    (tmp_path / "seq").mkdir()
    np.savez(
        tmp_path / "out" / "surface.npz",
        vertices=G + np.float32([0, 0, 0.01]),
        faces=F,
        frames=np.arange(2),
    )
    np.savez(tmp_path / "seq" / "gt.npz", vertices=G, faces=F)
    return tmp_path


def test_table_and_json_with_image_figures(run_folder, capsys):
    def printed(*arguments):
        assert evaluate.main([str(a) for a in arguments]) == 0
        seen = capsys.readouterr()
        assert seen.err == ""
        return seen.out

    (run_folder / "out" / "metrics.json").write_text(
        json.dumps({"psnr": 31.25, "ssim": 0.9, "time_s": 3, "psnr_frames": [1, 2]})
    )
    shown = printed(run_folder / "out", run_folder / "seq")
    table = dict(line.rsplit("  ", 1) for line in shown.splitlines())
    assert float({k.strip(): v for k, v in table.items()}["vertex RMSE [mm]"]) == pytest.approx(
        10, rel=1e-4
    )
    figures = json.loads(printed(run_folder / "out", run_folder / "seq" / "gt.npz", "--json"))
    assert (
        figures["psnr"] == 31.25
        and figures["ssim"] == 0.9
        and "time_s" not in figures
        and "psnr_frames" not in figures
    )
    assert figures["frames"] == 2 and figures["rmse_mm"] == pytest.approx(10, rel=1e-4)
    without = evaluation.evaluate(run_folder / "out" / "surface.npz", run_folder / "seq")
    assert "psnr" not in without


def test_a_terminal_gets_a_drawn_table(run_folder, monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert evaluate.main([str(run_folder / "out"), str(run_folder / "seq")]) == 0
    out = capsys.readouterr().out
    assert "vertex RMSE [mm]" in out and any(c in out for c in "┃│┏+|")


def test_finds_the_truth_of_a_folder(tmp_path):
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "cloud_004.npz").write_bytes(b"")
    assert find_truth(str(tmp_path)) == str(tmp_path / "clouds")
    assert find_truth(str(tmp_path / "clouds")) == str(tmp_path / "clouds")
    (tmp_path / "gt_points.npz").write_bytes(b"")
    assert find_truth(str(tmp_path)) == str(tmp_path / "gt_points.npz")
    (tmp_path / "gt.npz").write_bytes(b"")
    assert find_truth(str(tmp_path)) == str(tmp_path / "gt.npz")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no ground truth"):
        find_truth(str(tmp_path / "empty"))


GOOD = dict(vertices=np.ones((2, 3, 3)), faces=np.array([[0, 1, 2]]), frames=np.arange(2))


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(frames=None), "holds no frames"),
        (dict(vertices=np.ones((2, 3))), r"vertices \(2, 3\)"),
        (dict(frames=np.arange(3)), r"frames \(3,\)"),
        (dict(vertices=np.ones((0, 3, 3)), frames=np.arange(0)), "T > 0"),
        (dict(faces=np.array([[0, 1, 3]])), "0 to 2 exist"),
        (dict(faces=np.array([[0.0, 1, 2]])), "float64"),
        (dict(vertices=np.full((2, 3, 3), np.inf)), "not finite"),
        (dict(frames=np.array([4, 4])), "surface.npz: frames holds 4 more than once"),
        (dict(up="y"), "surface.npz: an export with y up; the surface.npz of the run"),
    ],
)
def test_refuses_a_surface_of_another_form(tmp_path, change, words):
    arrays = {k: v for k, v in {**GOOD, **change}.items() if v is not None}
    np.savez(tmp_path / "surface.npz", **arrays)
    with pytest.raises(InputError, match=words):
        read_surface(str(tmp_path))
    truth = Truth("gt.npz", "mesh", dict(enumerate(GOOD["vertices"])), GOOD["faces"])
    with pytest.raises(InputError, match=f"^surface: .*{words.removeprefix('surface.npz: ')}"):
        evaluation.score(arrays, truth)


@pytest.mark.parametrize(
    "arrays, words",
    [
        (dict(vertices=np.ones((3, 3)), faces=GOOD["faces"]), r"vertices \(3, 3\)"),
        (dict(vertices=np.full((2, 3, 3), np.nan), faces=GOOD["faces"]), "not finite"),
        (dict(GOOD, frames=np.arange(3)), r"frames \(3,\)"),
        (dict(points=np.ones((2, 4, 2)), frames=np.arange(2)), r"points \(2, 4, 2\)"),
        (dict(points=np.ones((2, 4, 3)), frames=np.arange(2), K=np.eye(2)), r"K \(2, 2\)"),
    ],
)
def test_refuses_a_truth_of_another_form(run_folder, arrays, words):
    np.savez(run_folder / "truth.npz", **arrays)
    with pytest.raises(InputError, match=words):
        evaluate.main([str(run_folder / "out"), str(run_folder / "truth.npz")])


def test_a_truth_may_name_its_frames(run_folder):
    """As the surface.npz of another run does, which began later."""
    V, F = np.load(run_folder / "seq" / "gt.npz")["vertices"], GOOD["faces"]
    later = np.stack([V[1] + np.float32([0, 0, 0.03]), V[1]])
    np.savez(run_folder / "later.npz", vertices=later, faces=F, frames=np.arange(1, 3))
    figures = evaluation.evaluate(run_folder / "out", run_folder / "later.npz")
    assert figures["frames"] == 1 and figures["rmse_mm"] == pytest.approx(20, rel=1e-4)


def test_bad_input_is_told(run_folder):
    for out, truth in [("nowhere", "seq"), ("seq", "seq"), ("out", "nowhere"), ("out", "out")]:
        with pytest.raises(InputError) as caught:
            evaluate.main([str(run_folder / out), str(run_folder / truth)])
        assert "\n" not in str(caught.value)
    (run_folder / "out" / "metrics.json").write_text("{")
    with pytest.raises(InputError, match="metrics.json: not JSON"):
        evaluate.main([str(run_folder / "out"), str(run_folder / "seq")])


ORDER = np.random.default_rng(0).permutation(64)


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda V, F: (1000 * V, F), "1e+03 times as large as the surface"),
        (lambda V, F: (V * (1, -1, -1), F), "lies behind the camera"),
        (lambda V, F: (V[:, ORDER], np.argsort(ORDER)[F]), "its faces join other vertices"),
    ],
)
def test_truth_that_cannot_be_of_the_surface_is_told(change, said, tmp_path):
    x, y = np.meshgrid(*2 * [np.linspace(0, 0.3, 8)], indexing="ij")
    V = np.stack([x, y, 1 + x * y], -1).reshape(1, -1, 3)
    V[0, :5, 2] += 0.1  # nothing is symmetric
    a = np.arange(64).reshape(8, 8)
    corners = a[:-1, :-1], a[1:, :-1], a[1:, 1:], a[:-1, 1:]
    p, q, r, s = (c.ravel() for c in corners)
    F = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    surface = {"vertices": V, "faces": F, "frames": np.array([0])}
    other, faces = change(V, F)
    np.savez(tmp_path / "gt.npz", vertices=other, faces=faces)
    with pytest.raises(InputError) as error:
        evaluation.score(surface, tmp_path / "gt.npz")
    assert said in str(error.value)
    # quads that are cut the other way are the same surface
    cut = np.concatenate([np.stack([p, q, s], 1), np.stack([q, r, s], 1)])
    np.savez(tmp_path / "gt.npz", vertices=V, faces=cut)
    assert evaluation.score(surface, tmp_path / "gt.npz")["rmse_mm"] < 1e-6


def test_points_that_no_ray_of_the_surface_meets_are_told(tmp_path):
    V = np.array([[[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1.0]]])
    surface = {"vertices": V, "faces": np.array([[0, 1, 2]]), "frames": np.array([0])}
    np.savez(tmp_path / "gt.npz", points=np.full((1, 9, 3), [5, 5, 1.0]), frames=[0])
    with pytest.raises(InputError, match="no point lies on a ray that meets the surface"):
        evaluation.score(surface, tmp_path / "gt.npz")
