"""Exports say what surface.npz says: read back by other programs than those that wrote them, frame
by frame.
"""

import io
import json
import resource
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from processes import python, refusal

from polyfit import animation
from polysft_mi import export
from polysft_mi.errors import InputError
from polysft_mi.results.run import Run

FPS = 12.5


@pytest.fixture(scope="module")
def run(finished_run):
    return Run.open(finished_run[1])


@pytest.fixture(scope="module")
def expected(run):
    """Vertices (T, N, 3) with y up, written out by hand."""
    x, y, z = np.moveaxis(run.vertices, -1, 0)
    return np.stack([x, -y, -z], -1)


def command(run, *arguments):
    assert export.main([run.folder, *map(str, arguments), "--fps", str(FPS), "-q"]) == 0


@pytest.mark.parametrize("kind", export.FORMATS)
def test_the_last_line_says_what_to_do_with_the_file(run, kind, tmp_path, capsys):
    if kind == "usd":
        pytest.importorskip("pxr")
    path = tmp_path / f"a.{'usdz' if kind == 'usd' else kind}"
    assert export.main([run.folder, "--format", kind, "-o", str(path)]) == 0
    written, following = capsys.readouterr().out.splitlines()
    assert written.startswith(f"written: {path}, ") and path.exists()
    assert following.startswith("next: ") and str(path) in following


def read_glb(path):
    """(JSON, accessor(k) -> array) of a .glb file, by the specification alone."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    scene = json.loads(data[20 : 20 + size])
    start = 20 + size + 8
    assert data[start - 4 : start] == b"BIN\0"

    def accessor(k):
        a = scene["accessors"][k]
        view = scene["bufferViews"][a["bufferView"]]
        columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[a["type"]]
        dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[a["componentType"]]
        out = np.frombuffer(
            data,
            dtype,
            a["count"] * columns,
            start + view.get("byteOffset", 0) + a.get("byteOffset", 0),
        ).reshape(-1, columns)
        if "min" in a:
            assert np.allclose(out.min(0), a["min"], atol=1e-7) and np.allclose(
                out.max(0), a["max"], atol=1e-7
            )
        return out

    def image(k):
        view = scene["bufferViews"][scene["images"][k]["bufferView"]]
        return data[start + view["byteOffset"] :][: view["byteLength"]]

    return scene, accessor, image


def test_glb_plays_the_frames(run, expected, tmp_path):
    path = tmp_path / "s.glb"
    command(run, "--format", "glb", "-o", path)
    scene, accessor, image = read_glb(path)
    primitive = scene["meshes"][0]["primitives"][0]
    base = accessor(primitive["attributes"]["POSITION"])
    targets = np.stack([accessor(t["POSITION"]) for t in primitive["targets"]])
    animated = scene["animations"][0]
    sampler = animated["samplers"][animated["channels"][0]["sampler"]]
    assert (
        animated["channels"][0]["target"] == {"node": 0, "path": "weights"}
        and scene["nodes"][0]["mesh"] == 0
    )
    times, weights = (
        accessor(sampler["input"])[:, 0],
        accessor(sampler["output"]).reshape(len(expected), len(targets)),
    )
    np.testing.assert_allclose(times, np.arange(len(expected)) / FPS, atol=1e-6)
    np.testing.assert_allclose(
        base + np.einsum("tk,knc->tnc", weights, targets), expected, atol=1e-6
    )
    normals = accessor(primitive["attributes"]["NORMAL"]) + accessor(
        primitive["targets"][-1]["NORMAL"]
    )
    of_faces = np.cross(
        *(expected[-1][run.faces[:, k]] - expected[-1][run.faces[:, 0]] for k in (1, 2))
    )
    by_area = np.zeros_like(expected[-1])
    np.add.at(by_area, run.faces, of_faces[:, None])
    np.testing.assert_allclose(
        normals, by_area / np.linalg.norm(by_area, axis=1, keepdims=True), atol=1e-3
    )
    assert image(0) == Path(run.texture).read_bytes()


def test_trimesh_sees_the_glb_textured_as_it_was(run, expected, tmp_path):
    path = tmp_path / "s.glb"
    command(run, "--format", "glb", "-o", path)
    (mesh,) = trimesh.load(path).geometry.values()
    np.testing.assert_allclose(mesh.vertices, expected[0], atol=1e-6)
    assert np.array_equal(mesh.faces, run.faces)
    seen = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(seen, np.asarray(Image.open(run.texture).convert("RGB")))
    np.testing.assert_allclose(mesh.visual.uv, run.uv, atol=1e-6)  # trimesh turns glTF's v over


@pytest.mark.parametrize("name", ["s.usdz", "s.usdc", "s.usda"])
def test_another_reader_of_usd_sees_the_frames(run, expected, tmp_path, name):
    tinyusdz = pytest.importorskip("tinyusdz", reason="the independent reader of USD is tinyusdz")
    command(run, "--format", "usd", "-o", tmp_path / name)
    stage = tinyusdz.load(str(tmp_path / name))
    assert (stage.get_metadata("upAxis"), stage.get_metadata("metersPerUnit")) == ("Y", 1)
    assert (
        stage.get_metadata("timeCodesPerSecond") == FPS
        and stage.get_metadata("endTimeCode") == len(expected) - 1
    )
    prims = {prim.type_name: prim for prim in tinyusdz.traverse(stage)}
    mesh = prims["Mesh"]
    samples = mesh.get_attribute_timesamples("points")
    times, values = zip(*(samples.items() if isinstance(samples, dict) else samples))
    np.testing.assert_allclose(times, np.arange(len(expected)))
    got = np.stack([np.asarray(getattr(v, "value", v)).reshape(-1, 3) for v in values])
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_usd_reopened_elsewhere_is_textured_and_valid(run, expected, tmp_path):
    path = tmp_path / "s.usdz"
    command(run, "--format", "usd", "-o", path, "--up", "z")
    script = """
