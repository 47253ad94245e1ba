"""Motions: files of AMASS, Neural Cloth Simulation and BVH, retargeting, resampling, and the
generator's kinds."""

import zipfile

import numpy as np
import pytest
import torch
from motions import FROM_SMPL, T_POSE, places, some_motion
from scipy.spatial.transform import Rotation

from onefit.body import AnnyBody, skeleton, skinning
from onefit.body.skeleton import INDEX
from onefit.motion import Motion
from polyfit.errors import InputError

# --- the class ------------------------------------------------------------------------------------


def test_motions_that_cannot_be():
    poses, places = torch.zeros(5, 24, 3), torch.zeros(5, 3)
    bad = poses.clone()
    bad[2, 7, 1] = float("nan")
    for arguments, message in (
        (
            (poses[:, :22], places, 30.0),
            r"poses of shape \(5, 22, 3\); \(frames, 24, 3\) is needed",
        ),
        ((poses, places[:4], 30.0), r"translation of shape \(4, 3\); \(5, 3\) is needed"),
        ((poses[:0], places[:0], 30.0), "no frames"),
        ((bad, places, 30.0), "not finite in 1 of 5 frames, the first is frame 2; cut them out"),
        ((poses, places, 0.0), "0.0 frames a second"),
    ):
        with pytest.raises(InputError, match=message) as error:
            Motion(*arguments, "x")
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("as_given", [np.asarray, np.ndarray.tolist, list, torch.tensor])
def test_a_motion_is_made_of_anything_like_an_array(as_given):
    poses, places = np.full((5, 24, 3), 0.25), np.ones((5, 3))
    motion = Motion(as_given(poses), as_given(places), 30)
    assert motion.poses.dtype == motion.translation.dtype == torch.float32
    assert torch.equal(motion.poses, torch.full((5, 24, 3), 0.25))
    assert len(motion.resampled(60)) == 9


@pytest.mark.parametrize(
    "poses, message",
    [
        ("walk", "motion x: poses are no array of numbers"),
        ([[1, 2], [3]], "motion x: poses are no array of numbers"),
        (0.0, r"motion x: poses of shape \(\); \(frames, 24, 3\) is needed"),
    ],
)
def test_a_motion_is_not_made_of_anything_else(poses, message):
    with pytest.raises(InputError, match=message):
        Motion(poses, np.zeros((5, 3)), 30, "x")


@pytest.mark.parametrize(
    "changed, message",
    [
        (dict(poses=np.full((5, 72), "still")), "m.npz: poses of type <U5; numbers are needed"),
        (dict(trans=np.full((5, 3), "here")), "m.npz: trans of type <U4; numbers are needed"),
        (dict(fps="thirty"), "m.npz: fps is no number; give it: fps=30, or --fps 30"),
        (dict(fps=[]), "m.npz: fps is no number"),
    ],
)
def test_a_file_without_numbers(changed, message, tmp_path):
    np.savez(
        tmp_path / "m.npz",
        **dict(poses=np.zeros((5, 72)), trans=np.zeros((5, 3)), fps=30) | changed,
    )
    with pytest.raises(InputError, match=message):
        Motion.read(tmp_path / "m.npz")


def test_resampling_keeps_frames_and_turns_evenly():
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    turn = np.linspace(
        0, 3.0, 121
    )  # 3 rad a second at 120 frames a second, past any angle that adds up in axis-angle vectors
    first = Rotation.from_rotvec([1.0, 0.4, -0.2])
    poses = np.zeros((121, 24, 3))
    poses[:, 5] = (Rotation.from_rotvec(turn[:, None] * axis) * first).as_rotvec()
    motion = Motion(
        torch.tensor(poses).float(),
        torch.tensor(turn)[:, None].float() * torch.ones(3),
        120.0,
        "turn",
    )
    assert (
        torch.allclose(motion.resampled(30.0).poses, motion.poses[::4], atol=1e-6)
        and len(motion.resampled(30.0)) == 31
    )
    for fps in (25.0, 31.3, 240.0):
        new = motion.resampled(fps)
        at = np.arange(len(new)) / fps
        assert new.fps == fps and at[-1] <= 1.0 + 1e-6 < at[-1] + 1 / fps + 2e-6
        expected = Rotation.from_rotvec(3.0 * at[:, None] * axis) * first
        off = (Rotation.from_rotvec(new.poses[:, 5].double().numpy()).inv() * expected).magnitude()
        assert off.max() < 1e-5
        assert np.abs(new.translation.numpy() - 3.0 * at[:, None]).max() < 1e-5
    with pytest.raises(InputError, match="a positive number"):
        motion.resampled(0)


