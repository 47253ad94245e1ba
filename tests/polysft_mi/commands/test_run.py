"""The whole way, from a scene file to what a run leaves: on a small sheet whose true surface is
known.
"""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import synthetic
import trimesh
from places import ROOT

from polyfit.colours import linear, srgb
from polysft_mi import demo, prepare, run
from polysft_mi.pictures import exr
from polysft_mi.results.evaluation import evaluate, score
from polysft_mi.tracker import FrameTracker

GAUSS_NEWTON = ["--no-report"]
PAPER = ["-D", "preset=paper", "-D", "canonical_frame=pca"]
QUICK = [*GAUSS_NEWTON, *PAPER, "-D", "period=4"]
SOLVERS = {"adam": QUICK, "gauss-newton": GAUSS_NEWTON}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A sheet that bends and moves, as a folder with its scene.xml."""
    truth = synthetic.cloth(tmp_path_factory.mktemp("run") / "sheet", frames=6, bend=2.5, turn=0.1)
    prepare.main([str(truth.folder)])
    return truth


@pytest.fixture(scope="module")
def result(sequence, tmp_path_factory):
    return ran(sequence.folder, tmp_path_factory.mktemp("out") / "full", "--exr", "3")


def ran(folder, out, *options):
    """The folder ``out`` of a run, which ends well."""
    assert run.main([str(folder / "scene.xml"), "-o", str(out), "-q", *options]) == 0
    return out


def surface(out):
    with np.load(out / "surface.npz") as data:
        return {k: data[k] for k in data}


def test_reconstruction_is_right(sequence, result):
    figures = evaluate(str(result), str(sequence.folder))
    still = {
        "vertices": np.repeat(sequence.vertices[:1], 6, 0),
        "faces": sequence.faces,
        "frames": np.arange(6),
    }
    start = score(still, str(sequence.folder / "gt.npz"))
    assert figures["frames"] == 6
    assert figures["e3d_proc"] < 0.5 * start["e3d_proc"]
    assert figures["rmse_mm"] < 3.0 and figures["en_deg"] < 0.7 * start["en_deg"]
    assert figures["psnr_mask"] > 30 and figures["ssim_mask"] > 0.95


def test_surface_keeps_the_templates_vertices_and_faces(sequence, result):
    s = surface(result)
    assert s["vertices"].shape == sequence.vertices.shape and s["vertices"].dtype == np.float32
    assert np.array_equal(s["faces"], sequence.faces)
    assert np.array_equal(s["frames"], np.arange(6))
    assert np.abs(s["uv"] - sequence.uv).max() < 1e-6


def test_files_of_a_run(sequence, result):
    assert sorted(f.name for f in (result / "meshes").iterdir()) == [
        f"{k:03d}.ply" for k in range(6)
    ]
    mesh = trimesh.load(result / "meshes" / "003.ply", process=False)
    assert np.abs(mesh.vertices - surface(result)["vertices"][3]).max() < 1e-6
    names = sorted(f.name for f in (result / "comparison").iterdir())
    assert names == ["000.exr", "002.exr", "005.exr"]
    layers, header = exr.read_exr(result / "comparison" / "005.exr")
    one = "error residual mask_target mask_render depth patch".split()
    channels = dict.fromkeys(one, 1) | {"target": 3, "render": 3, "normal": 3, "uv": 2}
    assert {k: v.shape for k, v in layers.items()} == {k: (72, 96, c) for k, c in channels.items()}
    inside = layers["mask_render"][..., 0] > 0.999
    V = surface(result)["vertices"][5]
    assert np.abs(layers["depth"][inside].ravel() - V[:, 2].mean()).max() < np.ptp(V[:, 2])
    assert (layers["normal"][inside][:, 2] < 0).all()  # towards the camera
    assert layers["uv"][inside].min() >= 0 and layers["uv"][inside].max() <= 1
    assert header["frame"] == 5
    for name in ("loss.png", "comparison.png"):
        assert (result / name).stat().st_size > 5000
    assert (result / "comparison.mp4").exists()
    figures = json.loads((result / "metrics.json").read_text())
    assert (
        figures["frames"] == 6
        and figures["lost"] == {}
        and figures["versions"]["variant"].endswith("_ad_rgb")
    )
    records = [json.loads(line) for line in (result / "log.jsonl").read_text().splitlines()]
    assert {r["frame"] for r in records} == set(range(6)) and sum("best" in r for r in records) == 6


def test_overrides_may_be_numbers_and_the_last_line_says_what_is_next(sequence, tmp_path):
    scene, settings = sequence.folder / "scene.xml", {"last": 1, "k_mi": 0.5, "solver": "adam"}
    outcome = run.reconstruct(scene, tmp_path / "out", settings | {"period": 4}, report=False)
    assert outcome.summary["frames"] == 2
    text = (tmp_path / "out" / "scene.xml").read_text()
    assert re.search(r'name="k_mi" value="0.5" ?/>', text)
    video = tmp_path / "out" / "comparison.mp4"
    assert outcome.as_text().splitlines()[-1] == f"next: open {video}" and video.exists()
    stopped = dataclasses.replace(outcome, interrupted=True)
    assert "--resume" in stopped.as_text().splitlines()[-1]


def test_the_demo_runs_from_the_package_and_from_anywhere(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert demo.main(["-q", "-D", "last=0", "-D", "solver=adam", "-D", "period=2"]) == 0
    *_, last = capsys.readouterr().out.splitlines()
    assert last == f"next: open {os.path.join('out', 'demo', 'report.html')}"
    assert os.path.getsize(last.removeprefix("next: open ")) > 100_000
    figures = evaluate("out/demo", os.path.join(os.path.dirname(demo.SCENE), "demo"))
    assert figures["rmse_mm"] < 20
    assert os.path.samefile(demo.SCENE, ROOT / "scenes" / "demo.xml")  # one place for the data


def test_resolved_scene_runs_from_anywhere(result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run.main([str(result / "scene.xml"), "-o", "again", "-q", "-D", "last=1", *QUICK]) == 0
    assert surface(tmp_path / "again")["vertices"].shape[0] == 2


@pytest.mark.parametrize(
    "solver, kept", [pytest.param("adam", 3, marks=pytest.mark.slow), ("gauss-newton", 1)]
)
def test_resume_ends_with_the_same_result(sequence, tmp_path, monkeypatch, solver, kept):
    arguments = [str(sequence.folder / "scene.xml"), "-q", "-D", "last=3", *SOLVERS[solver]]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run.main([*arguments, "-o", str(whole)]) == 0

    solve, calls = FrameTracker.solve, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return solve(*args)

    monkeypatch.setattr(FrameTracker, "solve", interrupted)
    assert run.main([*arguments, "-o", str(parts)]) == 130
    assert (
        surface(parts)["vertices"].shape[0] == kept
    )  # one window, of three frames or of one: valid, and shorter
    assert json.loads((parts / "metrics.json").read_text())["frames"] == kept
    monkeypatch.setattr(FrameTracker, "solve", solve)
    assert run.main([*arguments, "-o", str(parts), "--resume"]) == 0
    a, b = surface(whole), surface(parts)
    assert a["vertices"].shape == b["vertices"].shape
    assert np.abs(a["vertices"] - b["vertices"]).max() < 1e-5
    windows = json.loads((whole / "metrics.json").read_text())["windows"]
    assert windows and not any(
        isinstance(x, list) for w in windows for x in w.values()
    )  # numbers alone: what a solver keeps for itself is no figure
    assert ("sigma" in a) == (solver == "gauss-newton") and all(
        np.array_equal(a[name], b[name]) for name in a
    )
    lines = [(out / "log.jsonl").read_text().count("\n") for out in (whole, parts)]
    assert lines[0] == lines[1]


def test_ctrl_c_leaves_a_valid_shorter_result(sequence, tmp_path):
    words = sys.executable, "-m", "polysft_mi.run"
    out, long = tmp_path / "out", ["-D", "patience=100000", "-D", "period=30"]
    process = subprocess.Popen(
        [*words, sequence.folder / "scene.xml", "-o", out, *QUICK, *long],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        # a shell's background jobs inherit that it is ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    checkpoint = out / "checkpoint.npz"
    deadline = time.time() + 120
    while not checkpoint.exists() and time.time() < deadline and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert "frames are kept; --resume continues" in stderr and "Traceback" not in stderr
    assert 3 <= surface(out)["vertices"].shape[0] < 6
    assert np.isfinite(surface(out)["vertices"]).all()


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_frame_that_breaks_the_loss_is_reported_and_passed_over(
    sequence, tmp_path, capsys, monkeypatch, solver
):
    from polysft_mi.scene.sequence import Sequence

    frame = Sequence.frame
    monkeypatch.setattr(
        Sequence, "frame", lambda self, i: frame(self, i) * (np.nan if i == 3 else 1)
    )
    out = ran(sequence.folder, tmp_path / "out", "-D", "last=4", *SOLVERS[solver])
    err = capsys.readouterr().err
    assert (
        "frame 3: the loss is nan from the start; it keeps the state of the frame before" in err
        and err.count("\n") == 1
    )
    s = surface(out)
    assert np.isfinite(s["vertices"]).all() and s["vertices"].shape[0] == 5
    assert np.array_equal(s["vertices"][3], s["vertices"][2])
    assert list(json.loads((out / "metrics.json").read_text())["lost"]) == ["3"]
    assert (
        np.abs(s["vertices"][4] - s["vertices"][2]).max() > 1e-3
    )  # the frames after it are tracked on


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_frame_without_a_mask_is_reported_and_passed_over(sequence, tmp_path, capsys, solver):
    folder = shutil.copytree(sequence.folder, tmp_path / "sheet")
    mask = sorted((folder / "masks").iterdir())[2]
    cv2.imwrite(str(mask), np.zeros((72, 96), np.uint8))
    out = ran(folder, tmp_path / "out", "-D", "last=3", *SOLVERS[solver])
    said = "frame 2: its mask is empty, or nearly; it keeps the state of the frame before"
    assert said in capsys.readouterr().err
    s, figures = surface(out), json.loads((out / "metrics.json").read_text())
    assert np.array_equal(s["vertices"][2], s["vertices"][1]) and list(figures["lost"]) == ["2"]
    if solver == "gauss-newton":
        assert np.isnan(s["sigma"][2]).all()  # nothing is known of it
        off = np.linalg.norm(s["vertices"][3] - sequence.vertices[3], axis=1)
        assert np.median(off) < 0.01 * np.ptp(sequence.vertices[3], axis=0).max()


def test_frames_that_the_surface_does_not_explain_are_called_doubtful(sequence, tmp_path, capsys):
    folder = shutil.copytree(sequence.folder, tmp_path / "sheet")
    frames, random = sorted((folder / "frames").iterdir()), np.random.default_rng(0)
    for path in frames[2:4]:
        cv2.imwrite(str(path), random.integers(0, 255, (72, 96, 3), np.uint8))
    out = ran(folder, tmp_path / "out", "-D", "last=3", *SOLVERS["gauss-newton"])
    assert list(json.loads((out / "metrics.json").read_text())["doubtful"]) == ["2", "3"]
    assert (
        "doubtful: frames 2 to 3: it does not look like the image (SSIM " in capsys.readouterr().out
    )


def linear_grey(image):
    """What a sensor without colours makes of an image (H, W, 3) uint8 BGR, coded as sRGB."""
    return np.round(255 * srgb(linear(image / 255) @ [0.5, 0.3, 0.2])).astype(np.uint8)


def test_a_grey_video_of_a_coloured_sheet_is_tracked(sequence, result, tmp_path, capsys):
    """A sensor's own, and what a program made of a video in colour."""
    own = evaluate(str(result), str(sequence.folder))
    for kind in (linear_grey, lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)):
        folder = shutil.copytree(sequence.folder, tmp_path / "sheet", dirs_exist_ok=True)
        for path in (folder / "frames").iterdir():
            image = cv2.imread(str(sequence.folder / "frames" / path.name))
            assert cv2.imwrite(str(path), kind(image))
        out = ran(folder, tmp_path / "out", "--overwrite", *GAUSS_NEWTON)
        figures = evaluate(str(out), str(folder))
        assert "the frames are grey" in capsys.readouterr().err
        assert figures["rmse_mm"] < 2 * own["rmse_mm"] + 1
        assert figures["psnr_mask"] > 30


