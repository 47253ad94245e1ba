"""Motions from BVH files, whatever their skeleton's names, unit and axes, as far as these can be
told.
"""

import re
from textwrap import shorten

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from onefit.body import skeleton
from polyfit.errors import InputError
from polyfit.files import text_encoding

from .likely import check_rate, to_z
from .placing import require_finite

# Names of bones, without case, separators, prefixes as in "mixamorig:", and sides, for each joint:
# the first that a file has counts. Mixamo, CMU and MotionBuilder; Blender's Rigify; Poser and Daz;
# Unreal; SMPL; others. The spine, the neck and what lies between are found by their place.
_NAMES = {
    "hip": ("upleg", "thigh", "upperleg", "hip", "femur"),
    "knee": ("leg", "shin", "calf", "lowerleg", "lowleg", "knee", "tibia"),
    "foot": ("toebase", "toe", "toes", "ball", "foot"),
    "ankle": ("ankle", "foot"),
    "collar": ("collar", "clavicle", "shoulder"),
    "shoulder": ("arm", "upperarm", "uparm", "shldr", "shoulder", "humerus"),
    "elbow": ("forearm", "lowerarm", "lowarm", "elbow", "radius"),
    "wrist": ("wrist", "hand"),
}
_OPTIONAL = ("foot", "collar", "wrist")
_CHANNELS = tuple(f"{axis}{what}" for what in ("position", "rotation") for axis in "xyz")


def read_bvh(path, fps=None, up=None):
    """``(poses (T, 24, 3) [rad], translation (T, 3) [m], fps, what may be up instead)`` of a BVH
    file, as :func:`onefit.motion.likely.stood` takes them.

    The file's zero pose has to be a stand (T-pose, A-pose, arms down): how it is turned from the
    T-pose is found as for bodies (:func:`onefit.body.skeleton.rest_pose`), and rotations are
    counted from the T-pose from then on. Lengths are scaled by the legs', so that any unit will do.
    A rotation of a bone that the 24 joints do not have goes to the next joint outwards; fingers and
    faces are left out; up is where the head is in the zero pose; ``up`` ("y" or "z"): what it is
    in the motion, where that differs. Raises InputError where the file
    cannot be read, a limb is not found, or the zero pose is no stand.
    """
    names, parents, offsets, channels, frames, period = _parse(path)
    joint_of = _joints(path, names, parents, offsets)
    rest = _places(parents, offsets)
    turn = _axes(rest, joint_of)
    rest = rest @ turn.T
    joints = _standing(path, rest, joint_of)
    if fps is None:
        if not period > 0:
            raise InputError(
                f"{path}: a frame time of {period}; give the rate: fps=30, or --fps 30"
            )
        check_rate(path, 1 / period, period)
        fps = 1 / period
        fps = round(fps) if abs(fps - round(fps)) < 0.01 else fps
    check_rate(path, fps)

    world, places = _posed(path, parents, offsets, channels, frames)  # in the file's axes
    root = places[joint_of["pelvis"]]
    given = np.eye(3)[2] if up is None else turn @ np.eye(3)["xyz".index(up)]
    if given[2] == 0:  # the motion's up is not that of the zero pose
        over = Rotation.from_matrix(turn.T @ to_z(given).as_matrix() @ turn)
        world, root = [over * r for r in world], over.apply(root)
    C = Rotation.from_matrix(turn)
    stand = skeleton.chained_rotations(skeleton.rest_pose(joints)).numpy()
    target = [None] * 24
    for j, parent in enumerate(skeleton.PARENTS):
        bone = joint_of.get(skeleton.JOINTS[j])
        if bone is None:
            target[j] = target[parent]
        else:
            target[j] = C * world[bone] * C.inv() * Rotation.from_matrix(stand[j])
    poses = np.stack(
        [
            (r if p < 0 else target[p].inv() * r).as_rotvec()
            for r, p in zip(target, skeleton.PARENTS, strict=True)
        ],
        1,
    )
    scale = skeleton.leg_length(skeleton.standard_joints()) / skeleton.leg_length(joints)
    other = "y" if turn[2, 2] != 0 else "z"
    axis = turn @ np.eye(3)["xyz".index(other)]
    return poses, root @ turn.T * scale, fps, (other, axis)


