"""Rigs of COLMAP and nerfstudio: the cameras that are made of them stand where they stood, and see
what they saw; what does not fit is told in a line.
"""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import synthetic
from clips import CAMERA, photo, refused, rendered, write_png
from scipy.spatial.transform import Rotation

from polysft_mi import prepare
from polysft_mi.camera import Intrinsics
from polysft_mi.capture import GivenRig
from polysft_mi.scene import open_cameras

OWN = Intrinsics(110.4, 110.4, 48.75, 35.5, 96, 72)  # that of synthetic.cloth
LENSES = {
    "front": OWN,
    "left": Intrinsics(100.0, 104.0, 47.0, 37.0, 96, 72),
    "right": Intrinsics(120.0, 120.0, 50.0, 33.0, 92, 70),
}
UNIT = 0.25  # metres
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def poses(seed=0):
    """World to camera of each, in a world of its own, in units; and to the others' from the first
    one's frame, in metres.
    """
    rng = np.random.default_rng(seed)
    to_camera, relative = {}, {}
    for name in LENSES:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        pose[:3, 3] = rng.normal(size=3)
        to_camera[name] = pose
        relative[name] = pose @ np.linalg.inv(to_camera["front"])
        relative[name][:3, 3] *= UNIT
    return to_camera, relative


def images(folder, form="{name}/{k}.png", count=3):
    """Frames that tell which camera and frame they are of."""
    for c, (name, lens) in enumerate(LENSES.items()):
        for k in range(count):
            image = np.full((lens.height, lens.width, 3), 40 * c + 10 * k + 20, np.uint8)
            synthetic.write_image(folder / form.format(name=name, k=k), image)


def nerfstudio(path, names, per_frame=True, **more):
    frames = []
    for name, file in names:
        c = LENSES[name]
        own = dict(fl_x=c.fx, fl_y=c.fy, cx=c.cx, cy=c.cy, w=c.width, h=c.height)
        matrix = np.linalg.inv(poses()[0][name]) @ OPENGL
        frames.append({"file_path": file, "transform_matrix": matrix.tolist(), **own})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"frames": frames, **more}))
    return str(path)


def quaternion(pose):
    return np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)


def colmap(folder, names, binary=False, model="PINHOLE", moved=None):
    folder.mkdir(parents=True, exist_ok=True)
    cameras, found, to_camera = [], [], poses()[0]
    for k, c in enumerate(LENSES.values()):
        more = [0.0] * 4 if model == "OPENCV" else []
        cameras.append((k + 3, c.width, c.height, [c.fx, c.fy, c.cx, c.cy, *more]))
    for k, (name, file) in enumerate(names):
        pose = to_camera[name]
        if moved is not None and file in moved:
            pose = moved[file] @ pose
        found.append((k + 7, *quaternion(pose), *pose[:3, 3], 3 + [*LENSES].index(name), file))
    if binary:
        data = struct.pack("<Q", len(cameras))
        for number, width, height, numbers in cameras:
            data += struct.pack(f"<iiQQ{len(numbers)}d", number, 1, width, height, *numbers)
        (folder / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(found))
        for *numbers, file in found:
            data += struct.pack("<i7di", *numbers) + file.encode() + b"\0"
            data += struct.pack("<Qddq", 1, 1.5, 2.5, -1)
        (folder / "images.bin").write_bytes(data)
        return str(folder)
    text = "# cameras\n"
    for number, width, height, numbers in cameras:
        text += f"{number} {model} {width} {height} {' '.join(map(repr, numbers))}\n"
    (folder / "cameras.txt").write_text(text)
    points = ["\n", "1.5 2.5 -1\n"]
    lines = [
        " ".join(str(float(x)) if 0 < i < 8 else str(x) for i, x in enumerate(line)) + "\n"
        for line in found
    ]
    text = "".join(line + points[k % 2] for k, line in enumerate(lines))
    (folder / "images.txt").write_text("# images\n" + text)
    return str(folder)


EACH = [(name, f"{name}/0.png") for name in LENSES]
MODELS = {
    "nerfstudio": lambda at: nerfstudio(
        at / "transforms.json", [(n, f"images/{f}") for n, f in EACH]
    ),
    "colmap text": lambda at: colmap(at / "sparse" / "0", EACH),
    "colmap binary": lambda at: colmap(at / "sparse" / "0", EACH, binary=True),
    "colmap above": lambda at: colmap(at / "sparse" / "0", EACH) and str(at),
    "colmap OPENCV": lambda at: colmap(at / "sparse", EACH, model="OPENCV"),
}