def test_how_tracks_and_depth_fit_is_told(sequence, tmp_path, capsys):
    """How much of them was used, their noise, and tracks that are of another video."""
    rng, (count, points) = np.random.default_rng(0), sequence.vertices.shape[:2]
    x = sequence.vertices @ sequence.K.T
    tracks = x[..., :2] / x[..., 2:]
    noisy = tracks + (np.arange(count) > 0)[:, None, None] * rng.normal(0, 0.5, tracks.shape)
    noisy[:, :20] = 2.0  # beside the sheet
    (tmp_path / "depth").mkdir()
    for k, vertices in enumerate(sequence.vertices):
        deep = np.full((72, 96), 1e4 * vertices[:, 2].mean()) + rng.normal(0, 30, (72, 96))
        cv2.imwrite(str(tmp_path / "depth" / f"{k}.png"), np.round(deep).astype(np.uint16))
    np.savez(tmp_path / "tracks.npz", tracks=noisy)
    given = ["-D", f"tracks={tmp_path / 'tracks.npz'}", "-D", "last=2"]
    deep = ["-D", f"depth={tmp_path / 'depth'}", "-D", "depth_unit=0.0001"]
    out = ran(sequence.folder, tmp_path / "out", *GAUSS_NEWTON, *given, *deep)
    said, figures = capsys.readouterr().out, json.loads((out / "metrics.json").read_text())
    found = figures["tracks"]
    assert found["given"] == points and points - 45 < found["used"] <= points - 20
    assert f"tracks: {found['used']} of {points} used, noise {found['noise_px']:.2g} px\n" in said
    assert 0.25 < found["noise_px"] < 1
    assert "depth: 3 of 3 images used, noise " in said and 2 < figures["depth"]["noise_mm"] < 30
    noisy[1:] += 10
    np.savez(tmp_path / "tracks.npz", tracks=noisy)
    out = ran(sequence.folder, tmp_path / "out", *GAUSS_NEWTON, *given, "--overwrite")
    assert " px: are they of this video?\n" in capsys.readouterr().out