def _parse(path):
    """(names, parents, offsets (B, 3), channels, frames (T, C), frame time) of a BVH file; end
    sites are bones named ``None``.
    """
    try:
        with open(path, encoding=text_encoding(path), errors="replace") as file:
            text = file.read()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    head, motion, tail = text.partition("MOTION")
    if not motion or "HIERARCHY" not in head:
        raise InputError(f"{path}: no BVH file (HIERARCHY and MOTION are needed)")
    names, parents, offsets, channels, open_bones = [], [], [], [], []
    try:
        bones = re.sub("([{}])", r"\n\1\n", head.split("HIERARCHY", 1)[1])  # a line for each brace
        for line in bones.split("\n"):
            word = line.split()
            if not word:
                continue
            if word[0] in ("ROOT", "JOINT", "End"):
                names.append(None if word[0] == "End" else " ".join(word[1:]))
                parents.append(open_bones[-1] if open_bones else -1)
                offsets.append(np.zeros(3))
                channels.append([])
            elif word[0] == "{":
                open_bones.append(len(names) - 1)
            elif word[0] == "}":
                open_bones.pop()
            elif word[0] == "OFFSET":
                if len(word) < 4:
                    raise ValueError(f"{line.strip()[:60]!r}: three numbers are needed")
                offsets[open_bones[-1]] = np.array(word[1:4], dtype=float)
            elif word[0] == "CHANNELS":
                channels[open_bones[-1]] = _channels(word[1:])
            else:
                raise ValueError(f"{word[0]!r} in the hierarchy")
        found = re.match(r"\s*Frames:\s*(\d+)\s*Frame Time:\s*(\S+)(.*)", tail, re.S)
        if not found:
            raise ValueError("Frames: and Frame Time: are needed after MOTION")
        values = np.array(found[3].split(), dtype=float)
        count = sum(map(len, channels))
        if count == 0 or len(values) == 0 or len(values) % count:
            raise ValueError(f"{len(values)} numbers for {count} channels")
        frames = values.reshape(-1, count)
        if len(frames) - int(found[1]) not in (0, 1):  # some count without the first, the zero pose
            raise ValueError(f"{found[1]} frames are announced, {len(frames)} are there")
        if parents.count(-1) != 1 or not np.isfinite(offsets).all():
            raise ValueError("one root and finite offsets are needed")
        return names, parents, np.array(offsets), channels, frames, float(found[2])
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: no BVH file that can be read ({error})") from None


def _channels(words):
    """The channels that a line ``CHANNELS`` names, in lower case, after their number."""
    found = [word.lower() for word in words[1:]]
    if len(found) != int(words[0]) or not len(found) == len(set(found) & set(_CHANNELS)):
        raise ValueError(
            f"CHANNELS {' '.join(words)[:80]}: a number is needed, and as many names, each once, of"
            " Xposition, Yposition, Zposition, Xrotation, Yrotation, Zrotation"
        )
    return found


def _joints(path, names, parents, offsets):
    """Bones (numbers) by the names of our joints. Raises InputError where a limb is not found."""
    by_side = {"left": {}, "right": {}}
    for bone, name in enumerate(names):
        side, base = _side(name)
        if side:
            by_side[side].setdefault(base, bone)
    found = {}
    for side, bones in by_side.items():
        taken = set()
        for joint, bases in reversed(
            _NAMES.items()
        ):  # from the hand inwards: a shoulder is an arm only where no arm is, a foot an ankle
            bone = next((bones[b] for b in bases if b in bones and bones[b] not in taken), None)
            if bone is None and joint not in _OPTIONAL:
                raise InputError(
                    f"{path}: no {side} {joint} among its bones"
                    f" ({shorten(', '.join(n for n in names if n), 200)})"
                )
            if bone is not None:
                found[f"{side}_{joint}"] = bone
                taken.add(bone)
    above = lambda bone: [bone, *above(parents[bone])] if bone >= 0 else []
    hips = [above(found[f"{side}_hip"]) for side in ("left", "right")]
    pelvis = next((b for b in hips[0][1:] if b in hips[1]), None)
    arms = [above(found[f"{side}_shoulder"]) for side in ("left", "right")]
    chest = next((b for b in arms[0][1:] if b in arms[1]), None)
    if pelvis is None or chest is None or pelvis not in above(chest):
        raise InputError(f"{path}: its legs and arms do not hang on one spine")
    found["pelvis"] = pelvis
    spine = above(chest)[: above(chest).index(pelvis)][::-1]
    for k, joint in enumerate(
        ("spine1", "spine2", "spine3")
    ):  # a joint turns as the last of its third of the bones does
        if spine:
            found[joint] = spine[max(0, round((k + 1) * len(spine) / 3) - 1)]
    head = next(
        (
            b
            for b, n in enumerate(names)
            if n and re.fullmatch(r"(.*[^a-z])?head\d*", _without_prefix(n).lower())
        ),
        None,
    )
    if head is not None and chest in above(head):
        found["head"] = head
        neck = above(head)[1 : above(head).index(chest)]
        if neck:
            found["neck"] = neck[0]
    return found


