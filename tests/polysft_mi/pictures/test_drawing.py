"""Pictures drawn by a process of their own are those drawn here, whatever happens to it."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import synthetic
from places import ROOT
from processes import python

from polyfit.pictures import video
from polysft_mi import prepare
from polysft_mi.objective.problem import Problem
from polysft_mi.pictures import exr
from polysft_mi.pictures.album import Album, AlbumSettings, Renderings, residual
from polysft_mi.pictures.drawing import Drawing
from polysft_mi.pictures.panels import COLUMNS, Box, evenly_spaced
from polysft_mi.scene import experiment as scene


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    truth = synthetic.cloth(
        tmp_path_factory.mktemp("drawing") / "sheet", frames=9, bend=2.5, turn=0.1
    )
    prepare.main([str(truth.folder)])
    return truth


def problem_of(sheet):
    experiment = scene.load(str(sheet.folder / "scene.xml"))
    return Problem(experiment, experiment.sequence())


def drawn(sheet, out, during=lambda drawing: None, *, problem=None, **options):
    """(figures of each frame, the video's frames, names of the EXRs): of the true surfaces."""
    problem = problem or problem_of(sheet)
    surfaces = sheet.vertices.astype(np.float32)
    vertices = np.stack([problem.camera.origin + v @ problem.camera.axes for v in surfaces]).astype(
        np.float32
    )
    assert np.allclose(problem.camera.to_camera(vertices), surfaces, atol=1e-6)
    out.mkdir(exist_ok=True)
    options = {"exr_frames": 3, "about": {"scene": "sheet"}} | options
    with Drawing(problem, {}, str(out), **options) as made:
        for k, v in enumerate(vertices):
            made.frame(k, v)
        during(made)
        (out / "log.jsonl").write_text('{"frame": 0, "iteration": 0, "loss": 1.0}\n')
        finished, bound, plotted = made.finish(vertices, surfaces, 15)
        (figures, *_), path = finished(), bound()
        plotted()
        folder = Path(made._folder.name)
    assert (
        not folder.exists()
        and (out / "comparison.png").stat().st_size > 20_000
        and (out / "loss.png").exists()
    )
    return (
        figures,
        np.stack(list(video.read_video(path))),
        sorted(p.name for p in (out / "comparison").glob("*.exr")),
    )


@pytest.fixture(scope="module")
def here(sheet, tmp_path_factory):
    """Drawn in this process."""
    return drawn(sheet, tmp_path_factory.mktemp("here"), worth=10**6)


def assert_same(a, b):
    for x, y in zip(a[0], b[0], strict=True):
        assert x == pytest.approx(y, rel=1e-4)
    assert a[1].shape == b[1].shape and np.abs(a[1].astype(int) - b[1]).mean() < 0.05
    assert a[2] == b[2]


def test_another_process_draws_the_same_and_again_what_changes(sheet, here, tmp_path):
    def spoil(made):
        made.frame(3, sheet.vertices[0].astype(np.float32) + 0.01)
        [job.result() for job in made._jobs]

    found = drawn(sheet, tmp_path / "out", spoil)
    assert_same(found, here)
    assert [f["frame"] for f in found[0]] == list(range(9))
    assert found[2] == ["000.exr", "004.exr", "008.exr"]
    assert found[0][0]["psnr_mask"] > 30
    depth = exr.read_exr(str(tmp_path / "out" / "comparison" / "004.exr"))[0]["depth"]
    assert np.isfinite(depth).all()


def test_another_process_reads_an_exr_texture(sheet, tmp_path):
    """With one Dr.Jit thread, Mitsuba would wait for it for ever."""
    folder = tmp_path / "sheet"
    folder.mkdir()
    for name in ("frames", "masks", "camera.json", "template.obj"):
        (folder / name).symlink_to(sheet.folder / name)
    image = mi.Bitmap(str(sheet.folder / "texture.png"))
    image = image.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    image.write(str(folder / "texture.exr"))
    prepare.main([str(folder)])
    experiment = scene.load(str(folder / "scene.xml"))
    problem = Problem(experiment, experiment.sequence())
    with Drawing(problem, {}, str(tmp_path), exr_frames=0, about={}) as made:
        (job,) = made._jobs or [made._submit()]
        try:
            job.result(timeout=120)
        except TimeoutError:
            for process in made._pool._processes.values():
                process.kill()
            raise


def test_a_killed_process_costs_nothing_but_time(sheet, here, tmp_path):
    def kill(made):
        made._jobs[3].result()
        for pid in made._pool._processes:
            os.kill(pid, signal.SIGKILL)

    assert_same(drawn(sheet, tmp_path / "out", kill), here)


def test_fewer_frames_than_expected(sheet, here, tmp_path):
    """As after Ctrl-C: the EXRs are spread over the frames that there are; others are removed, but
    none that is being written.
    """
    problem = problem_of(sheet)
    surfaces = sheet.vertices[:5].astype(np.float32)
    vertices = np.stack([problem.camera.origin + v @ problem.camera.axes for v in surfaces])
    vertices = vertices.astype(np.float32)
    (tmp_path / "comparison").mkdir()
    others = [tmp_path / "comparison" / name for name in (".1.partial.008.exr", "003.exr")]
    for path in others:
        path.touch()
    with Drawing(problem, {}, str(tmp_path), exr_frames=3, about={}) as made:
        for k, v in enumerate(vertices):
            made.frame(k, v)
        finished, bound, _ = made.finish(vertices, surfaces, 15)
        assert all(path.exists() for path in others)
        figures, *_ = finished()
        assert len(list(video.read_video(bound()))) == 5
    names = sorted(p.name for p in (tmp_path / "comparison").iterdir())
    assert names == ["000.exr", "002.exr", "004.exr"]
    for x, y in zip(figures, here[0]):
        assert x == pytest.approx(y, rel=1e-4)


def test_texture_that_was_moved_is_moved_in_the_pictures(sheet, here, tmp_path):
    problem = problem_of(sheet)
    moved = np.array(problem.experiment.mesh.vertex_texcoords_buffer()) + 0.03
    problem.placed.set_texcoords(mi.Float(moved))
    other = drawn(sheet, tmp_path / "out", problem=problem)
    assert all(a["psnr_mask"] < b["psnr_mask"] - 3 for a, b in zip(other[0], here[0]))


def test_a_surface_that_leaves_the_view_of_the_first_is_shown_whole(sheet, tmp_path):
    problem = problem_of(sheet)
    album = Album(problem, str(tmp_path), {}, str(tmp_path))
    surfaces = sheet.vertices[:9] + np.linspace(0, 0.4, 9)[:, None, None] * np.array([1, 0.3, 0])
    for k, v in enumerate(surfaces):
        album.draw(k, problem.camera.origin + v @ problem.camera.axes)
    assert len(album.finish(surfaces)[0]) == 9
    assert [row["label"] for row in album.rows] == [f"frame {k}" for k in evenly_spaced(9, 5)]
    for row in album.rows:
        background = row["surface"][0, 0]
        shown = (row["surface"] != background).any(-1)
        assert shown.mean() > 0.02 and not shown[[0, -1]].any() and not shown[:, [0, -1]].any()


def test_pictures_are_cropped_to_the_sheet_wherever_it_goes(sheet, tmp_path):
    """Each picture shows the same part of its frame: where its surface is in any frame."""
    problem = problem_of(sheet)
    settings = AlbumSettings(margin=0.02, room=0.0)  # so that it leaves the room that was kept
    album = Album(problem, str(tmp_path), {}, str(tmp_path), settings)
    surfaces = sheet.vertices[:3] * (0.5, 0.5, 1)  # smaller, so that there is something to crop
    surfaces[2] += (0.05, 0.03, 0)
    vertices = [problem.camera.origin + v @ problem.camera.axes for v in surfaces]
    for k, v in enumerate(vertices):
        album.draw(k, v)
    _, box, _ = album.finish(surfaces)
    seen = np.concatenate([problem.camera.project(v)[0] for v in vertices])
    low, high = seen.min(0), seen.max(0)
    assert (box[:2] <= low).all() and (high <= box[2:]).all()
    assert (np.subtract(low, box[:2]) < 4).all() and (np.subtract(box[2:], high) < 4).all()
    assert box.size[0] < 0.9 * problem.width
    renderings = Renderings(problem)
    for k, row in enumerate(album.rows):
        assert {row[name].shape for name in COLUMNS} == {
            (box.size[1], box.size[0], 3),
            box.size[::-1],
        }
        rgb = renderings(vertices[k], k, geometry=False)["render"][box.slices]
        drawn = (row["render"] > 30).any(-1)
        assert (drawn == (rgb > (30 / 255 / 12.92)).any(-1)).mean() > 0.9
        assert drawn.sum() > 100
    album.close()


def test_residual_shows_misfit_and_not_lighting():
    rng = np.random.default_rng(0)
    size, inside = (120, 160), np.zeros((120, 160), np.float32)
    inside[20:100, 30:130] = 1
    texture = np.repeat(np.kron(rng.random((30, 40)), np.ones((4, 4)))[..., None], 3, -1)
    texture = (0.2 + 0.5 * texture).astype(np.float32)
    light = np.linspace(0.6, 1.3, size[1], dtype=np.float32)[None, :, None]

    def found(target, masked):
        layers = {
            "target": target,
            "render": texture * inside[..., None],
            "mask_render": inside,
            "mask_target": inside if masked else np.ones_like(inside),
        }
        return residual(layers, masked)

    for masked in (True, False):
        lit, moved = found(texture * light, masked), found(np.roll(texture, 4, axis=1), masked)
        where = inside > 0
        assert np.median(lit[where]) < 0.1 and np.median(moved[where]) > 0.5
        assert lit[~where].max() == moved[~where].max() == 0
        # what cannot be told from the rendering at all
        other = 0.2 + 0.5 * np.repeat(rng.random(size)[..., None], 3, -1).astype(np.float32)
        assert 0.8 < np.sqrt((found(other, masked)[where] ** 2).mean()) < 1.6


def test_boxes():
    points = np.array([[10.0, 20.0], [30.0, 60.0]])
    box = Box.around(points, 0.1, (100, 62))
    assert box == (6, 16, 34, 62) and box.size == (28, 46)
    assert box.holds(Box(6, 20, 10, 30)) and not box.holds(Box(5, 20, 10, 30))
    assert box.union(Box(0, 30, 10, 70)) == (0, 16, 34, 70)
    assert Box.around(points - 1000, 0.1, (100, 62)) == (0, 0, 100, 62)
    assert np.zeros((62, 100))[box.slices].shape == (46, 28)


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="children are found in /proc")
def test_the_process_ends_with_a_run_that_is_killed(sheet, tmp_path):
    out = tmp_path / "out"
    arguments = [
        sys.executable,
        "-m",
        "polysft_mi.run",
        str(sheet.folder / "scene.xml"),
        "-o",
        str(out),
        "-q",
    ]
    run = subprocess.Popen(
        arguments, cwd=ROOT, env={**os.environ, "TMPDIR": str(tmp_path)}, start_new_session=True
    )
    try:
        wait_for(lambda: list(out.glob("checkpoint.npz")))
        ours = members(run.pid)
        assert len(ours) > 1
        run.kill()
        run.wait()
        wait_for(lambda: not members(run.pid))
        assert not list(tmp_path.glob("polysft_mi-*"))
    finally:
        if members(run.pid):
            os.killpg(run.pid, signal.SIGKILL)