def test_a_surface_that_leaves_the_image_is_reported_and_held(
    sequence, tmp_path, capsys, monkeypatch
):
    from polysft_mi.solvers.adam import Adam

    minimise, thrown = Adam.minimise, []

    def thrown_out(self, objective, start, **options):
        result = minimise(self, objective, start, **options)
        if objective.contexts[-1].frame == 3 and not thrown:
            thrown.append(True)
            result.states[-1].translation += 100
        return result

    monkeypatch.setattr(Adam, "minimise", thrown_out)
    out = ran(sequence.folder, tmp_path / "out", *QUICK, "-D", "last=3")
    assert (
        "frame 3: the surface left the image; it keeps the state of the frame before"
        in capsys.readouterr().err
    )
    V = surface(out)["vertices"]
    assert np.array_equal(V[3], V[2])


def test_fewer_frames_than_the_window(sequence, tmp_path):
    out = ran(sequence.folder, tmp_path / "out", *QUICK, "-D", "first=1", "-D", "last=1")
    assert surface(out)["frames"].tolist() == [1]


def test_path_replay_runs_from_the_same_scene(sequence, tmp_path):
    settings = "--no-report -D last=1 -D window=2 -D period=6 -D integrator=prb_projective"
    out = ran(sequence.folder, tmp_path / "out", *PAPER, *settings.split())
    records = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    first = [r for r in records if r["frame"] == 1]
    assert first[-1]["loss"] < first[0]["loss"] and first[-1]["silhouette"] > 0


