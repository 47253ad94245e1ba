"""The viewer in the browser: what its scene holds, how it follows a run, and what it refuses."""

import contextlib
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest
import synthetic
from browser import BROWSER, needs_browser
from PIL import Image
from scipy.spatial.transform import Rotation

from polyfit.animation import from_camera
from polysft_mi import view
from polysft_mi.errors import InputError
from polysft_mi.results import Run
from polysft_mi.tracker import CHECKPOINT, Track

viser = pytest.importorskip("viser", reason="viser is not installed (the extra 'view')")
import trimesh  # noqa: E402, viser brings it


@pytest.fixture
def opened():
    """A function that opens a viewer on a folder, as the command does; they are closed after."""
    viewers = []

    def open_on(folder, *words):
        viewers.append(view.open_viewer([str(folder), "--port", "0", *words]))
        return viewers[-1]

    yield open_on
    for viewer in viewers:
        viewer.close()


def show(viewer, frame=None, colour=None):
    """The mesh that the scene then holds."""
    if frame is not None:
        viewer.frame.value = frame
    if colour is not None:
        viewer.colour.value = colour
    viewer.step()
    data = io.BytesIO(viewer.surface.glb_data)
    (mesh,) = trimesh.load(data, file_type="glb", process=False).geometry.values()
    return mesh


def test_shows_each_frame_with_its_texture_and_camera(finished_run, opened):
    run, viewer = Run.open(finished_run[1]), opened(finished_run[1])
    page = urllib.request.urlopen(viewer.address, timeout=20).read()
    assert b"<html" in page and b"script" in page
    image = read_pixels(run.images[2])
    for k in (0, 2):
        mesh = show(viewer, k)
        np.testing.assert_allclose(mesh.vertices, from_camera(run.vertices[k], "z"), atol=1e-7)
        np.testing.assert_array_equal(mesh.faces, run.faces)
    np.testing.assert_allclose(mesh.visual.uv, run.uv, atol=1e-6)
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"), int)
    wanted = read_pixels(run.texture)
    assert texture.shape == wanted.shape and np.abs(texture - wanted).mean() < 8
    frustum, c = viewer.server.scene.get_handle_by_name("/camera/own"), run.camera
    assert np.isclose(2 * c.fy * np.tan(frustum.fov / 2), c.height)
    assert np.isclose(frustum.aspect, c.width / c.height)
    forward = viser.transforms.SO3(frustum.wxyz).as_matrix()[:, 2]
    np.testing.assert_allclose(forward, from_camera(np.array([0.0, 0, 1]), "z"), atol=1e-6)
    np.testing.assert_array_equal(frustum.position, 0)
    assert np.abs(frustum.image.astype(int) - image).mean() < 6


def read_pixels(path):
    return np.asarray(Image.open(path).convert("RGB"), int)


def test_colours_say_what_the_run_knows(finished_run, finished_tube, opened):
    run, viewer = Run.open(finished_run[1]), opened(finished_run[1])
    assert set(viewer.colour.options) == {
        "texture",
        "plain",
        "residual",
        "sigma",
        "score",
        "curvature",
    }
    seen = {name: show(viewer, 3, name).visual for name in ("plain", "residual", "sigma")}
    colours = {name: v.vertex_attributes["color"][:, :3].astype(int) for name, v in seen.items()}
    assert (np.ptp(colours["plain"], axis=0) == 0).all()
    bright, sigma = colours["sigma"].sum(1), run.sigma[3]
    order = np.argsort(sigma)
    assert bright[order[-10:]].mean() > bright[order[:10]].mean() + 20  # viridis grows lighter
    assert np.ptp(colours["residual"], axis=0).max() > 50
    tube = opened(finished_tube[1])
    patches = show(tube, 0, "patches").visual.vertex_attributes["color"]
    own = Run.open(finished_tube[1]).params["patch"].max() + 1
    assert own > 1 and len(np.unique(patches, axis=0)) >= own


