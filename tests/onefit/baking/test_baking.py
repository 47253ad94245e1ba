"""Baked drapes: the evaluation against torch's skinning, its symmetries and its swing; what baking
learns; the files, played by another reader and by a browser.
"""

import re
import subprocess

import numpy as np
import pytest
import torch
from browser import BROWSER, needs_browser
from scipy.spatial.transform import Rotation

import onefit
from onefit import bake as command
from onefit.baking import Baked, Sampling, bake, write_glb, write_page
from onefit.body import ClosestSurface, skinning
from polyfit.errors import InputError

QUICK = Sampling(
    seconds=0.5, taught=1, guided=2, shapes=8, guide=8, points=12, width=32, steps=300
)  # fmt: skip


@pytest.fixture(scope="module")
def draper():
    return onefit.load()


@pytest.fixture(scope="module")
def garment():
    return onefit.Garment.template("skirt").remeshed(500)


@pytest.fixture(scope="module")
def baked(draper, garment):
    return bake(draper, garment, sampling=QUICK)


@pytest.fixture(scope="module")
def motion():
    return onefit.Motion.generate("walk", seconds=1.0, seed=1_000_000)


def arrays(motion):
    return motion.poses.numpy(), motion.translation.numpy()


def test_a_frame_is_skinning_of_mean_and_shapes(baked, draper, motion):
    body = draper.model.body()
    weights = torch.from_numpy(baked.weights(*arrays(motion)))
    rest = torch.from_numpy(baked.mean) + torch.einsum(
        "tr,rnc->tnc", weights, torch.from_numpy(baked.shapes)
    )
    dense = torch.zeros(len(baked.mean), 24)
    dense.scatter_add_(1, *map(torch.from_numpy, (baked.joint_of, baked.joint_weights)))
    maps = skinning.transforms(body, motion.poses, motion.translation)
    expected = skinning.skin(rest, dense, maps).numpy()
    assert np.abs(baked.vertices(*arrays(motion)) - expected).max() < 1e-5
    torch.testing.assert_close(dense.sum(1), torch.ones(len(dense)))


def test_stream_is_the_batch(baked, motion):
    batch, stream = baked.vertices(*arrays(motion), fps=60), baked.stream(fps=60)
    for expected, pose, place in zip(batch, *arrays(motion)):
        assert np.abs(stream(pose, place) - expected).max() < 1e-5


def test_a_stream_that_is_reset_begins_anew(baked, motion):
    stream = baked.stream()
    poses, places = arrays(motion)
    first = [stream(pose, place) for pose, place in zip(poses[:3], places)]
    stream.reset()
    again = [stream(pose, place) for pose, place in zip(poses[:3], places)]
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("fps", [-1, 0, float("nan")])
def test_no_frames_a_second_are_refused(baked, motion, fps):
    for call in (lambda: baked.vertices(*arrays(motion), fps=fps), lambda: baked.stream(fps)):
        with pytest.raises(InputError, match=f"^{fps} frames a second; a positive number"):
            call()


def test_what_is_no_motion_is_refused(baked, motion):
    poses, places = arrays(motion)
    bad = poses.copy()
    bad[3, 7, 1] = np.nan
    for arguments, message in (
        ((poses[:, :22], places), r"^poses of shape \(30, 22, 3\) .*; \(T, 24, 3\) and \(T, 3\)"),
        ((poses, places[:4]), r"a translation of shape \(4, 3\)"),
        ((poses[0], places[0]), r"^poses of shape \(24, 3\)"),
        ((poses[:0], places[:0]), r"^poses of shape \(0, 24, 3\)"),
        ((bad, places), "all numbers must be finite"),
        (("walk", places), "arrays of numbers are needed"),
    ):
        with pytest.raises(InputError, match=message):
            baked.vertices(*arguments)
    stream = baked.stream()
    with pytest.raises(InputError, match=r"; \(24, 3\) and \(3,\) are needed"):
        stream(poses, places)
    with pytest.raises(InputError, match="all numbers must be finite"):
        stream(bad[3], places[3])
    expected = baked.vertices(poses[:1], places[:1])[0]  # what is refused leaves no trace
    assert np.abs(stream(poses[0].tolist(), places[0].tolist()) - expected).max() < 1e-5