def check(folder, count=3):
    """That the cameras in the folder are those of the rig."""
    _, relative = poses()
    cameras = {camera.name: camera for camera in open_cameras(str(folder), count)}
    assert sorted(cameras) == ["left", "right"]
    points = np.random.default_rng(1).normal(size=(9, 3)) * 0.1 + (0, 0, 0.5)
    for c, name in ((1, "left"), (2, "right")):
        camera = cameras[name]
        np.testing.assert_allclose(camera.world_to_camera, relative[name], atol=1e-12)
        assert camera.intrinsics == LENSES[name]
        # a point in the own camera's frame, by way of the rig's world
        world = (points / UNIT - poses()[0]["front"][:3, 3]) @ poses()[0]["front"][:3, :3]
        inside = world @ poses()[0][name][:3, :3].T + poses()[0][name][:3, 3]
        R, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        np.testing.assert_allclose(points @ R.T + t, UNIT * inside, atol=1e-12)
        seen = camera.intrinsics.project(points @ R.T + t)
        np.testing.assert_allclose(seen, LENSES[name].project(inside), rtol=1e-9)
        values = [camera.sequence.files[k] for k in range(count)]
        assert [int(synthetic.cv2.imread(v)[0, 0, 0]) for v in values] == [
            40 * c + 10 * k + 20 for k in range(count)
        ]


@pytest.mark.parametrize("kind", MODELS)
def test_cameras_stand_where_the_rig_says(kind, tmp_path):
    images(tmp_path / "images")
    rig = GivenRig(MODELS[kind](tmp_path), "front", UNIT)
    lines = rig.write(str(tmp_path / "out"), [0, 1, 2], OWN)
    assert "left, right" in lines[0] and "0.25 m (--rig-scale)" in lines[0] and len(lines) == 1
    check(tmp_path / "out")
    assert rig.lens(96, 72).camera == OWN
    # and so does what was written
    again = GivenRig(str(tmp_path / "out"))
    assert again.write(str(tmp_path / "again"), [0, 1, 2], OWN)[0].startswith(
        "cameras: left, right"
    )
    check(tmp_path / "again")
    assert again.lens(96, 72) is None
    assert "--rig-scale" in refused(GivenRig, str(tmp_path / "out"), None, 2.0)


def test_a_scene_is_prepared_with_them(tmp_path, capsys):
    folder = synthetic.cloth(tmp_path / "data", frames=3).folder
    images(tmp_path / "images")
    path = MODELS["nerfstudio"](tmp_path)
    words = [str(folder), "--cameras", path, "--camera-name", "front", "--rig-scale", str(UNIT)]
    prepare.main(words)
    assert "with further cameras" in capsys.readouterr().out
    check(folder / "cameras")
    assert '<default name="cameras" value="cameras"/>' in (folder / "scene.xml").read_text()
    assert "--overwrite" in refused(prepare.main, words)
    prepare.main([*words, "--overwrite"])
    check(folder / "cameras")
    # a folder of cameras of ours stays where it is
    prepare.main([str(folder), "--cameras", str(folder / "cameras"), "--overwrite"])
    assert '<default name="cameras" value="$data/cameras"/>' in (folder / "scene.xml").read_text()


def test_nothing_is_left_of_a_rig_that_does_not_fit(tmp_path):
    folder = synthetic.cloth(tmp_path / "data", frames=4).folder
    images(tmp_path / "images")
    words = ["--cameras", MODELS["colmap text"](tmp_path), "--camera-name", "front"]
    before = sorted(p.name for p in folder.iterdir())
    assert "3 frames for 4" in refused(prepare.main, [str(folder), *words])
    assert sorted(p.name for p in folder.iterdir()) == before
    (folder / "cameras").mkdir()
    (folder / "cameras" / "notes.txt").write_text("mine")
    assert "not written by this" in refused(prepare.main, [str(folder), *words, "--overwrite"])


