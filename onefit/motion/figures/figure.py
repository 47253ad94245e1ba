"""A figure to animate: postures in words of a choreographer (lean, twist, lift an arm, put a foot
there) turned into poses of 24 joints.

Everything is an array over the frames, in float64. Angles are in radians and anatomical, the same
sign on both sides of the body:

- ``pelvis`` (T, 3): where the pelvis is, from its place in the upright stand [m];
- ``turn`` (T, 3): how the pelvis is turned: leaning forward, leaning to the left, facing left;
- ``spine``, ``head`` (T, 3): bent forward, bent to the left, twisted to the left, spread over three
  and two joints;
- ``left_arm``, ``right_arm`` (T, 4): from the arm hanging straight down, flexion (swung forward; π
  is up), abduction (lifted sideways), rotation inwards, and the elbow's bend; relative to the
  chest. The collar follows the arm up;
- ``left_hand``, ``right_hand`` (T, 2): the wrist bent towards the palm, and the forearm turned palm
  up;
- ``left_foot``, ``right_foot`` (T, 3): where the ball of the foot is, from its place in the upright
  stand [m], in the world: the leg follows, bent at the knee as it has to be;
- ``left_foot_turn``, ``right_foot_turn`` (T, 3): the foot's heel lifted (toes, where negative), the
  foot turned outwards, and the knee outwards from the foot.
"""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from onefit.body import skeleton

CHANNELS = {
    "pelvis": 3, "turn": 3, "spine": 3, "head": 3, "left_arm": 4, "right_arm": 4, "left_hand": 2,
    "right_hand": 2, "left_foot": 3, "right_foot": 3, "left_foot_turn": 3, "right_foot_turn": 3,
}  # fmt: skip
# hanging arms, a hand's breadth from the hips, elbows soft
_STAND = {
    "left_arm": (0.0, 0.2, 0.1, 0.3),
    "right_arm": (0.0, 0.2, 0.1, 0.3),
    "left_foot_turn": (0.0, 0.1, 0.0),
    "right_foot_turn": (0.0, 0.1, 0.0),
}

_J = dict(zip(skeleton.JOINTS, skeleton.standard_joints().double().numpy(), strict=True))
BALL = _J["left_foot"]  # where the ball of the left foot is in the upright stand [m]
_SPINE = (
    ("spine1", 0.3),
    ("spine2", 0.4),
    ("spine3", 0.3),
)  # the parts that the joints have in the spine's angles
HIP = _J["left_hip"]  # and the left hip [m]
_THIGH = _J["left_knee"] - _J["left_hip"]
_SHIN = _J["left_ankle"] - _J["left_knee"]
_BALL = _J["left_foot"] - _J["left_ankle"]  # from the ankle to the ball
_KNEE_SOFTNESS = 0.003  # [m] of missing length over which an almost straight knee bends
_HEEL = 0.19  # from the ball back to the heel's edge, about which toes are lifted [m]
_LEG_LENGTH = float(np.linalg.norm(_THIGH + _SHIN))  # in the T-pose, its greatest [m]


def stand(frames):
    """The channels of a figure standing upright for ``frames`` frames."""
    return {
        name: np.tile(np.asarray(_STAND.get(name, np.zeros(size)), dtype=np.float64), (frames, 1))
        for name, size in CHANNELS.items()
    }


def poses_of(channels, fps):
    """``(poses (T, 24, 3) [rad], translation (T, 3) [m])``, float32, of a figure's channels.

    The pelvis is lowered, smoothly in time, where a foot would be out of its leg's reach.
    """
    c = {**stand(len(next(iter(channels.values())))), **channels}
    c["pelvis"] = _lowered(c, fps)
    local = {"pelvis": _turned(c["turn"])}
    for joint, part in _SPINE:
        local[joint] = _turned(c["spine"] * part)
    for joint, part in (("neck", 0.5), ("head", 0.5)):
        local[joint] = _turned(c["head"] * part)
    for side in ("left", "right"):
        arm = _arm(c[f"{side}_arm"], c[f"{side}_hand"])
        leg = _leg(c, side)
        local |= {
            f"{side}_{joint}": mirror(rotation) if side == "right" else rotation
            for joint, rotation in (arm | leg).items()
        }
    poses = np.zeros((len(c["pelvis"]), len(skeleton.JOINTS), 3))
    for joint, rotation in local.items():
        poses[:, skeleton.INDEX[joint]] = rotation.as_rotvec()
    return torch.from_numpy(poses).float(), torch.from_numpy(c["pelvis"]).float()


def mirror(rotation):
    """A Rotation seen in the mirror x → -x."""
    return Rotation.from_rotvec(rotation.as_rotvec() * np.array([1.0, -1.0, -1.0]))


def _about(axis, angle):
    """Rotation by ``angle`` () or (T,) about the axis 0, 1 or 2."""
    return Rotation.from_rotvec(np.asarray(angle)[..., None] * np.eye(3)[axis])