import sys, zipfile, io, numpy as np
from pxr import Usd, UsdGeom, UsdShade, UsdValidation
stage = Usd.Stage.Open(sys.argv[1])
mesh = next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
moving = mesh.GetPointsAttr()
points = np.stack([np.array(moving.Get(k)) for k in moving.GetTimeSamples()])
uv = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
shaders = [UsdShade.Shader(p) for p in stage.Traverse()]
texture = next(s for s in shaders if s.GetIdAttr().Get() == "UsdUVTexture")
asset = texture.GetInput("file").Get()
inside = zipfile.ZipFile(sys.argv[1]).read(asset.path.lstrip("./"))
registry = UsdValidation.ValidationRegistry()
context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
problems = [e.GetMessage() for e in context.Validate(stage)]
assert not problems, problems
np.savez(
    sys.argv[2], points=points, uv=uv, faces=np.array(mesh.GetFaceVertexIndicesAttr().Get()),
    up=UsdGeom.GetStageUpAxis(stage), units=UsdGeom.GetStageMetersPerUnit(stage),
    image=np.frombuffer(inside, np.uint8), bound=bool(material),
)
"""
    done = python("-c", script, path, tmp_path / "a.npz")
    assert done.returncode == 0, done.stderr
    seen = np.load(tmp_path / "a.npz")
    x, y, z = np.moveaxis(run.vertices, -1, 0)
    np.testing.assert_allclose(seen["points"], np.stack([x, z, -y], -1), atol=1e-6)
    np.testing.assert_allclose(seen["uv"], run.uv, atol=1e-6)
    assert np.array_equal(seen["faces"].reshape(-1, 3), run.faces) and seen["bound"]
    assert (str(seen["up"]), float(seen["units"])) == ("Z", 1.0)
    assert seen["image"].tobytes() == Path(run.texture).read_bytes()


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_trimesh_reads_every_mesh(run, expected, tmp_path, kind):
    command(run, "--format", kind, "-o", tmp_path / "meshes")
    for k, V in zip(run.frames, expected):
        mesh = trimesh.load(
            tmp_path / "meshes" / f"{k:03d}.{kind}", process=False, maintain_order=True
        )
        np.testing.assert_allclose(mesh.vertices, V, atol=1e-6)
        assert np.array_equal(mesh.faces, run.faces)
        if kind == "obj":
            np.testing.assert_allclose(mesh.visual.uv, run.uv, atol=1e-6)
            assert mesh.visual.material.image.size == Image.open(run.texture).size


def test_npz_holds_the_arrays(run, tmp_path):
    command(run, "--format", "npz", "-o", tmp_path / "s.npz", "--up", "camera")
    seen = np.load(tmp_path / "s.npz")
    assert np.array_equal(seen["vertices"], run.vertices) and np.array_equal(
        seen["frames"], run.frames
    )
    assert float(seen["fps"]) == FPS and str(seen["up"]) == "camera"


@pytest.mark.parametrize("up, axis", [("y", 1), ("z", 2)])
def test_axes_are_turned_not_mirrored(up, axis):
    turn = animation.from_camera(np.eye(3), up).T
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1)
    above = animation.from_camera(np.array([0.0, -1.0, 0.0]), up)  # up in an OpenCV camera frame
    assert above[axis] == 1 and np.abs(above).sum() == 1


def test_other_images_become_png_and_no_texture_is_no_texture(tmp_path):
    V, F, uv = np.eye(3)[None], [[0, 1, 2]], np.eye(3)[:, :2]
    Image.new("RGB", (3, 2), (10, 20, 30)).save(tmp_path / "t.bmp")
    animation.write_glb(tmp_path / "a.glb", V, F, uv, tmp_path / "t.bmp")
    scene, _, image = read_glb(tmp_path / "a.glb")
    assert "animations" not in scene and Image.open(io.BytesIO(image(0))).getpixel((2, 1)) == (
        10,
        20,
        30,
    )
    animation.write_glb(tmp_path / "b.glb", V, F)
    scene, _, _ = read_glb(tmp_path / "b.glb")
    assert (
        "images" not in scene
        and "TEXCOORD_0" not in scene["meshes"][0]["primitives"][0]["attributes"]
    )
    animation.write_usd(tmp_path / "c.usda", V, F)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.glb", "b.glb", "c.usda", "t.bmp"]


class TestRefusals:
    """One line, and nothing half-written."""

    @pytest.mark.parametrize(
        "arguments, words",
        [
            (["--format", "fbx"], "invalid choice: 'fbx'"),
            (["--format", "glb", "--up", "z"], "glTF has y up"),
            (["--format", "usd", "--up", "camera"], "USD has y or z up"),
            (["--format", "glb", "-o", "x.usd"], "x.usd: .glb is needed"),
            (["--format", "glb", "-o", "nowhere/x.glb"], "no such folder"),
            (["--format", "glb", "--fps", "0"], "--fps 0"),
            (["--format", "usd", "--texture", "gone.png"], "gone.png: no such file"),
            (["--format", "glb", "--texture", __file__], "not an image"),
            ([], "--format"),
        ],
    )
    def test_in_what_is_asked(self, run, tmp_path, monkeypatch, arguments, words):
        monkeypatch.chdir(tmp_path)
        shutil.copytree(run.folder, tmp_path / "run")
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(InputError, match=words):
            export.main(["run", *arguments])
        assert sorted(tmp_path.rglob("*")) == before

    def test_in_an_image_of_which_its_decoder_complains_too(self, run, tmp_path, capfd):
        broken = tmp_path / "broken.tif"
        Image.open(run.texture).save(broken, compression="tiff_lzw")
        broken.write_bytes(broken.read_bytes()[:-3000])
        with pytest.raises(InputError, match="broken.tif: not an image"):
            export.main([run.folder, "--format", "glb", "--texture", str(broken)])
        assert capfd.readouterr().err == ""

    def test_in_the_folder(self, run, tmp_path):
        with pytest.raises(InputError, match="no such folder"):
            Run.open(tmp_path / "gone")
        with pytest.raises(InputError, match="not the folder of a run"):
            Run.open(tmp_path)
        folder = tmp_path / "run"
        shutil.copytree(run.folder, folder)
        (folder / "metrics.json").rename(folder / "kept")
        with pytest.raises(InputError, match="has not ended"):
            Run.open(folder)
        (folder / "metrics.json").write_text("{")
        with pytest.raises(InputError, match="metrics.json: not readable JSON"):
            Run.open(folder)
        (folder / "kept").replace(folder / "metrics.json")
        (folder / "surface.npz").write_bytes(b"PK")
        with pytest.raises(InputError, match="not a readable .npz"):
            Run.open(folder)

    def test_to_replace_other_files(self, run, tmp_path):
        target = tmp_path / "meshes"
        command(run, "--format", "obj", "-o", target)
        command(run, "--format", "obj", "-o", target)  # its own are replaced
        (target / "notes.txt").write_text("mine")
        with pytest.raises(InputError, match="holds other files"):
            command(run, "--format", "obj", "-o", target)
        assert (target / "notes.txt").exists() and list(tmp_path.iterdir()) == [target]

    def test_to_replace_meshes_of_others(self, run, tmp_path):
        """Names with numbers are anybody's."""
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "999.ply").write_text("mine")
        with pytest.raises(InputError, match="holds other files"):
            command(run, "--format", "ply", "-o", tmp_path / "mine")
        assert (tmp_path / "mine" / "999.ply").read_text() == "mine"

    @pytest.mark.parametrize("kind, name", [("npz", "surface.npz"), ("ply", "meshes")])
    def test_to_replace_the_runs_own(self, run, kind, name, tmp_path):
        folder = tmp_path / "run"
        shutil.copytree(run.folder, folder)
        with pytest.raises(InputError, match="the run's own folder"):
            export.main([str(folder), "--format", kind, "-o", str(folder / name)])
        (folder / "export").mkdir()
        command(Run.open(folder), "--format", kind, "-o", folder / "export" / f"a.{kind}")

    @pytest.mark.parametrize("extension", ["usdz", "usdc", "usda", "usd"])
    def test_to_write_where_nothing_can_be_written(self, run, tmp_path, capfd, extension):
        """USD itself ends in a page of its own errors there."""
        pytest.importorskip("pxr")
        path = tmp_path / "gone" / f"a.{extension}"
        with pytest.raises(FileNotFoundError) as caught:
            animation.write_usd(path, run.vertices, run.faces, run.uv, run.texture)
        assert caught.value.filename == str(path) and capfd.readouterr().err == ""
        assert list(tmp_path.iterdir()) == []

    def test_to_go_on_where_files_may_not_grow(self, run, tmp_path):
        """As on a full disk: the error of a write names no file."""
        limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        words = "polysft_mi.export", run.folder, "--format", "obj", "-o", tmp_path / "meshes"
        said = refusal(python("-m", *words, preexec_fn=limit))
        assert said == f"error: {tmp_path / 'meshes'}: File too large\n"
        assert list(tmp_path.iterdir()) == []

    def test_of_arrays(self, tmp_path):
        V, F = np.zeros((2, 3, 3)), [[0, 1, 2]]
        for wrong in [(V[0], F), (V, [[0, 1, 3]]), (V * np.nan, F), (V, F, np.zeros((2, 2)))]:
            with pytest.raises(InputError, match="animation"):
                animation.write_glb(tmp_path / "a.glb", *wrong)
        for wrong in (V, np.add(F, 0.5)), (V, [[0, 1, 2, 2]]), (V[:, :, :2], F), (V, []):
            with pytest.raises(InputError, match="animation"):
                animation.write_frames(tmp_path / "a", "obj", *wrong)
        for kind, labels, said in ("stl", None, "obj or ply"), ("obj", [1, 1], "2 labels, each"):
            with pytest.raises(InputError, match=said):
                animation.write_frames(tmp_path / "a", kind, V, F, labels=labels)
        with pytest.raises(InputError, match="up = 'x'; y or z is needed"):
            animation.from_camera(V, "x")
        with pytest.raises(InputError, match="up = 'x'; y or z is needed"):
            animation.write_usd(tmp_path / "a.usda", V, F, up="x")
        with pytest.raises(InputError, match="-1 frames a second"):
            animation.write_usd(tmp_path / "a.usda", V, F, fps=-1)
        assert list(tmp_path.iterdir()) == []