def test_plays_and_begins_where_it_is_told(finished_run, opened):
    viewer = opened(finished_run[1], "--frame", "2")
    assert viewer.frame.value == 2
    viewer.playing.value, seen = True, set()
    until = time.monotonic() + 20
    while len(seen) < 4 and time.monotonic() < until:
        viewer.step()
        seen.add(int(viewer.frame.value))
        time.sleep(0.01)
    assert seen == {0, 1, 2, 3}


def test_follows_a_run_that_is_at_work(finished_run, opened, tmp_path):
    run, out = Run.open(finished_run[1]), tmp_path / "out"
    shutil.copytree(finished_run[1], out)
    (out / "metrics.json").rename(tmp_path / "metrics.json")
    whole = Track.load(out / CHECKPOINT)
    (out / CHECKPOINT).unlink()
    viewer = opened(out)
    rest = show(viewer).vertices
    for count in (1, 3):
        part = Track(states=whole.states[:count], solver=whole.solver)
        part.save(out / CHECKPOINT, [])
        viewer.refresh()
        mesh = show(viewer)
        wanted = from_camera(run.vertices[count - 1], "z")
        np.testing.assert_allclose(mesh.vertices, wanted, atol=1e-6)
        assert viewer.frame.value == count - 1 and "residual" not in viewer.colour.options
    assert np.abs(rest - mesh.vertices).max() > 1e-3
    viewer.follow.value = False
    show(viewer, 1)
    whole.save(out / CHECKPOINT, [])
    viewer.refresh()
    show(viewer)
    assert viewer.frame.value == 1 and viewer.frame.max == 3
    shutil.move(tmp_path / "metrics.json", out)
    viewer.refresh()
    assert "residual" in viewer.colour.options and not viewer.follow.visible


def test_follows_another_run_in_the_same_folder(finished_run, finished_tube, opened, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished_tube[1], out)
    (out / "metrics.json").unlink()
    viewer = opened(out)
    shutil.rmtree(out)
    viewer.refresh()  # between the two there is nothing
    shutil.copytree(finished_run[1], out)
    (out / "metrics.json").unlink()
    os.utime(out / CHECKPOINT)
    os.utime(out / "scene.xml")
    viewer.refresh()
    wanted = from_camera(Run.open(finished_run[1]).vertices[-1], "z")
    np.testing.assert_allclose(show(viewer, colour="plain").vertices, wanted, atol=1e-6)


def test_waits_at_a_free_port_and_names_it(finished_run, opened):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        viewer = opened(finished_run[1], "--port", str(port))
        assert viewer.server.get_port() > port
    with pytest.raises(InputError, match="a free port"), contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # taken by whomever
            stack.enter_context(socket.create_server(("127.0.0.1", 65535)))
        view.main([str(finished_run[1]), "--port", "65535"])


def test_further_cameras_stand_where_their_files_say(finished_run, opened, tmp_path):
    run, out = Run.open(finished_run[1]), tmp_path / "out"
    shutil.copytree(finished_run[1], out)
    side = synthetic.cloth(tmp_path / "cameras" / "side", frames=4).folder
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, 0.8, -0.2]).as_matrix()
    pose[:3, 3] = 0.1, -0.2, 0.5
    known = json.loads((side / "camera.json").read_text())
    (side / "camera.json").write_text(json.dumps({**known, "world_to_camera": pose.tolist()}))
    scene, without = (out / "scene.xml").read_text(), '<default name="cameras" value=""'
    assert without in scene
    (out / "scene.xml").write_text(scene.replace(without, without[:-1] + f'{side.parent}"'))
    viewer = opened(out)
    handle = viewer.server.scene.get_handle_by_name("/camera/side")
    turn = viser.transforms.SO3(handle.wxyz).as_matrix()
    x = run.vertices[0].astype(float)  # its camera's frame is the scene's world
    there = (from_camera(x, "z") - handle.position) @ turn  # seen from the frustum
    np.testing.assert_allclose(there, x @ pose[:3, :3].T + pose[:3, 3], atol=1e-6)
    viewer.frame.value = 3
    viewer.step()
    image = read_pixels(sorted((side / "frames").iterdir())[3])
    assert np.abs(handle.image.astype(int) - image).mean() < 6