_HANGING = _about(1, np.pi / 2)  # turns the T-pose's left arm down


def _turned(angles):
    """Rotation from angles (T, 3): forward about x, to the left about y, twisted left about z, the
    twist first.
    """
    return Rotation.from_euler("ZXY", angles[..., [2, 0, 1]])


def _arm(arm, hand):
    """Rotations of a left arm's joints, relative to the chest and along the chain."""
    flexion, abduction, inwards, elbow = arm.T
    upper = Rotation.from_euler("XYZ", np.stack([-flexion, -abduction, -inwards], -1)) * _HANGING
    # a collar follows the arm: up by 7° where it is level and by 29° overhead, and to the front
    x, y, z = upper.apply([1.0, 0.0, 0.0]).T
    lifted = 0.5 + 0.5 * z
    forward = np.arctan2(-y, 0.5 + np.sqrt(x * x + 0.04))
    collar = Rotation.from_euler("ZY", np.stack([-0.12 * forward, -0.5 * lifted**2], -1))
    roll = -0.5 * hand[:, 1]
    wrist = Rotation.from_euler("XY", np.stack([roll, hand[:, 0]], -1))
    return {
        "collar": collar,
        "shoulder": collar.inv() * upper,
        "elbow": _about(2, -elbow) * _about(0, roll),
        "wrist": wrist,
    }


def arm_to(side, wrist, pole=(0.35, 0.5, -1.0)):
    """An arm's channel (4,) that brings the wrist to the place ``wrist`` (3,) [m] of the standard
    body standing upright.

    The elbow goes to the side of ``pole`` (3,), given for the left arm. Where the place is out of
    reach, the arm points at it.
    """
    sign = np.array([1.0 if side == "left" else -1.0, 1.0, 1.0])
    wanted = np.asarray(wrist) * sign
    aim = wanted.copy()
    for _ in range(8):  # the collar's part moves the shoulder
        arm = _two_bones(aim - _J["left_shoulder"], np.asarray(pole, dtype=np.float64))
        aim = aim + wanted - _wrist(arm)
    return arm


def in_chest(place, pelvis, turn, spine):
    """Where ``place`` (3,) [m] in the world is as seen from the chest of a figure with these
    channels (3,), in the upright stand's axes: the place to give to :func:`arm_to`.
    """
    rotation = _turned(np.asarray(turn, dtype=np.float64))
    at, before = _J["pelvis"] + pelvis, "pelvis"
    for joint, part in _SPINE:
        at = at + rotation.apply(_J[joint] - _J[before])
        rotation, before = rotation * _turned(np.asarray(spine, dtype=np.float64) * part), joint
    return rotation.inv().apply(place - at) + _J[before]


def _two_bones(to, pole):
    """The arm (4,) whose wrist is at ``to`` (3,) from the shoulder, or in that direction."""
    a, b = (
        np.linalg.norm(_J[end] - _J[start])
        for start, end in (("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"))
    )
    distance = np.clip(np.linalg.norm(to), abs(a - b) + 0.05, 0.999 * (a + b))
    u = to / np.linalg.norm(to)
    p = pole - (pole @ u) * u
    p /= np.linalg.norm(p)
    along = (a * a + distance**2 - b * b) / (2 * a * distance)
    upper = along * u + np.sqrt(max(0.0, 1 - along**2)) * p
    fore = (distance * u - a * upper) / b
    hinge = np.cross(upper, fore)
    hinge /= np.linalg.norm(hinge)
    turned = (
        Rotation.from_matrix(np.stack([upper, np.cross(upper, hinge), -hinge], -1)) * _HANGING.inv()
    )
    angles = -turned.as_euler("XYZ")
    # the same rotation has two sets of angles: the one with the smaller turn of the arm about
    # itself interpolates well
    other = np.array([angles[0] + np.pi, np.pi - angles[1], angles[2] + np.pi])
    angles = min((_wrapped(angles), _wrapped(other)), key=lambda a: abs(a[2]) + 0.1 * abs(a[0]))
    return np.append(angles, np.arccos(np.clip(upper @ fore, -1, 1)))


def _wrapped(angles):
    """Flexion and abduction from -π/2 to 3π/2, rotation inwards from -π to π."""
    low = np.array([-np.pi / 2, -np.pi / 2, -np.pi])
    return (angles - low) % (2 * np.pi) + low


def _wrist(arm):
    """Where a left arm (4,) has its wrist, (3,) [m], the chest upright."""
    joints = {name: rotation[0] for name, rotation in _arm(arm[None], np.zeros((1, 2))).items()}
    place, rotation = _J["left_collar"], Rotation.identity()
    for joint, end in (
        ("collar", "left_shoulder"),
        ("shoulder", "left_elbow"),
        ("elbow", "left_wrist"),
    ):
        rotation = rotation * joints[joint]
        place = place + rotation.apply(_J[end] - _J["left_" + joint])
    return place


