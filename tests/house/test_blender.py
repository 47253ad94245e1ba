"""The Blender add-on, and our USD files in Blender: what Blender then holds is what the run has.

bpy, which is Blender as a Python module, brings a USD of its own and an older NumPy's binaries: it
runs in a process of its own, and hands back arrays.
"""

import importlib.util
import json

import numpy as np
import pytest
from PIL import Image
from places import ROOT
from processes import python

from polyfit.animation import from_camera
from polysft_mi import export
from polysft_mi.results import Run

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="bpy is not installed (the extra 'blender')"
)

_SCRIPT = """
import json, sys
import bpy, numpy as np
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
sys.path.insert(0, "blender")
import polysft_import

path, out, frames = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
if path.endswith((".usdz", ".usdc")):
    bpy.ops.wm.usd_import(filepath=path)
else:
    polysft_import.register()
    try:
        bpy.ops.import_scene.polysft(filepath=path)
    except RuntimeError as error:  # what Blender shows to its user
        print(error)
        sys.exit(3)

def read(data, name, kind, size):
    out = np.empty(len(data) * size, kind)
    data.foreach_get(name, out)
    return out.reshape(-1, size) if size > 1 else out

arrays, said = {}, {"fps": scene.render.fps / scene.render.fps_base}
said |= {"range": [scene.frame_start, scene.frame_end], "objects": []}
for thing in bpy.data.objects:
    said["objects"].append([thing.name, thing.type])
    if thing.type != "MESH":
        continue
    name, mesh = thing.name, thing.data
    for frame in frames:
        scene.frame_set(int(frame), subframe=frame % 1)
        held = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
        points, at = read(held.data.vertices, "co", np.float32, 3), np.array(held.matrix_world)
        arrays[f"{name}/{frame}"] = points @ at[:3, :3].T + at[:3, 3]
    arrays[f"{name}/faces"] = read(mesh.loops, "vertex_index", np.int32, 1).reshape(-1, 3)
    if mesh.uv_layers:
        arrays[f"{name}/uv"] = read(mesh.uv_layers[0].data, "uv", np.float32, 2)
for image in bpy.data.images:
    if image.size[0]:
        pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
        image.pixels.foreach_get(pixels)
        arrays["image"] = pixels.reshape(image.size[1], image.size[0], 4)[::-1]
if scene.camera and not path.endswith((".usdz", ".usdc")):
    scene.frame_set(0)
    points = arrays[f"{said['objects'][0][0]}/0"].astype(float)
    seen = [world_to_camera_view(scene, scene.camera, Vector(p)) for p in points]
    arrays["seen"] = np.array([[p.x, 1 - p.y] for p in seen])
    said["size"] = [scene.render.resolution_x, scene.render.resolution_y]
    world = bpy.data.worlds.new("light")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = 1, 1, 1, 1
    scene.world, render = world, scene.render
    render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 4, False
    scene.view_settings.view_transform = "Standard"
    render.filepath, render.image_settings.file_format = out + ".png", "PNG"
    bpy.ops.render.render(write_still=True)
np.savez(out, **arrays)
print("SAID" + json.dumps(said))
"""


def blender(path, folder, frames=(0, 1)):
    """What Blender holds of a file: its facts, its arrays, and the path of its rendering."""
    out = folder / "held"
    done = python("-c", _SCRIPT, path, out, json.dumps(frames))
    assert done.returncode == 0, done.stdout + done.stderr
    (said,) = [line[4:] for line in done.stdout.splitlines() if line.startswith("SAID")]
    with np.load(f"{out}.npz") as arrays:
        return json.loads(said), dict(arrays), f"{out}.png"


def test_a_run_is_the_same_in_blender(finished_run, tmp_path):
    truth, out = finished_run
    run, c = Run.open(out), Run.open(out).camera
    said, held, picture = blender(out / "surface.npz", tmp_path, (0, 2, 1.5, 3))
    assert said["objects"] == [["out", "MESH"], ["out camera", "CAMERA"]]
    assert said["range"] == [0, 3] and np.isclose(said["fps"], run.fps)
    wanted = from_camera(run.vertices, "z")
    for frame, surface in ((0, wanted[0]), (2, wanted[2]), (3, wanted[3])):
        np.testing.assert_allclose(held[f"out/{frame}"], surface, atol=1e-6)
    np.testing.assert_allclose(held["out/1.5"], wanted[1:3].mean(0), atol=1e-6)
    np.testing.assert_array_equal(held["out/faces"], run.faces)
    np.testing.assert_allclose(held["out/uv"], run.uv[run.faces].reshape(-1, 2), atol=1e-6)
    image = np.asarray(Image.open(run.texture).convert("RGB"))
    np.testing.assert_allclose(held["image"][..., :3], image / 255, atol=1e-3)
    assert said["size"] == [c.width, c.height]
    np.testing.assert_allclose(
        held["seen"] * [c.width, c.height], c.project(run.vertices[0]), atol=0.01
    )
    drawn = np.asarray(Image.open(picture).convert("RGB"), float)
    frame = np.asarray(Image.open(run.images[0]).convert("RGB"), float)
    inside = np.asarray(Image.open(sorted((truth.folder / "masks").iterdir())[0]).convert("L")) > 0
    difference = np.median(np.abs(drawn - frame)[inside])
    assert difference < 8 < 0.3 * np.median(np.abs(drawn[:, ::-1] - frame)[inside])