def test_a_script_without_a_guard_runs_once(sheet, tmp_path):
    """As the README's, which does not stand under ``if __name__ == "__main__"``."""
    script, out = tmp_path / "script.py", tmp_path / "out"
    script.write_text(f"""
print("begins")
import polysft_mi
outcome = polysft_mi.reconstruct({str(sheet.folder / "scene.xml")!r}, {str(out)!r}, report=False)
print(outcome.summary["frames"], __file__)
""")
    done = python(script)
    assert done.stderr == "" and done.stdout.split() == ["begins", "9", str(script)]


@pytest.mark.slow  # most of it is what the test above does
def test_a_pool_may_reconstruct(sheet, tmp_path):
    """Whose processes may start none."""
    script, out = tmp_path / "script.py", tmp_path / "out"
    script.write_text(f"""
import multiprocessing, polysft_mi

def frames(scene):
    outcome = polysft_mi.reconstruct(scene, {str(out)!r}, report=False)
    return outcome.summary["frames"]

if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        print(pool.map(frames, [{str(sheet.folder / "scene.xml")!r}]))
""")
    done = python(script)
    assert done.stdout == "[9]\n" and done.stderr == ""
    assert (out / "comparison.png").exists()


def members(session):
    """Processes of a session, zombies aside."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of = path.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(of) == session and state != "Z":
            found.append(int(path.parent.name))
    return found


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_metrics_name_the_frames_in_order(sheet, tmp_path):
    from polysft_mi import run

    out = tmp_path / "out"
    words = [str(sheet.folder / "scene.xml"), "-o", str(out), "-q", "--exr", "2"]
    assert run.main([*words, "-D", "first=1", "-D", "last=3"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert [f["frame"] for f in metrics["per_frame"]] == [1, 2, 3]
    assert sorted(p.name for p in (out / "comparison").iterdir()) == ["001.exr", "003.exr"]
