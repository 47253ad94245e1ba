"""Motions: files of AMASS, Neural Cloth Simulation and BVH, retargeting, resampling, and the
generator's kinds.
"""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scripts import load

from onefit.body import AnnyBody, skeleton, skinning
from onefit.body.skeleton import INDEX
from onefit.motion import Motion, generate
from polyfit.errors import InputError

T_POSE = skeleton.standard_joints()
FROM_SMPL = Rotation.from_euler("x", 90, degrees=True)
KINDS = generate.TRAINING + generate.HELD_OUT


def places(motion, joints=T_POSE):
    """Joints (T, 24, 3) of the standard skeleton in a motion."""
    return skinning.joint_places(
        joints.double(), motion.poses.double(), motion.translation.double()
    ).numpy()


def some_motion(frames=20, size=0.4, seed=0):
    """A motion of random rotations, slow enough to be someone's, the body upright."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(frames, 24, 3)) * size
    poses[:, 0] *= 0.3
    return Motion(
        torch.tensor(poses).float(),
        torch.tensor(np.cumsum(rng.normal(size=(frames, 3)) * 0.02, 0)).float(),
        30.0,
        "some",
    )


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
    with pytest.raises(
        InputError, match="with y up, its body lies down in all frames; give up='z'"
    ):
        Motion.read(tmp_path / "z.npz")
    assert np.abs(places(Motion.read(tmp_path / "z.npz", up="z")) - places(reference)).max() < 1e-5


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
        ({"trans": trans[:5]}, r"12 frames of poses and a translation of shape \(5, 3\)"),
        (
            {"trans": far},
            "its root moves at 818 m/s; .*; in centimetres\\? then divide trans by 100",
        ),
        ({"mocap_framerate": -1.0}, "-1.0 frames a second"),
    ):
        np.savez(tmp_path / "m.npz", **{k: v for k, v in (good | change).items() if v is not None})
        with pytest.raises(InputError, match=message) as error:
            Motion.read(tmp_path / "m.npz")
        assert "\n" not in str(error.value)
    np.savez(tmp_path / "m.npz", poses=good["poses"], trans=trans)
    assert Motion.read(tmp_path / "m.npz", fps=25, up="z").fps == 25
    (tmp_path / "bad.npz").write_text("no archive")
    for name, message in (
        ("none.npz", "no such file"),
        ("bad.npz", "cannot be read as .npz"),
        ("walk.fbx", "read from .npz"),
    ):
        with pytest.raises(InputError, match=message):
            Motion.read(tmp_path / name)


# --- BVH ------------------------------------------------------------------------------------------

PARTS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
# names of pelvis, spine, neck and head, and of a side's bones; Euler order; axes; units a metre
STYLES = {
    "mixamo": (
        ["Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"],
        [
            "{S}UpLeg", "{S}Leg", "{S}Foot", "{S}ToeBase", "{S}Shoulder", "{S}Arm", "{S}ForeArm",
            "{S}Hand"
        ], "mixamorig:", "ZXY", "y", 100.0
    ),
    "cmu": (
        ["Hips", "LowerBack", "Spine", "Spine1", "Neck", "Head"],
        [
            "{S}UpLeg", "{S}Leg", "{S}Foot", "{S}ToeBase", "{S}Shoulder", "{S}Arm", "{S}ForeArm",
            "{S}Hand"
        ], "", "ZYX", "y", 17.7
    ),
    "rigify": (
        ["spine", "spine.001", "spine.002", "spine.003", "spine.004", "head"],
        [
            "thigh.{s}", "shin.{s}", "foot.{s}", "toe.{s}", "shoulder.{s}", "upper_arm.{s}",
            "forearm.{s}", "hand.{s}"
        ], "", "XYZ", "z", 1.0
    ),
    "poser": (
        ["hip", "abdomen", "chest", "chest2", "neck", "head"],
        [
            "{l}Thigh", "{l}Shin", "{l}Foot", "{l}Toe", "{l}Collar", "{l}Shldr", "{l}ForeArm",
            "{l}Hand"
        ], "", "YZX", "y", 40.0
    ),
    "mocap": (
        ["Hips", "Chest", "Chest2", "Chest3", "Neck", "Head"],
        [
            "{S}Hip", "{S}Knee", "{S}Ankle", "{S}Toe", "{S}Collar", "{S}Shoulder", "{S}Elbow",
            "{S}Wrist"
        ], "", "ZXY", "y", 100.0
    ),
    "unreal": (
        ["pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head"],
        [
            "thigh_{l}", "calf_{l}", "foot_{l}", "ball_{l}", "clavicle_{l}", "upperarm_{l}",
            "lowerarm_{l}", "hand_{l}"
        ], "", "ZYX", "z", 100.0
    ),
}  # fmt: skip


def bvh_names(style):
    trunk, limbs, prefix, *_ = STYLES[style]
    names = dict(zip(("pelvis", "spine1", "spine2", "spine3", "neck", "head"), trunk, strict=True))
    for side in ("left", "right"):
        for part, name in zip(PARTS, limbs, strict=True):
            names[f"{side}_{part}"] = name.format(S=side.capitalize(), s=side[0].upper(), l=side[0])
    return {joint: prefix + name for joint, name in names.items()}


def write_bvh(path, motion, style, zero=None, frame_time=None):
    """A motion of the standard skeleton as a BVH file whose zero pose is the pose ``zero`` (24, 3),
    the T-pose where None.
    """
    *_, order, up, unit = STYLES[style]
    names = bvh_names(style)
    turn = FROM_SMPL.inv() if up == "y" else Rotation.identity()  # to the file's axes
    zero = torch.zeros(24, 3) if zero is None else zero
    stand = skeleton.chained_rotations(zero.double()).numpy()
    J = skinning.joint_places(T_POSE.double(), zero.double()[None], torch.zeros(1, 3).double())[
        0
    ].numpy()
    G = skeleton.chained_rotations(motion.poses.double()).numpy()
    world = {
        j: turn * Rotation.from_matrix(G[:, j]) * Rotation.from_matrix(stand[j]).inv() * turn.inv()
        for j in range(24)
    }
    lines, rows = ["HIERARCHY"], []

    def bone(j, depth):
        parent = skeleton.PARENTS[j]
        tab = "  " * depth
        offset = turn.apply(J[j] - (J[parent] if parent >= 0 else J[j])) * unit
        lines.append(f"{tab}{'JOINT' if depth else 'ROOT'} {names[skeleton.JOINTS[j]]}")
        lines.append(tab + "{")
        lines.append(f"{tab}  OFFSET {offset[0]:.8f} {offset[1]:.8f} {offset[2]:.8f}")
        rotations = " ".join(f"{axis}rotation" for axis in order)
        lines.append(
            f"{tab}  CHANNELS "
            + ("3 " if depth else "6 Xposition Yposition Zposition ")
            + rotations
        )
        if parent < 0:
            rows.append(turn.apply(T_POSE[0].numpy() + motion.translation.double().numpy()) * unit)
        rows.append(
            (world[j] if parent < 0 else world[parent].inv() * world[j]).as_euler(
                order, degrees=True
            )
        )
        children = [
            c for c, p in enumerate(skeleton.PARENTS) if p == j and skeleton.JOINTS[c] in names
        ]
        for child in children:
            bone(child, depth + 1)
        if not children:
            lines.extend(
                [tab + "  End Site", tab + "  {", f"{tab}    OFFSET {0.1 * unit} 0 0", tab + "  }"]
            )
        lines.append(tab + "}")

    bone(0, 0)
    values = np.concatenate(rows, 1)
    frame_time = 1 / motion.fps if frame_time is None else frame_time
    lines += [
        "MOTION",
        f"Frames: {len(values)}",
        f"Frame Time: {frame_time:.7f}",
        *(" ".join(f"{v:.8f}" for v in row) for row in values),
    ]
    path.write_text("\n".join(lines))


def body_only(motion):
    poses = motion.poses.clone()
    poses[:, 22:] = 0
    return Motion(poses, motion.translation, motion.fps, motion.name)


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("zero", ["t", "a"])
def test_bvh_of_many_makes_comes_back(style, zero, tmp_path):
    motion = body_only(some_motion(size=0.3))
    write_bvh(
        tmp_path / "m.bvh", motion, style, skeleton.standard_rest_pose() if zero == "a" else None
    )
    read = Motion.read(tmp_path / "m.bvh")
    assert read.fps == 30
    there, back = places(motion), places(read)
    for J in (there, back):  # moved as a whole
        J -= J[:1, :1].copy()
    assert np.abs(there - back)[:, :22].max() < 1e-4
    assert np.abs(there - back).max() < (
        1e-4 if zero == "t" else 0.02
    )  # the file does not say how a hand is turned in its zero pose


def test_bvh_without_collars_toes_and_with_a_short_spine(tmp_path):
    """What a file does not have stays as in the T-pose; a rotation of a bone that is not ours
    reaches the next joint that is.
    """
    still = torch.zeros(2, 24, 3)
    still[1, INDEX["spine2"], 0] = 0.5
    still[1, INDEX["right_elbow"], 2] = 1.0
    write_bvh(tmp_path / "m.bvh", Motion(still, torch.zeros(2, 3), 30.0), "mixamo")
    text = (tmp_path / "m.bvh").read_text()
    for old, new in (("LeftShoulder", "Extra1"), ("RightShoulder", "Extra2"), ("Spine1", "Hump")):
        text = text.replace(old, new)
    (tmp_path / "n.bvh").write_text(text)
    a, b = places(Motion.read(tmp_path / "m.bvh")), places(Motion.read(tmp_path / "n.bvh"))
    assert np.abs(a - b).max() < 1e-4


def test_bvh_files_that_cannot_be_used(tmp_path):
    motion = body_only(some_motion(frames=3))
    write_bvh(tmp_path / "m.bvh", motion, "mixamo")
    good = (tmp_path / "m.bvh").read_text()
    rows = good.split("\n")
    lying = motion.poses.clone() * 0
    lying[:, 1:3, 0] = -1.5
    write_bvh(tmp_path / "sat.bvh", motion, "mixamo", lying[0])
    cases = {
        "no BVH file": "#!/bin/sh",
        "no left knee among its bones": good.replace("LeftLeg", "LeftThing"),
        "numbers for 69 channels": "\n".join(rows[:-1] + [rows[-1].rsplit(" ", 1)[0]]),
        "3 frames are announced, 2 are there": "\n".join(rows[:-1]),
        "frames are not finite in 1 of 3 frames, the first is frame 1": "\n".join(
            [*rows[:-2], "nan " + rows[-2].split(" ", 1)[1], rows[-1]]
        ),
        "a frame time of 0.0; give the rate": good.replace(
            "Frame Time: 0.0333333", "Frame Time: 0"
        ),
        "its zero pose is not an upright stance": (tmp_path / "sat.bvh").read_text(),
    }
    for message, text in cases.items():
        (tmp_path / "bad.bvh").write_text(text)
        with pytest.raises(InputError, match=message) as error:
            Motion.read(tmp_path / "bad.bvh")
        assert "\n" not in str(error.value) and "bad.bvh" in str(error.value)
    (tmp_path / "bad.bvh").write_text(cases["a frame time of 0.0; give the rate"])
    assert Motion.read(tmp_path / "bad.bvh", fps=25).fps == 25


# --- generated motions ----------------------------------------------------------------------------


def test_kinds():
    assert len(generate.TRAINING) >= 12 and len(generate.HELD_OUT) >= 4
    assert not set(generate.TRAINING) & set(generate.HELD_OUT)
    with pytest.raises(InputError, match="no kind of motion 'fly'; there are idle"):
        Motion.generate("fly")
    with pytest.raises(InputError, match="at least one frame"):
        Motion.generate("walk", seconds=0)


@pytest.mark.parametrize("kind", KINDS)
def test_generated_motions_are_smooth_and_within_joints_limits(kind):
    for seed in (0, 1):
        motion = Motion.generate(kind, seconds=6, seed=seed, fps=120.0)
        again, other = (
            Motion.generate(kind, seconds=6, seed=seed, fps=120.0),
            Motion.generate(kind, seconds=6, seed=seed + 10, fps=120.0),
        )
        assert (
            torch.equal(motion.poses, again.poses)
            and (motion.poses - other.poses).abs().max() > 0.2
        )
        J = places(motion)
        # accelerations are continuous: nearly the same at half the rate, where a jump would be
        # halved, a kink's peak too
        fine, coarse = (
            np.abs(np.diff(x, 2, axis=0)).max((0, 2)) * fps**2
            for x, fps in ((J, 120), (J[::2], 60))
        )
        assert (fine < 1.6 * coarse + 1.5).all() and fine.max() < 400  # m/s²
        bend = Rotation.from_rotvec(
            motion.poses[:, [INDEX["left_knee"], INDEX["right_knee"]]]
            .reshape(-1, 3)
            .double()
            .numpy()
        ).as_rotvec()
        assert (
            bend[:, 0].min() > -0.02
            and bend[:, 0].max() < 2.45
            and np.abs(bend[:, 1:]).max() < 1e-5
        )
        elbow = motion.poses[:, [INDEX["left_elbow"], INDEX["right_elbow"]]].double()
        for side, x in ((0, 1.0), (1, -1.0)):  # a forearm never bends backwards
            assert Rotation.from_rotvec(elbow[:, side].numpy()).apply([x, 0, 0])[:, 1].max() < 0.01
        assert elbow.norm(dim=-1).max() < 2.6
        for joint, most in (
            ("spine1", 0.5),
            ("spine2", 0.65),
            ("spine3", 0.5),
            ("neck", 0.75),
            ("head", 0.75),
            ("left_ankle", 1.25),
            ("left_collar", 0.75),
        ):
            assert motion.poses[:, INDEX[joint]].norm(dim=-1).max() < most, joint


@pytest.mark.parametrize("kind", KINDS)
def test_feet_stand_still_on_the_ground(kind):
    motion = Motion.generate(kind, seconds=8, seed=4, fps=60.0)
    feet = places(motion)[:, [INDEX["left_foot"], INDEX["right_foot"]]]
    ground = T_POSE[INDEX["left_foot"], 2].item()
    assert feet[..., 2].min() > ground - 0.02
    down = (feet[1:, :, 2] < ground + 0.004) & (feet[:-1, :, 2] < ground + 0.004)
    speed = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) * 60
    assert down.any() and np.percentile(speed[down], 98) < 0.08  # m/s


def test_feet_stand_still_on_other_bodies_when_the_way_is_fitted():
    body = AnnyBody().body((0.3, 0.75, 0.5, 0.5, 0.5, 0.5))
    motion = Motion.generate("walk", seconds=6, seed=1, fps=60.0)

    def slides(motion):
        feet = skinning.posed_joints(
            body, skinning.transforms(body, motion.poses, motion.translation)
        )[:, [10, 11]].numpy()
        down = feet[1:, :, 2] < feet[..., 2].min() + 0.006
        return np.median(np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1)[down]) * 60

    assert slides(motion.fitted(body)) < 0.03 < 0.1 < slides(motion)  # m/s
    standard = AnnyBody().body()
    assert torch.allclose(motion.fitted(standard).translation, motion.translation, atol=1e-3)


def test_walking_and_running_get_somewhere():
    for kind, low, high in (("walk", 0.6, 1.7), ("run", 1.9, 3.7)):
        for seed in range(5):
            motion = Motion.generate(kind, seconds=5, seed=seed)
            path = np.linalg.norm(np.diff(motion.translation[:, :2].numpy(), axis=0), axis=1).sum()
            assert low < path / (len(motion) / motion.fps) < high
            ahead = motion.translation[30] - motion.translation[0]
            assert ahead[1] < -0.5 * ahead[:2].norm()  # where it faces
    running = places(Motion.generate("run", seconds=5, seed=0, fps=60.0))[:, [10, 11], 2]
    assert (running.min(1) > T_POSE[10, 2].item() + 0.02).mean() > 0.1  # both feet off the ground


def test_arms_do_not_pass_through_the_body():
    body = AnnyBody().body()
    script = load("benchmarks/onefit_motions.py")
    core = script.Core(body)
    assert len(core.rings) == 2  # cut at the shoulders
    through = torch.zeros(1, 24, 3)
    through[:, INDEX["left_shoulder"], 1] = np.pi / 2 + 0.6  # an arm let down into the hip
    assert core.depth(script.posed(body, Motion(through, torch.zeros(1, 3), 30.0))[0]) > 0.03
    for kind in KINDS:
        depths = [
            core.depth(V)
            for V in script.posed(body, Motion.generate(kind, seconds=8, seed=11)[::35])
        ]
        assert max(depths) < (0.03 if kind == "pick_up" else 0.015), kind


def test_the_same_at_any_rate_and_length():
    for kind in KINDS:
        long = Motion.generate(kind, seconds=4, seed=2, fps=60.0)
        short = Motion.generate(kind, seconds=2, seed=2, fps=30.0)
        assert np.abs(places(long)[:100:2] - places(short)[:50]).max() < 0.02, kind