def test_shows_a_drape_and_its_body(opened, tmp_path):
    rng = np.random.default_rng(0)
    arrays = {"vertices": rng.normal(size=(3, 5, 3)), "body": rng.normal(size=(3, 4, 3))}
    faces = {"faces": np.array([[0, 1, 2], [2, 3, 4]]), "body_faces": np.array([[0, 1, 2]])}
    np.savez(tmp_path / "drape.npz", fps=30.0, **arrays, **faces)
    viewer = opened(tmp_path)
    mesh, body = show(viewer, 2), viewer.server.scene.get_handle_by_name("/body")
    np.testing.assert_allclose(mesh.vertices, arrays["vertices"][2], atol=1e-6)
    np.testing.assert_allclose(body.vertices, arrays["body"][2], atol=1e-6)
    np.savez(tmp_path / "drape.npz", **arrays)
    with pytest.raises(InputError, match="holds no faces, body_faces, fps"):
        opened(tmp_path)


def test_shows_all_garments_of_an_outfit(opened, tmp_path):
    rng = np.random.default_rng(0)
    body = dict(body=rng.normal(size=(3, 4, 3)), body_faces=np.array([[0, 1, 2]]), fps=30.0)
    faces, drapes = np.array([[0, 1, 2], [2, 3, 4]]), rng.normal(size=(2, 3, 5, 3))
    for name, vertices in zip(("1_trousers", "2_tshirt"), drapes):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "drape.npz", vertices=vertices, faces=faces, **body)
    viewer = opened(tmp_path)
    mesh = show(viewer, 2)
    np.testing.assert_allclose(mesh.vertices, np.concatenate(drapes[:, 2]), atol=1e-6)
    assert len(mesh.faces) == 4 and mesh.faces[2:].min() == 5
    assert "2 garments" in viewer._about.content
    np.savez(tmp_path / "2_tshirt/drape.npz", vertices=drapes[1, :2], faces=faces, **body)
    with pytest.raises(InputError, match=r"2_tshirt.*2 frames, where .*1_trousers.* has 3"):
        opened(tmp_path)


def test_refusals(finished_run, tmp_path, monkeypatch):
    for arguments, words in [
        ([tmp_path], "not the folder of a run or of a drape"),
        ([tmp_path / "nowhere"], "no such folder"),
        ([finished_run[1] / "surface.npz"], "is a file"),
        ([finished_run[1], "--frame", "9"], "frames 0 to 3"),
        ([finished_run[1], "--port", "70000"], "a port from 0"),
        ([finished_run[1], "--host", "192.0.2.1"], "an address of this machine"),  # documentation's
    ]:
        with pytest.raises(InputError, match=words):
            view.main([str(a) for a in arguments])
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"viser is not installed.*\[view\]"):
        view.main([str(finished_run[1])])


@needs_browser
def test_a_browser_draws_the_surface(finished_run, opened, tmp_path):
    viewer = opened(finished_run[1])
    words = "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader"
    words += f" --enable-unsafe-swiftshader --user-data-dir={tmp_path / 'profile'}"
    process = subprocess.Popen(
        [BROWSER, *words.split(), "--remote-debugging-port=0", viewer.address],
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    try:
        until = time.monotonic() + 120
        while not viewer.server.get_clients():
            assert time.monotonic() < until, "the browser does not come"
            time.sleep(0.2)
        (client,) = viewer.server.get_clients().values()
        viewer.server.scene.get_handle_by_name("/camera/own").visible = False
        shares = {}
        for colour in ("texture", "plain"):
            viewer.colour.value = colour
            while True:
                viewer.step()
                image = client.get_render(240, 320)[..., :3].astype(int)
                drawn = (image < 200).any(2)
                colourful = (np.ptp(image, axis=2) > 60).mean()
                if drawn.mean() > 0.01 and (colourful > 0.005) == (colour == "texture"):
                    break
                assert time.monotonic() < until, (colour, drawn.mean(), colourful)
                time.sleep(0.2)
            shares[colour] = drawn.mean()
        assert np.isclose(*shares.values(), rtol=0.2)
    finally:
        process.terminate()
        process.wait(30)
