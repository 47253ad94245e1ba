"""The one skeleton of OneFit: SMPL's 24 joints, the T-pose that angles count from, and the A-pose
in which bodies rest.

World: metres, z up; the body faces -y and its left is +x. A pose (24, 3) holds each joint's
rotation relative to its parent as an axis-angle vector [rad] in these axes, counted from the
T-pose: arms stretched out along x, palms down, legs straight down.
"""

import itertools
import math

import torch

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar",
    "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
INDEX = {name: j for j, name in enumerate(JOINTS)}


def _levels():
    depth = []
    for parent in PARENTS:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    return tuple(
        tuple(j for j, d in enumerate(depth) if d == level) for level in range(max(depth) + 1)
    )


LEVELS = (
    _levels()
    # joints by their distance from the root: a level's rotations follow from the level before it at
    # once
)

# The A-pose in which every body rests, from the T-pose, [rad]: rest_pose() of the standard body
# (Anny with every phenotype at 0.5). Each entry is the left side's; the right side's has the
# opposite y and z. Joints that are not named stay as in the T-pose.
_STANDARD = {
    "hip": (0.0, -0.084941, 0.0),
    "knee": (0.0, -0.018970, 0.0),
    "ankle": (0.0, 0.103911, 0.0),
    "shoulder": (0.0, 0.843306, -0.018290),
    "elbow": (0.0, -0.054915, -0.750708),
    "wrist": (0.0, 0.077899, -0.020173),
}


def standard_rest_pose():
    """The A-pose (24, 3) [rad], counted from the T-pose, in which the standard body rests."""
    pose = torch.zeros(len(JOINTS), 3)
    for name, (x, y, z) in _STANDARD.items():
        pose[INDEX[f"left_{name}"]] = torch.tensor([x, y, z])
        pose[INDEX[f"right_{name}"]] = torch.tensor([x, -y, -z])
    return pose


# Joints of the standard body in the T-pose [m], the right side mirrored. Generated motions are made
# for them, and the size of others is told by them.
_STANDARD_JOINTS = {
    "pelvis": (0.0, -0.0108, 0.0504), "spine1": (0.0, 0.0223, 0.1178),
    "spine2": (0.0, 0.0076, 0.2612), "spine3": (0.0, 0.0319, 0.3939),
    "neck": (0.0, -0.0075, 0.5597), "head": (0.0, -0.0419, 0.6567),
    "hip": (0.1019, -0.0079, 0.0389), "knee": (0.1019, -0.0402, -0.3515),
    "ankle": (0.1019, -0.0039, -0.7522), "foot": (0.1132, -0.1361, -0.7981),
    "collar": (0.0220, -0.0256, 0.4930), "shoulder": (0.1616, -0.0171, 0.4675),
    "elbow": (0.4141, -0.0171, 0.4675), "wrist": (0.6412, -0.0171, 0.4675),
    "hand": (0.7375, -0.0171, 0.4675),
}  # fmt: skip


def standard_joints():
    """Joints (24, 3) [m] of the standard body in the T-pose."""
    sides = {"left": 1.0, "right": -1.0}
    places = []
    for name in JOINTS:
        side, _, part = name.partition("_")
        x, y, z = _STANDARD_JOINTS[part or side]
        places.append((x * sides.get(side, 1.0), y, z))
    return torch.tensor(places)


def leg_length(joints):
    """Length of a leg from hip to ankle, mean of both, in the unit of ``joints`` (24, 3)."""
    bones = [
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]
    return sum(float((joints[INDEX[b]] - joints[INDEX[a]]).norm()) for a, b in bones) / 2


def chained(rotations):
    """Rotations (..., 24, 3, 3) relative to the parent, to rotations (..., 24, 3, 3) relative to
    the world.
    """
    done = [None] * len(PARENTS)
    for level in LEVELS:
        own = rotations[..., list(level), :, :]
        if PARENTS[level[0]] >= 0:
            own = torch.stack([done[PARENTS[j]] for j in level], -3) @ own
        for k, j in enumerate(level):
            done[j] = own[..., k, :, :]
    return torch.stack(done, -3)


def chained_rotations(poses):
    """Rotations (..., 24, 3, 3) of the joints in the world, from poses (..., 24, 3) [rad]."""
    import roma

    return chained(roma.rotvec_to_rotmat(poses))


def rest_pose(joints):
    """The pose (24, 3) [rad] that takes the T-pose to the stand in which a body has its joints at
    ``joints`` (24, 3) [m].

    A T-pose is made from any stand by these rules, one angle fewer for each bone than a rotation
    has; what they leave open stays as it is in the stand. The upper arm is turned by the smallest
    rotation onto the x axis; the forearm, then the hand, by the smallest relative to the bone
    before it. A thigh and a shin are turned about the y axis only, until they stand upright seen
    from the front: a soft knee stays soft. Feet keep their rotation in the world, so that soles
    stay on the ground. Spine, neck, head and collars stay as they are.
    """
    with torch.no_grad():
        joints = joints.to(torch.float64)
        # rotation in the world, of the T-pose's bones to the stand's
        world = torch.eye(3, dtype=torch.float64).repeat(len(JOINTS), 1, 1)
        for side, x in (("left", 1.0), ("right", -1.0)):
            chain = [INDEX[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist", "hand")]
            axis, before = joints.new_tensor([x, 0.0, 0.0]), torch.eye(3, dtype=torch.float64)
            for joint, end in itertools.pairwise(chain):
                before = before @ _smallest_rotation(
                    axis, before.mT @ (joints[end] - joints[joint])
                )
                world[joint] = before
            world[chain[-1]] = before
            for joint, end in (("hip", "knee"), ("knee", "ankle")):
                x, _, z = (
                    joints[INDEX[f"{side}_{end}"]] - joints[INDEX[f"{side}_{joint}"]]
                ).tolist()
                world[INDEX[f"{side}_{joint}"]] = _about_y(math.atan2(-x, -z))
        return _relative(world)


def _relative(world):
    """Axis-angle vectors (24, 3) of rotations (24, 3, 3) in the world, relative to the parents."""
    import roma

    parents = world[[max(p, 0) for p in PARENTS]].clone()
    parents[0] = torch.eye(3, dtype=world.dtype)
    return roma.rotmat_to_rotvec(parents.mT @ world)


def _smallest_rotation(a, b):
    """The rotation (3, 3) about a × b that takes the direction of a (3,) to that of b (3,); they
    may not be opposite.
    """
    a, b = a / a.norm(), b / b.norm()
    v, c = torch.linalg.cross(a, b), a @ b
    K = v.new_tensor([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return torch.eye(3, dtype=a.dtype) + K + K @ K / (1 + c)


def _about_y(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)


def mirrored(poses, translation):
    """Poses (T, 24, 3) and translation (T, 3) seen in a mirror: left is right, and x is -x."""
    other = [INDEX[_other_side(name)] for name in JOINTS]
    turned = poses.new_tensor([1.0, -1.0, -1.0])
    return poses[:, other] * turned, translation * -turned


def _other_side(name):
    if name.startswith("left_"):
        return "right_" + name[5:]
    return "left_" + name[6:] if name.startswith("right_") else name