def _without_prefix(name):
    """A bone's name without ``mixamorig:``, of which some programs leave the colon out, or the
    like.
    """
    return re.sub(r"(?i)^mixamorig\d*[._\- ]*", "", name.rpartition(":")[2])


def _side(name):
    """('left', 'right' or None, the rest of a bone's name without case, prefix and separators)."""
    if not name:
        return None, ""
    base = _without_prefix(name)
    for side, letter in (("left", "l"), ("right", "r")):
        for pattern in (
            rf"(?i){side}",
            rf"^(?i:{letter})[._\- ]+",
            rf"[._\- ]+(?i:{letter})(?=$|[._\- ])",
            rf"^{letter}(?=[A-Z])",
            rf"^{letter.upper()}(?=[A-Z][a-z])",
        ):
            rest, count = re.subn(pattern, "", base, count=1)
            if count:
                return side, re.sub(
                    r"[^a-z]|^(def|org)[._\-]",
                    "",
                    re.sub(r"(?i)^(def|org|bip\d*|character\d*)[._\- ]+", "", rest).lower(),
                )
    return None, ""


def _places(parents, offsets):
    places = np.zeros_like(offsets)
    for bone, parent in enumerate(parents):
        places[bone] = offsets[bone] * 0 if parent < 0 else places[parent] + offsets[bone]
    return places


def _axes(places, joint_of):
    """The rotation (3, 3) from the file's axes to OneFit's, its axes along the file's, told from
    the zero pose.
    """
    head = places[joint_of.get("head", joint_of.get("neck", joint_of["left_shoulder"]))]
    hips = 0.5 * (places[joint_of["left_hip"]] + places[joint_of["right_hip"]])
    nearest = lambda v: np.sign(v[np.abs(v).argmax()]) * np.eye(3)[np.abs(v).argmax()]
    z = nearest(head - hips)
    x = places[joint_of["left_hip"]] - places[joint_of["right_hip"]]
    x = nearest(x - (x @ z) * z)
    return np.stack([x, np.cross(z, x), z])


def _standing(path, rest, joint_of):
    """Joints (24, 3) of the zero pose, in OneFit's axes. Raises InputError where it is no stand."""
    joints = torch.zeros(24, 3, dtype=torch.float64)
    for j, (name, parent) in enumerate(zip(skeleton.JOINTS, skeleton.PARENTS, strict=True)):
        if name in joint_of:
            joints[j] = torch.as_tensor(rest[joint_of[name]])
        else:  # beyond what the file has: on, the way the bone before it goes
            joints[j] = joints[parent] + 0.3 * (
                joints[parent] - joints[skeleton.PARENTS[parent]] if parent > 0 else 0.0
            )
    trunk = joints[skeleton.INDEX["head"]] - joints[0]
    down = [
        joints[skeleton.INDEX[f"{s}_hip"], 2] - joints[skeleton.INDEX[f"{s}_ankle"], 2]
        for s in ("left", "right")
    ]
    if not (trunk[2] > 0.8 * trunk.norm() and min(down) > 0.8 * skeleton.leg_length(joints)):
        raise InputError(
            f"{path}: its zero pose is not an upright stance with the legs down; export the motion"
            " with a T-pose as rest pose"
        )
    return joints


def _posed(path, parents, offsets, channels, frames):
    """Rotations of the bones in the file's world, a list of Rotation (T,), and their places, a list
    of (T, 3): a bone's positions take the place of its offset.
    """
    require_finite(path, frames=frames)
    world, places, column = [], [], 0
    for bone, names in enumerate(channels):
        values = frames[:, column : column + len(names)]
        column += len(names)
        order, angles, place = "", [], np.tile(offsets[bone], (len(frames), 1))
        for name, value in zip(names, values.T):
            if name.endswith("rotation"):
                order += name[0].upper()
                angles.append(value)
            else:
                place[:, "xyz".index(name[0])] = value
        turn = (
            Rotation.from_euler(order, np.stack(angles, -1), degrees=True)
            if angles
            else Rotation.identity(len(frames))
        )
        above = parents[bone]
        world.append(turn if above < 0 else world[above] * turn)
        places.append(place if above < 0 else places[above] + world[above].apply(place))
    return world, places