def test_mirror():
    motion = some_motion()
    there = motion.mirrored()
    other = [
        INDEX[n.replace("left", "x").replace("right", "left").replace("x", "right")]
        for n in skeleton.JOINTS
    ]
    assert np.abs(places(there)[:, other] * [-1, 1, 1] - places(motion)).max() < 1e-5
    assert torch.allclose(there.mirrored().poses, motion.poses)


# --- SMPL's rotations -----------------------------------------------------------------------------


def smpl_places(local, trans, joints):
    """Joints (T, 24, 3) as SMPL places them: in the file's world, the model's own joints (24, 3)
    with y up.
    """
    world, at = [], []
    for j, parent in enumerate(skeleton.PARENTS):
        r = Rotation.from_rotvec(local[:, j])
        world.append(r if parent < 0 else world[parent] * r)
        at.append(
            joints[0] + trans
            if parent < 0
            else at[parent] + world[parent].apply(joints[j] - joints[parent])
        )
    return np.stack(at, 1)


def smpl_poses(frames=12, seed=0):
    """Local rotations (T, 24, 3) in SMPL's axes, the root's into a world with z up, and root
    translations (T, 3).
    """
    rng = np.random.default_rng(seed)
    local = rng.normal(size=(frames, 24, 3)) * 0.4
    local[:, 22:] = 0
    upright = Rotation.from_euler("x", 90, degrees=True)
    local[:, 0] = (Rotation.from_rotvec(rng.normal(size=(frames, 3)) * 0.2) * upright).as_rotvec()
    return local, np.cumsum(rng.normal(size=(frames, 3)) * 0.01, 0) + [1.0, 2.0, 0.9]


def test_amass_puts_joints_where_smpl_does(tmp_path):
    local, trans = smpl_poses()
    model = T_POSE.double().numpy() @ FROM_SMPL.as_matrix()  # the standard skeleton in SMPL's axes
    expected = smpl_places(local, trans, model)
    np.savez(
        tmp_path / "a.npz",
        poses=np.concatenate([local[:, :22].reshape(12, -1), np.ones((12, 90))], 1),
        trans=trans,
        mocap_framerate=120.0,
    )
    motion = Motion.read(tmp_path / "a.npz")
    J = places(motion)
    assert motion.fps == 120 and motion.name == "a"
    assert (
        np.abs((J - J[:1, :1]) - (expected - expected[:1, :1])).max() < 1e-5
    )  # the same shape in the same world, moved as a whole
    assert np.abs(motion.translation[0, :2].numpy()).max() < 1e-6
    assert (
        abs(J[:, [10, 11], 2].min() - T_POSE[10, 2].item()) < 1e-5
    )  # the lowest foot stands on the ground