def test_a_camera_with_oblong_pixels_off_the_middle(finished_run, tmp_path):
    run, out = Run.open(finished_run[1]), tmp_path / "run"
    out.mkdir()
    for name in ("surface.npz", "scene.xml", "run.json"):
        (out / name).write_bytes((finished_run[1] / name).read_bytes())
    c = {"fx": 150.0, "fy": 180.0, "cx": 70.0, "cy": 75.0, "width": 160, "height": 120}
    (out / "camera.json").write_text(json.dumps(c))
    about = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps({**about, "fps": 30000 / 1001}))
    said, held, _ = blender(out, tmp_path)
    assert np.isclose(said["fps"], 29.97, atol=1e-3)
    wanted = run.vertices[0, :, :2] / run.vertices[0, :, 2:] * (150, 180) + (70, 75)
    np.testing.assert_allclose(held["seen"] * [160, 120], wanted, atol=0.01)


def test_seams_of_the_texture_stay(finished_tube, tmp_path):
    run = Run.open(finished_tube[1])
    _, held, _ = blender(finished_tube[1], tmp_path)
    assert len(held["out/0"]) == run.vertices.shape[1]
    np.testing.assert_allclose(held["out/uv"], run.texcoords.corners.reshape(-1, 2), atol=1e-6)


@pytest.mark.parametrize("up", ["y", "z", "camera"])
def test_arrays_of_an_export_are_turned_upright(finished_run, tmp_path, up):
    path, run = tmp_path / "surface.npz", Run.open(finished_run[1])
    words = ["--format", "npz", "--up", up, "--fps", "12", "-o", str(path), "-q"]
    assert export.main([str(finished_run[1]), *words]) == 0
    said, held, _ = blender(path, tmp_path, [1])
    assert said["fps"] == 12
    found = held[f"{tmp_path.name}/1"]
    np.testing.assert_allclose(found, from_camera(run.vertices[1], "z"), atol=1e-6)


def test_a_drape_comes_with_its_body_and_the_mesh_of_its_file(tmp_path):
    rng, out = np.random.default_rng(0), tmp_path / "walk"
    out.mkdir()
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    a = {"vertices": (3, 5, 3), "body": (3, 4, 3), "mesh_vertices": (3, 4, 3), "uv": (5, 2)}
    a = {name: rng.uniform(size=shape) for name, shape in a.items()}
    a |= {"faces": faces, "body_faces": faces[:1], "mesh_faces": faces, "fps": 30.0}
    a["uv_faces"] = np.array([[0, 1, 2], [4, 3, -1]])
    np.savez(out / "drape.npz", **a)
    said, held, _ = blender(out, tmp_path, [2])
    assert said["objects"] == [["walk", "MESH"], ["walk body", "MESH"]] and said["fps"] == 30
    np.testing.assert_allclose(held["walk/2"], a["mesh_vertices"][2], atol=1e-6)
    np.testing.assert_allclose(held["walk body/2"], a["body"][2], atol=1e-6)
    uv = [*a["uv"][[0, 1, 2, 4, 3]], [0, 0]]
    np.testing.assert_allclose(held["walk/uv"], uv, atol=1e-6)


def test_what_is_no_surface_is_refused_in_a_line(tmp_path):
    np.savez(tmp_path / "other.npz", points=np.zeros(3))
    done = python("-c", _SCRIPT, tmp_path / "other.npz", tmp_path / "held", "[0]")
    assert done.returncode == 3 and "holds no vertices and no faces" in done.stdout
    assert (ROOT / "blender" / "polysft_import.py").is_file()


def test_usd_opens_in_blender_with_all_but_the_rate(finished_run, tmp_path):
    """As docs/export.md says."""
    pytest.importorskip("pxr", reason="usd-core is not installed (the extra 'usd')")
    path, run = tmp_path / "surface.usdz", Run.open(finished_run[1])
    assert export.main([str(finished_run[1]), "--format", "usd", "-o", str(path), "-q"]) == 0
    said, held, _ = blender(path, tmp_path, (0, 1.5, 3))
    (name,) = [name for name, kind in said["objects"] if kind == "MESH"]
    wanted = from_camera(run.vertices, "z")
    np.testing.assert_allclose(held[f"{name}/3"], wanted[3], atol=1e-6)
    np.testing.assert_allclose(held[f"{name}/1.5"], wanted[1:3].mean(0), atol=1e-6)
    np.testing.assert_allclose(held[f"{name}/uv"], run.uv[run.faces].reshape(-1, 2), atol=1e-6)
    assert held["image"].shape[:2] == np.asarray(Image.open(run.texture)).shape[:2]
    assert said["range"] == [0, 3] and said["fps"] == 24 != run.fps
    assert [kind for _, kind in said["objects"] if kind == "CAMERA"] == []