def test_no_masks(tmp_path):
    truth = synthetic.cloth(
        tmp_path / "sheet", frames=4, size=(240, 180), masks=False, bend=1.5, turn=0.1
    )
    prepare.main([str(truth.folder)])
    # the smooth texture here has little that survives local normalisation
    out = ran(truth.folder, tmp_path / "out", *GAUSS_NEWTON, "-D", "brightness=none")
    figures = score(surface(out), str(truth.folder / "gt.npz"))
    assert figures["rmse_mm"] < 4


def test_the_form_of_phi_sft_with_its_other_frame_and_pixels(tmp_path):
    truth = synthetic.phi_sft(tmp_path / "seq", frames=4, bend=1.0, turn=0.05)
    prepare.main([str(truth.folder)])
    out = ran(truth.folder, tmp_path / "out", *GAUSS_NEWTON)
    # a small picture leaves the depth open; what it shows must fit all the same
    seen, true = (
        v[..., :2] / v[..., 2:] * truth.K[[0, 1], [0, 1]] + truth.K[:2, 2]
        for v in (surface(out)["vertices"], truth.vertices)
    )
    still = np.linalg.norm(true - true[:1], axis=-1)[3].mean()
    assert np.linalg.norm(seen - true, axis=-1).mean() < 0.5 < 0.2 * still


def test_a_camera_elsewhere_gives_the_same_surface(sequence, result, tmp_path):
    """The result is in the camera's frame, wherever the scene puts camera and template."""
    folder = tmp_path / "moved"
    shutil.copytree(sequence.folder, folder)
    text = (folder / "scene.xml").read_text()
    look = '<lookat origin="0, 0, 0" target="0, 0, 1" up="0, -1, 0"/>'
    move = '<rotate y="1" angle="90"/><translate x="1" y="2" z="-0.5"/>'
    assert text.count(look) == 1
    text = text.replace(look, look + move)
    text = text.replace(
        'value="$data/template.obj"/>',
        f'value="$data/template.obj"/><transform name="to_world">{move}</transform>',
    )
    (folder / "scene.xml").write_text(text)
    out = ran(folder, tmp_path / "out", "-D", "last=2", *GAUSS_NEWTON)
    first = surface(result)["vertices"][2]
    assert (
        np.abs(surface(out)["vertices"][2] - first).max()
        < 1e-3
        < np.abs(first[:, 2] - first[0, 2]).max()
    )


@pytest.mark.parametrize("name", ["flag", "kinect_paper", "phi_sft_R1"])
def test_scenes_run_on_their_sequences(name, shared_data, tmp_path):
    folder = shared_data / (name if name in ("kinect_paper", "phi_sft_R1") else f"cloth/{name}")
    out = tmp_path / "out"
    words = [str(ROOT / "scenes" / f"{name}.xml"), "-D", f"data={folder}", "-D", "last=1"]
    assert run.main([*words, "-o", str(out), "-q", *GAUSS_NEWTON]) == 0
    figures = json.loads((out / "metrics.json").read_text())
    assert figures["frames"] == 2 and figures["lost"] == {} and figures["psnr_mask"] > 18
    assert os.path.getsize(out / "comparison.mp4") > 1000