def test_all_files_of_smpls_family_say_the_same(tmp_path):
    local, trans = smpl_poses()
    flat = local.reshape(12, -1)
    np.savez(tmp_path / "a.npz", poses=flat[:, :66], trans=trans, mocap_frame_rate=np.array([60.0]))
    reference = Motion.read(tmp_path / "a.npz")
    down = Rotation.from_euler("x", -90, degrees=True)  # Neural Cloth Simulation's world has y up
    y_up = local.copy()
    y_up[:, 0] = (down * Rotation.from_rotvec(local[:, 0])).as_rotvec()
    files = {
        "smpl": {"poses": flat, "trans": trans, "mocap_framerate": 60},
        "smplx": {
            "poses": np.concatenate([flat[:, :66], np.ones((12, 99))], 1),
            "trans": trans,
            "mocap_frame_rate": 60,
        },
        "ncs": {"poses": y_up, "trans": down.apply(trans), "fps": 60, "source": "CMU"},
    }
    for name, data in files.items():
        np.savez(tmp_path / f"{name}.npz", **data)
        motion = Motion.read(tmp_path / f"{name}.npz")
        assert np.abs(places(motion) - places(reference)).max() < 1e-5, name
    np.savez(tmp_path / "z.npz", poses=flat, trans=trans, fps=60)
    for up in (None, "z"):  # the root is a leg's length above the ground along z
        motion = Motion.read(tmp_path / "z.npz", up=up)
        assert np.abs(places(motion) - places(reference)).max() < 1e-5


def test_smpls_poses_on_annys_bones(tmp_path):
    """Known poses in SMPL's terms: T-pose, arms up, elbows and a knee bent at right angles."""
    local = np.zeros((4, 24, 3))
    local[:, 0] = [np.pi / 2, 0, 0]
    local[1, [16, 17]] = [[0, 0, np.pi / 2], [0, 0, -np.pi / 2]]
    local[2, [18, 19]] = [[0, -np.pi / 2, 0], [0, np.pi / 2, 0]]
    local[3, 4] = [np.pi / 2, 0, 0]
    np.savez(
        tmp_path / "a.npz", poses=local.reshape(4, 72), trans=np.zeros((4, 3)), mocap_framerate=30
    )
    motion = Motion.read(tmp_path / "a.npz")
    body = AnnyBody().body()
    J = skinning.posed_joints(
        body, skinning.transforms(body, motion.poses, motion.translation)
    ).numpy()

    def bone(t, start, end):
        v = J[t, INDEX[end]] - J[t, INDEX[start]]
        return v / np.linalg.norm(v)

    near = np.cos(np.radians(1))
    assert (
        bone(0, "left_shoulder", "left_wrist") @ [1, 0, 0] > near
        and bone(0, "right_elbow", "right_wrist") @ [-1, 0, 0] > near
    )
    assert (
        bone(1, "left_shoulder", "left_wrist") @ [0, 0, 1] > near
        and bone(1, "right_shoulder", "right_elbow") @ [0, 0, 1] > near
    )
    assert (
        bone(2, "left_elbow", "left_wrist") @ [0, -1, 0] > near
        and bone(2, "right_elbow", "right_wrist") @ [0, -1, 0] > near
    )
    assert abs(bone(3, "left_knee", "left_ankle") @ bone(0, "left_knee", "left_ankle")) < 1e-3
    assert bone(3, "left_knee", "left_ankle") @ [0, 1, 0] > 0.98