def _side(c, side):
    """What the leg of a side needs, mirrored to a left leg: ankles (T, 3), rotations of foot and
    pelvis, hip (T, 3), the knee's yaw (T,)."""
    sign = np.array([1.0 if side == "left" else -1.0, 1.0, 1.0])
    pelvis = _turned(c["turn"])
    if side == "right":
        pelvis = mirror(pelvis)
    root = (_J["pelvis"] + c["pelvis"]) * sign
    heel, out, knee = c[f"{side}_foot_turn"].T
    ball = c[f"{side}_foot"] * sign + _J["left_foot"]
    ball[:, 2] += _HEEL * np.sin(_above(-heel))
    foot = Rotation.from_euler("ZX", np.stack([out, heel], -1))
    ankle = ball - foot.apply(_BALL)
    hip = root + pelvis.apply(_J["left_hip"] - _J["pelvis"])
    return ankle, foot, pelvis, hip, out + knee


def _above(x, width=0.1):
    """max(x, 0), smoothly, and 0 at 0."""
    return 0.5 * (x + np.sqrt(x * x + width * width) - width)


def _leg(c, side):
    """Rotations of a leg's joints, as of a left leg: the ankle where the foot wants it, the knee
    bent as the distance asks.
    """
    ankle, foot, pelvis, hip, knee_yaw = _side(c, side)
    to = ankle - hip
    # never quite straight: there the knee's bend goes with the root of what is missing, and would
    # jerk
    most = 0.9985 * _LEG_LENGTH
    distance = most - _KNEE_SOFTNESS * np.logaddexp(
        0.0, (most - np.linalg.norm(to, axis=1)) / _KNEE_SOFTNESS
    )
    distance = np.maximum(distance, 0.35 * _LEG_LENGTH)
    # law of cosines in the thigh's frame: |thigh + Rx(k) shin| = distance, with thigh and shin in
    # the plane x = 0
    a, b = np.linalg.norm(_THIGH), np.linalg.norm(_SHIN)
    rest = np.arctan2(_SHIN[1], -_SHIN[2]) - np.arctan2(
        _THIGH[1], -_THIGH[2]
    )  # the T-pose's own soft bend
    bend = np.arccos(np.clip((distance**2 - a * a - b * b) / (2 * a * b), -1, 1)) - rest
    knee = _about(0, bend)
    leg = _THIGH + knee.apply(_SHIN)  # from hip to ankle in the thigh's frame, x = 0
    pole = np.stack([np.sin(knee_yaw), -np.cos(knee_yaw), np.zeros(len(to))], -1)
    # the knee points with the foot, in the world's horizontal, but no farther up than the leg's own
    # front where the thigh is lifted
    thigh = (
        _frame(to, pole + 0.5 * pelvis.apply([0.0, -1.0, 0.0]) + 0.35 * _up(to))
        * _frame(leg, np.array([0.0, -1.0, 0.0])).inv()
    )
    ankle_rotation = (thigh * knee).inv() * foot
    on_ground = np.exp(-((np.clip(c[f"{side}_foot"][:, 2], 0, None) / 0.04) ** 2))
    toes = _about(0, -0.9 * _above(c[f"{side}_foot_turn"][:, 0]) * on_ground)
    return {"hip": pelvis.inv() * thigh, "knee": knee, "ankle": ankle_rotation, "foot": toes}


def _up(to):
    """Upwards (T, 3), as far as a leg (T, 3) is lifted to the front or back: the knee of a lifted
    leg points up.
    """
    lifted = np.linalg.norm(to[:, :2], axis=1) / np.linalg.norm(to, axis=1)
    return np.stack([np.zeros(len(to)), np.zeros(len(to)), 3 * lifted**2], -1)


def _frame(axis, pole):
    """Rotations whose -z goes along axis (T, 3) and whose -y lies on pole's side (T, 3)."""
    z = -axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    x = np.cross(-np.broadcast_to(pole, z.shape), z)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], -1))


def _lowered(c, fps):
    """``pelvis`` (T, 3), lowered until both legs reach their feet."""
    pelvis = c["pelvis"].copy()
    for _ in range(3):
        excess = np.zeros(len(pelvis))
        for side in ("left", "right"):
            ankle, _, _, hip, _ = _side(c | {"pelvis": pelvis}, side)
            across = np.linalg.norm((ankle - hip)[:, :2], axis=1)
            highest = ankle[:, 2] + np.sqrt(
                np.clip((0.996 * _LEG_LENGTH) ** 2 - across**2, 0.01, None)
            )
            excess = np.maximum(excess, hip[:, 2] - highest)
        if not (excess > 0).any():
            break
        excess = np.pad(excess, 30, mode="edge")
        wide = max(1.0, 0.06 * fps)
        pelvis[:, 2] -= 1.3 * gaussian_filter1d(excess, wide)[30:-30]
    return pelvis