def test_it_does_not_know_where_the_body_is_nor_faces(baked, motion):
    poses, translation = arrays(motion)
    turn = Rotation.from_rotvec([0, 0, 1.1])
    root = baked.joints[0]
    turned = poses.copy()
    turned[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    place = turn.apply(translation + root) - root + [2.0, -1.0, 0.3]
    found = baked.vertices(turned, place.astype(np.float32))
    expected = turn.apply(baked.vertices(poses, translation).reshape(-1, 3)) + [2.0, -1.0, 0.3]
    assert np.abs(found.reshape(-1, 3) - expected).max() < 1e-4


def test_cloth_goes_on_where_the_body_stops_and_comes_to_rest(baked):
    pose = np.repeat(onefit.Motion.generate("idle", seconds=0.1).poses[:1].numpy(), 240, 0)
    place = np.zeros((240, 3), np.float32)
    place[:, 0] = np.minimum(np.arange(240) / 30, 1.0)  # 1 m/s for a second
    swing = baked.vertices(pose, place)[..., 0] - place[:, :1]
    hem = baked.mean[:, 2] < np.quantile(baked.mean[:, 2], 0.2)
    after = swing[:, hem].mean(1) - swing[-1, hem].mean()
    assert after[31:45].max() > 0.01  # metres, onwards
    assert np.abs(after[-30:]).max() < 0.1 * after[31:45].max()


def test_baked_is_nearer_to_the_network_than_skinning_and_outside(baked, draper, garment, motion):
    drape = draper.drape(garment, motion)
    plain = draper.drape(garment, motion, skinning_only=True)
    apart = lambda x: float((x - drape.vertices).square().sum(-1).mean().sqrt())
    found = torch.tensor(baked.vertices(*arrays(motion)))
    assert apart(found) < 0.6 * apart(plain.vertices)
    surface = ClosestSurface(drape.body[0], drape.body_faces)
    inside = surface.distances(found, drape.body) < 0
    assert inside.float().mean() < 0.03


def test_arrays_come_back_from_a_file(baked, motion, tmp_path):
    baked.save(tmp_path / "baked.npz")
    again = Baked.load(tmp_path / "baked.npz")
    np.testing.assert_array_equal(again.vertices(*arrays(motion)), baked.vertices(*arrays(motion)))
    np.savez(tmp_path / "other.npz", mean=baked.mean)
    (tmp_path / "text.npz").write_text("no zip file")
    whole = (tmp_path / "baked.npz").read_bytes()
    for share in (0.3, 0.999):
        (tmp_path / f"{share}.npz").write_bytes(whole[: int(share * len(whole))])
    (tmp_path / "page.npz").write_text("<html>not found</html>")
    np.save(tmp_path / "array.npy", baked.mean)
    for name in ("other.npz", "text.npz", "0.3.npz", "0.999.npz", "page.npz", "array.npy"):
        with pytest.raises(InputError, match=f"{name}: not a baked drape, or cut off; [^()]*$"):
            Baked.load(tmp_path / name)
    for name, why in (("none.npz", "No such file"), ("", "Is a directory")):
        with pytest.raises(InputError, match=f"{why}.*; a baked.npz that onefit.bake wrote is"):
            Baked.load(tmp_path / name)


def values(document, index):
    accessor = document.accessors[index]
    view = document.bufferViews[accessor.bufferView]
    kind = {5121: np.uint8, 5123: np.uint16, 5126: np.float32}[accessor.componentType]
    size = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
    count = accessor.count * size
    raw = np.frombuffer(document.binary_blob(), kind, count, view.byteOffset)
    return raw.reshape(accessor.count, size)


def test_gltf_plays_the_same_frames(baked, draper, motion, tmp_path):
    import pygltflib

    write_glb(tmp_path / "walk.glb", baked, draper.model.body(), motion)
    document = pygltflib.GLTF2().load(str(tmp_path / "walk.glb"))
    (skin,), (animation,) = document.skins, document.animations
    paths = {}
    for channel in animation.channels:
        output = values(document, animation.samplers[channel.sampler].output)
        paths[channel.target.node, channel.target.path] = output
    parent = {c: k for k, n in enumerate(document.nodes) for c in n.children or ()}

    def world(k, t):
        node, local = document.nodes[k], np.eye(4)
        turn = paths[k, "rotation"][t] if (k, "rotation") in paths else node.rotation
        place = paths[k, "translation"][t] if (k, "translation") in paths else node.translation
        local[:3, :3] = Rotation.from_quat(turn).as_matrix()
        local[:3, 3] = (0, 0, 0) if place is None else place
        return world(parent[k], t) @ local if k in parent else local

    number, node = next((k, n) for k, n in enumerate(document.nodes) if n.name == baked.name)
    (primitive,) = document.meshes[node.mesh].primitives
    attributes = primitive.attributes
    shapes = np.stack([values(document, t["POSITION"]) for t in primitive.targets])
    weights = paths[number, "weights"].reshape(len(motion), -1)
    inverse = values(document, skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    expected = baked.vertices(*arrays(motion))
    for t in (0, 13, 29):
        x = values(document, attributes.POSITION) + np.tensordot(weights[t], shapes, 1)
        joints = np.stack([world(k, t) for k in skin.joints]) @ inverse
        blended = np.einsum(
            "nk,nkij->nij",
            values(document, attributes.WEIGHTS_0),
            joints[values(document, attributes.JOINTS_0)],
        )
        y_up = np.einsum("nij,nj->ni", blended[:, :3, :3], x) + blended[:, :3, 3]
        z_up = np.stack([y_up[:, 0], -y_up[:, 2], y_up[:, 1]], 1)
        assert np.abs(z_up - expected[t]).max() < 1e-5


def test_a_page_needs_nothing_else_and_names_its_motions(baked, draper, motion, tmp_path):
    write_page(tmp_path / "baked.html", baked, draper.model.body(), [motion])
    text = (tmp_path / "baked.html").read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//|@import|url\(|{{""", text)
    assert f'"name": "{motion.name}"' in text


@needs_browser
def test_a_browser_computes_the_same_vertices(baked, draper, motion, tmp_path):
    write_page(tmp_path / "baked.html", baked, draper.model.body(), [motion])
    flags = (
        "--headless --no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader"
        " --disable-quic --disable-dev-shm-usage --disable-background-networking --no-first-run"
        " --disable-component-update --disable-sync --virtual-time-budget=2000 --dump-dom"
    ).split()
    profile, page = f"--user-data-dir={tmp_path / 'profile'}", (tmp_path / "baked.html").as_uri()
    done = subprocess.run(
        [BROWSER, *flags, profile, page], capture_output=True, text=True, timeout=120
    )
    found = re.search(
        r'data-difference="([^"]+)" data-checked="(\d+)" data-drawn="(\d+)"', done.stdout
    )
    assert found, done.stderr[-2000:]
    assert float(found[1]) < 1e-4  # metres
    assert int(found[2]) == 2 and int(found[3]) > 0  # frames


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["skirt", "--motions", "moonwalk"], "moonwalk"),
        (["scarf"], "scarf"),
        (["skirt", "--shape", "girth=1"], "girth"),
        (["skirt", "--vertices", "3"], "--vertices 3: at least 100 are needed"),
        (["skirt", "--up", "y"], "--up: for a garment's file; skirt is a template"),
        (["skirt", "--fps", "60"], "--fps: for a motion file; dance is generated"),
        (["skirt", "--motions", "walk", "dance", "walk"], "walk: another .* walk-1000000.glb, too"),
    ],
)
def test_what_cannot_be_baked_is_refused_at_once(arguments, message, tmp_path):
    with pytest.raises(InputError, match=message):
        command.main([*arguments, "-o", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_what_files_do_not_say_is_said_by_the_flags_of_a_drape(
    baked, garment, tmp_path, monkeypatch
):
    from polyfit.mesh import write_ply

    seen = []
    monkeypatch.setattr("onefit.baking.bake", lambda _, garment, *__, **___: seen.append(garment))
    monkeypatch.setattr("onefit.bake.folder_aside", lambda *_: 1 / 0)
    x, y, z = 100 * garment.vertices.double().numpy().T
    write_ply(tmp_path / "skirt.ply", np.stack([x, z, -y], 1), garment.faces.numpy())
    np.savez(tmp_path / "still.npz", poses=np.zeros((9, 72)), trans=np.zeros((9, 3)))
    words = [str(tmp_path / "skirt.ply"), "-o", str(tmp_path / "out"), "--motions"]
    words += ["walk", str(tmp_path / "still.npz")]
    for more, message in (
        ([], "give it: fps=30, or --fps 30"),
        (["--fps", "60"], "give up='y', or --motion-up y"),
        (["--fps", "60", "--motion-up", "y"], "it looks like .*y up"),
    ):
        with pytest.raises(InputError, match=message):
            command.main([*words, *more])
    with pytest.raises(ZeroDivisionError):  # where files are written
        command.main([*words, *"--fps 60 --motion-up y --scale 0.01 --up y".split()])
    assert (seen[0].vertices - garment.vertices).abs().max() < 1e-3


def test_what_lies_there_is_kept(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for more in ([], ["--overwrite"]):
        with pytest.raises(InputError, match=re.escape(str(tmp_path))):
            command.main(["skirt", "-o", str(tmp_path), *more])
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_overwriting_replaces_what_was_baked_and_nothing_else(
    baked, draper, motion, tmp_path, monkeypatch
):
    out, words = tmp_path / "out", ["skirt", "--motions", "walk", "--seconds", "0.2", "--overwrite"]
    monkeypatch.setattr("onefit.baking.bake", lambda *_, **__: baked)
    command.main([*words[:2], "run", *words[2:], "-o", str(out)])
    assert (out / "run-1000000.glb").exists()
    command.main([*words, "-o", str(out)])
    assert {p.name for p in out.iterdir()} == {"baked.npz", "baked.html", "walk-1000000.glb"}
    for name in ("mine.glb", "skirt.glb"):  # of the same writer, though of no motion of the page
        write_glb(out / name, baked, draper.model.body(), motion)
        with pytest.raises(InputError, match=f"holds {name}, which is not of a baked drape"):
            command.main([*words, "-o", str(out)])
        (out / name).unlink()
    for name in ("mine.glb", "notes.txt", "photos/1.png"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
        with pytest.raises(InputError, match=f"holds {name}, which is not of a baked drape"):
            command.main([*words, "-o", str(out)])
        assert (out / name).read_text() == "mine"
        (out / name).unlink()
    with pytest.raises(InputError, match="-o '/proc/x': /proc is not a folder"):
        command.main(["no garment", "-o", "/proc/x"])