def test_motion_files_that_cannot_be_used(tmp_path):
    local, trans = smpl_poses()
    good = {"poses": local.reshape(12, 72), "trans": trans, "mocap_framerate": 60.0}
    nan = local.reshape(12, 72).copy()
    nan[3, 5] = np.inf
    far = np.linspace(0, 150, 12)[:, None] * [1.0, 0, 0]
    for change, message in (
        ({"poses": None}, "misses poses; a motion file has poses, trans and a frame rate"),
        ({"mocap_framerate": None}, "no frame rate .*; give it: fps=30"),
        ({"poses": nan}, "poses are not finite in 1 of 12 frames, the first is frame 3"),
        ({"poses": np.zeros((12, 63))}, r"poses of shape \(12, 63\); axis-angle vectors of 22, 24"),
        ({"poses": np.zeros((12, 65, 4))}, r"poses of shape \(12, 65, 4\); axis-angle vectors"),
        ({"poses": np.zeros((12, 24, 4))}, r"\(12, 24, 4\); axis-angle vectors of 22, 24"),
        *(
            ({"poses": np.zeros((12, 24, k))}, rf"24, {k}\); axis-angle vectors \(T, 24, 3\) are")
            for k in (2, 6, 9)
        ),
        ({"trans": trans[:5]}, r"12 frames of poses and a translation of shape \(5, 3\)"),
        (
            {"trans": far},
            "its root moves at 818 m/s; .*; in centimetres\\? then divide it by 100",
        ),
        ({"mocap_framerate": -1.0}, "-1 frames a second; 1 to 1000 can be used"),
    ):
        np.savez(tmp_path / "m.npz", **{k: v for k, v in (good | change).items() if v is not None})
        with pytest.raises(InputError, match=message) as error:
            Motion.read(tmp_path / "m.npz")
        assert "\n" not in str(error.value)
    np.savez(tmp_path / "m.npz", poses=good["poses"], trans=trans)
    assert Motion.read(tmp_path / "m.npz", fps=25, up="z").fps == 25
    (tmp_path / "bad.npz").write_text("no archive")
    with open(tmp_path / "one.npz", "wb") as file:
        np.save(file, good["poses"])
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("poses.npy", "text")
        archive.writestr("trans.npy", "text")
    noise = np.random.default_rng(0).normal(size=good["poses"].shape)
    np.savez_compressed(tmp_path / "whole.npz", **good | {"poses": noise})
    whole = (tmp_path / "whole.npz").read_bytes()
    for start in (70, 2000):  # in the array's header, and behind it
        damaged = whole[:start] + bytes(250) + whole[start + 250 :]
        (tmp_path / f"damaged{start}.npz").write_bytes(damaged)
    for name, message in (
        ("none.npz", "no such file"),
        ("bad.npz", r"cannot be read as a motion \(no .npz file\)"),
        ("one.npz", r"cannot be read as a motion \(no .npz file\)"),
        ("text.npz", r"poses of type \|S4; numbers are needed"),
        ("damaged70.npz", "cannot be read as a motion"),
        ("damaged2000.npz", "cannot be read as a motion"),
        ("walk.fbx", "read from .npz"),
    ):
        with pytest.raises(InputError, match=message):
            Motion.read(tmp_path / name)
    with pytest.raises(InputError, match="motion of type NoneType; a file's name is needed"):
        Motion.read(None)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: Motion.generate("walk", seconds="1"), "a motion of 1 s at 30.0 frames"),
        (lambda m: Motion.generate("walk", fps="30"), "at 30 frames a second; at least one"),
        (lambda m: Motion.generate("walk", 1.0, seed="a"), "seed = 'a'; a whole number, 0 or more"),
        (lambda m: Motion.generate("walk", 1.0, seed=0.5), "seed = 0.5; a whole number, 0 or more"),
        (lambda m: Motion(m.poses, m.translation, "30"), "30 frames a second; a positive number"),
        (lambda m: m.resampled("25"), "25 frames a second; a positive number"),
        (lambda m: Motion.read("walk.npz", fps="30"), "fps = '30'; a number of frames"),
    ],
)
def test_what_is_no_number_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call(Motion.generate("walk", seconds=0.1))


def test_a_motion_is_led_in_from_the_bodys_rest_to_its_first_pose():
    body, motion = AnnyBody().body(), Motion.generate("box", seconds=0.2)
    led = motion.led_in(body, 0.5)
    lead = led[: -len(motion)]
    assert len(lead) == 15
    assert torch.equal(led.poses[15:], motion.poses)
    assert torch.equal(led.translation[15:], motion.translation)
    assert torch.allclose(lead.poses[0, 1:], body.rest_pose[1:], atol=1e-6)
    assert torch.allclose(lead.poses[:, 0], motion.poses[:1, 0].expand(15, -1), atol=1e-6)
    assert (lead.translation == motion.translation[0]).all()
    steps = torch.cat([lead.poses, motion.poses[:1]]).diff(dim=0).norm(dim=-1).amax(1)
    assert steps[0] < 0.2 * steps.max() and steps[-1] < 0.2 * steps.max()  # softly