@pytest.mark.parametrize("first, last, stride", [(0, 2, 1), (1, -1, 2)])
def test_from_a_video_with_its_camera(first, last, stride, tmp_path):
    """The rig also tells the camera of the video; frames are cut and scaled like the scene's."""
    print_ = photo()
    texture = write_png(tmp_path / "photo.png", print_)
    for k in range(4):
        image, cover = rendered(print_, k / 3)
        write_png(tmp_path / "images" / "a" / f"{k}.png", image)
        write_png(tmp_path / "images" / "b" / f"{k}.png", image)
        write_png(tmp_path / "masks" / "b" / f"{k}.png", np.round(255 * cover).astype(np.uint8))
    c = CAMERA
    known = dict(fl_x=c.fx, fl_y=c.fy, cx=c.cx, cy=c.cy, w=c.width, h=c.height)
    frames = [{"file_path": "images/a"}, {"file_path": "images/b", "mask_path": "masks/b"}]
    for frame in frames:
        frame["transform_matrix"] = np.eye(4).tolist()
    frames[1]["k1"] = -0.1
    (tmp_path / "transforms.json").write_text(json.dumps({**known, "frames": frames}))
    words = [str(tmp_path / "images" / "a"), "--texture", texture, "--size", "A4", "-q"]
    words += ["--first", str(first), "--last", str(last), "--stride", str(stride), "--scale", "0.5"]
    words += ["--cameras", str(tmp_path / "transforms.json"), "--camera-name", "a"]
    out = tmp_path / "out"
    prepare.main([*words, "-o", str(out)])
    count = len(range(first, 3 if last == 2 else 4, stride))
    (camera,) = open_cameras(str(out / "cameras"), count)
    own = Intrinsics.from_json(out / "camera.json")
    assert camera.intrinsics == own and (own.width, own.fx) == (160, 165.0)
    np.testing.assert_array_equal(camera.world_to_camera, np.eye(4))
    # its pictures are those of a, but for the distortion that was taken from them
    for k in range(count):
        a, b = (
            synthetic.cv2.imread(str(p)).astype(float)
            for p in (out / "frames" / f"{k:05d}.png", camera.sequence.files[k])
        )
        assert np.abs(a - b)[55:65, 75:85].mean() < 6 < np.abs(a - b).max()
    assert camera.sequence.mask(0) is not None


def test_what_an_image_stands_for(tmp_path):
    """Images that lie together are a camera each: their folders and videos are called likewise."""
    shots = tmp_path / "shots"
    images(shots, "{name}/{k}.png", count=2)
    names = [(name, f"{name}.png") for name in LENSES]
    model = colmap(tmp_path / "model", names)
    rig = GivenRig(model, "front", UNIT, str(shots))
    rig.write(str(tmp_path / "of folders"), [0, 1], OWN)
    check(tmp_path / "of folders", 2)
    images(tmp_path / "stills", "{name}.png", count=1)
    # instant-ngp leaves out the ending
    path = nerfstudio(tmp_path / "stills" / "transforms.json", [(n, f"./{n}") for n in LENSES])
    GivenRig(path, "front", UNIT).write(str(tmp_path / "of images"), [0], OWN)
    check(tmp_path / "of images", 1)
    assert "1 frames for 2" in refused(
        GivenRig(path, "front", UNIT).write, str(tmp_path / "no"), [0, 1], OWN
    )
    # folders within the cameras' own
    images(tmp_path / "deep", "{name}/rgb/{k}.png", count=2)
    files = [(n, f"{n}/rgb/0.png") for n in LENSES]
    path = nerfstudio(tmp_path / "deep" / "transforms.json", files)
    GivenRig(path, "front", UNIT).write(str(tmp_path / "of deep folders"), [0, 1], OWN)
    check(tmp_path / "of deep folders", 2)
    # patterns
    path = nerfstudio(shots / "transforms.json", [(n, f"{n}/*.png") for n in LENSES])
    GivenRig(path, "front", UNIT).write(str(tmp_path / "of patterns"), [0, 1], OWN)
    check(tmp_path / "of patterns", 2)


def test_several_frames_of_a_rig(tmp_path):
    """Each frame may have been placed for itself: the rig as a whole may move, its cameras not
    against each other.
    """
    images(tmp_path / "images")
    names = [(name, f"{name}/{k}.png") for name in LENSES for k in range(3)]
    to_camera = poses()[0]
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.from_rotvec([0, 0.3, 0]).as_matrix(), (0.2, 0, 0.1)
    moved = {
        f"{name}/1.png": to_camera[name] @ move @ np.linalg.inv(to_camera[name]) for name in LENSES
    }
    model = colmap(tmp_path / "sparse", names, moved=moved)
    GivenRig(model, "front", UNIT).write(str(tmp_path / "out"), [0, 1, 2], OWN)
    check(tmp_path / "out")
    model = colmap(tmp_path / "sparse", names, moved={"left/1.png": move})
    assert "left and front move" in refused(
        GivenRig(model, "front", UNIT).write, str(tmp_path / "no"), [0, 1, 2], OWN
    )


