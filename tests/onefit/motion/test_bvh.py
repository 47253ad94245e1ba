"""Motions from BVH files."""

import re

import numpy as np
import pytest
import torch
from motions import FROM_SMPL, T_POSE, places, some_motion
from scipy.spatial.transform import Rotation

from onefit.body import skeleton, skinning
from onefit.body.skeleton import INDEX
from onefit.motion import Motion
from polyfit.errors import InputError

# --- BVH ------------------------------------------------------------------------------------------

PARTS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")


_LEGS = "{S}UpLeg {S}Leg {S}Foot {S}ToeBase {S}Shoulder {S}Arm {S}ForeArm {S}Hand"
_THIGHS = "thigh.{s} shin.{s} foot.{s} toe.{s} shoulder.{s} upper_arm.{s} forearm.{s} hand.{s}"
_POSER = "{l}Thigh {l}Shin {l}Foot {l}Toe {l}Collar {l}Shldr {l}ForeArm {l}Hand"
_PLAIN = "{S}Hip {S}Knee {S}Ankle {S}Toe {S}Collar {S}Shoulder {S}Elbow {S}Wrist"
_SMPL = "{s}_Hip {s}_Knee {s}_Ankle {s}_Foot {s}_Collar {s}_Shoulder {s}_Elbow {s}_Wrist"
_UNREAL = "thigh calf foot ball clavicle upperarm lowerarm hand"
# names of pelvis, spine, neck and head, and of a side's bones; Euler order; axes; units a metre
STYLES = {
    "mixamo": ("Hips Spine Spine1 Spine2 Neck Head", _LEGS, "mixamorig:", "ZXY", "y", 100.0),
    "mixamo_": ("Hips Spine Spine1 Spine2 Neck Head", _LEGS, "mixamorig_", "ZXY", "y", 1.0),
    "mixamo1": ("Hips Spine Spine1 Spine2 Neck Head", _LEGS, "mixamorig1", "XYZ", "y", 1.0),
    "cmu": ("Hips LowerBack Spine Spine1 Neck Head", _LEGS, "", "ZYX", "y", 17.7),
    "rigify": ("spine spine.001 spine.002 spine.003 spine.004 head", _THIGHS, "", "XYZ", "z", 1.0),
    "smpl": ("Pelvis Spine1 Spine2 Spine3 Neck Head", _SMPL, "", "ZYX", "y", 100.0),
    "poser": ("hip abdomen chest chest2 neck head", _POSER, "", "YZX", "y", 40.0),
    "mocap": ("Hips Chest Chest2 Chest3 Neck Head", _PLAIN, "", "ZXY", "y", 100.0),
    "unreal": (
        "pelvis spine_01 spine_02 spine_03 neck_01 head",
        " ".join(f"{part}_{{l}}" for part in _UNREAL.split()),
        *("", "ZYX", "z", 100.0),
    ),
}


def bvh_names(style):
    trunk, limbs, prefix, *_ = STYLES[style]
    joints = "pelvis spine1 spine2 spine3 neck head"
    names = dict(zip(joints.split(), trunk.split(), strict=True))
    for side in ("left", "right"):
        for part, name in zip(PARTS, limbs.split(), strict=True):
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


def test_bvh_whose_braces_share_their_lines(tmp_path):
    write_bvh(tmp_path / "m.bvh", body_only(some_motion()), "mixamo")
    text = (tmp_path / "m.bvh").read_text()
    (tmp_path / "n.bvh").write_text(re.sub(r"\s*([{}])\s*(?!MOTION)", r" \1 ", text))
    a, b = Motion.read(tmp_path / "m.bvh"), Motion.read(tmp_path / "n.bvh")
    assert (a.poses == b.poses).all() and (a.translation == b.translation).all()


def test_bvh_whose_hips_hang_on_another_root(tmp_path):
    """The way is the hips', whether they move, or the bone that they hang on."""
    motion = body_only(some_motion(size=0.3))
    write_bvh(tmp_path / "m.bvh", motion, "mixamo")
    bones, frames = (tmp_path / "m.bvh").read_text().split("MOTION")
    bones = bones.replace("ROOT", "ROOT Reference\n{\nOFFSET 0 0 0\nCHANNELS 0\nJOINT") + "}\n"
    (tmp_path / "hips.bvh").write_text(f"{bones}MOTION{frames}")
    hips = "CHANNELS 6 Xposition Yposition Zposition Zrotation"
    bones = bones.replace(hips, "CHANNELS 3 Zrotation")
    root = "CHANNELS 6 Yrotation Zposition Xposition Yposition Xrotation Zrotation"
    bones = bones.replace("CHANNELS 0", root).replace("OFFSET 0", "OFFSET 9", 1)
    bones = bones.replace("OFFSET 0.00000000 0.00000000 0.00000000", "OFFSET 0 40 30")
    head, rate, *rows = frames.strip().split("\n")
    turn = Rotation.from_euler("y", 50, degrees=True)
    moved = []
    for row in rows:
        x, y, z, *rest = row.split()
        way = np.array([x, y, z], float) - turn.apply([0, 40, 30])
        turned = turn.inv() * Rotation.from_euler("ZXY", np.array(rest[:3], float), degrees=True)
        first = [50, way[2], way[0], way[1], 0, 0, *turned.as_euler("ZXY", degrees=True)]
        moved.append(" ".join(map(str, [*first, *rest[3:]])))
    (tmp_path / "root.bvh").write_text("\n".join([f"{bones}MOTION", head, rate, *moved]))
    expected = Motion.read(tmp_path / "m.bvh")
    for name in ("hips.bvh", "root.bvh"):
        read = Motion.read(tmp_path / name)
        np.testing.assert_allclose(read.poses, expected.poses, atol=1e-4)
        np.testing.assert_allclose(read.translation, expected.translation, atol=1e-4)


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
        "CHANNELS 6 .* Wrotation .*as many names, each once": good.replace("Zrot", "Wrot", 1),
        "CHANNELS 6 .* Wposition .*as many names, each once": good.replace("Zpos", "Wpos", 1),
        "CHANNELS 6 .* Xrotation Xrotation .*each once": good.replace("Zrot", "Xrot", 1),
        "CHANNELS 2 Zrotation Xrotation Yrotation: a": good.replace("ELS 3 Z", "ELS 2 Z", 1),
        "'OFFSET 0.0 0.0': three numbers are needed": re.sub("OFFSET.*", "OFFSET 0.0 0.0", good),
    }
    for message, text in cases.items():
        (tmp_path / "bad.bvh").write_text(text)
        with pytest.raises(InputError, match=message) as error:
            Motion.read(tmp_path / "bad.bvh")
        assert "\n" not in str(error.value) and "bad.bvh" in str(error.value)
    (tmp_path / "folder.bvh").mkdir()
    with pytest.raises(InputError, match="folder.bvh: Is a directory"):
        Motion.read(tmp_path / "folder.bvh")
    (tmp_path / "bad.bvh").write_text(cases["a frame time of 0.0; give the rate"])
    assert Motion.read(tmp_path / "bad.bvh", fps=25).fps == 25