def test_applied_scale_is_undone(tmp_path):
    images(tmp_path / "images")
    files = [(n, f"images/{f}") for n, f in EACH]
    path = nerfstudio(tmp_path / "transforms.json", files, applied_scale=4.0)
    lines = GivenRig(path, "front", 4 * UNIT).write(str(tmp_path / "out"), [0, 1, 2], OWN)
    assert "applied_scale" in lines[0]
    check(tmp_path / "out")


def test_another_focal_length_is_noted(tmp_path):
    images(tmp_path / "images")
    rig = GivenRig(MODELS["colmap binary"](tmp_path), "front", UNIT)
    other = Intrinsics(90.0, 90.0, 48, 36, 96, 72)
    assert "110.4 pixels there" in rig.write(str(tmp_path / "out"), [0, 1, 2], other)[1]


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda t: t.replace("file_path", "file"), "file_path is missing"),
        (lambda t: t.replace('"frames"', '"none"'), "no frames"),
        (lambda t: t.replace("transform_matrix", "matrix"), "transform_matrix is no matrix"),
        (lambda t: t.replace("0.0, 0.0, 0.0, 1.0", "0.0, 0.0, 1.0"), "no matrix of 4 x 4"),
        (lambda t: t[:-1] + ', "applied_scale": 0}', "applied_scale"),
        (lambda t: t[:-1] + ', "camera_model": "OPENCV_FISHEYE"}', "OPENCV_FISHEYE"),
        (lambda t: t.replace('"fl_x"', '"f"'), "no fl_x"),
        (lambda t: t.replace("images/right/0.png", "images/up/0.png"), "up: neither there"),
        (lambda t: t.replace("images/right/0.png", "images/left/0.png"), "two cameras are called"),
        (lambda t: "[]", "not a JSON object"),
        (lambda t: "{", "not JSON"),
    ],
)
def test_bad_transforms_are_told(change, said, tmp_path):
    images(tmp_path / "images")
    path = Path(MODELS["nerfstudio"](tmp_path))
    path.write_text(change(path.read_text()))
    write = lambda: GivenRig(str(path), "front", UNIT).write(str(tmp_path / "o"), [0, 1, 2], OWN)
    message = refused(write)
    assert said in message and "transforms.json" in message


def test_bad_models_are_told(tmp_path):
    images(tmp_path / "images")
    write = lambda **o: GivenRig(colmap(tmp_path / "sparse", EACH, **o), "front", UNIT).write(
        str(tmp_path / "o"), [0, 1, 2], OWN
    )
    assert "camera model FULL_OPENCV" in refused(write, model="FULL_OPENCV")
    model = colmap(tmp_path / "sparse", EACH)
    assert "--camera-name is one of front, left, right" in refused(GivenRig, model)
    assert "no camera up" in refused(GivenRig, model, "up")
    assert "above 0" in refused(GivenRig, model, "front", 0.0)
    text = (tmp_path / "sparse" / "images.txt").read_text()
    (tmp_path / "sparse" / "images.txt").write_text(text.replace(" 3 front", " 9 front"))
    assert "its camera 9" in refused(GivenRig, model, "front")
    (tmp_path / "sparse" / "images.txt").write_text("1 2 3\n")
    assert "not a line of an image" in refused(GivenRig, model, "front")
    binary = Path(colmap(tmp_path / "binary", EACH, binary=True))
    (binary / "images.bin").write_bytes((binary / "images.bin").read_bytes()[:-9])
    assert "breaks off" in refused(GivenRig, str(binary), "front")
    alone = colmap(tmp_path / "alone", [("front", "front.png")])
    assert "only camera" in refused(GivenRig, alone, "front")
    assert "no such rig" in refused(GivenRig, str(tmp_path / "none"), "front")
    assert "known forms" in refused(GivenRig, str(tmp_path / "images"), "front")
    assert "--cameras names it" in refused(prepare.main, [str(tmp_path), "--camera-name", "left"])
