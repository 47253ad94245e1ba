"""What no one's motion does: one check behind all readers of files. Units that were mistaken and
axes that were swapped end in one line, not in a body that lies on the floor or slides over it; axes
are put right where the motion says how.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from onefit.body import skeleton, skinning
from polyfit.errors import InputError


@dataclass(frozen=True)
class Likely:
    """Bounds of motions that people make.

    - ``slowest``, ``fastest``: frames a second of a file. ``rotation`` [rad]: length of a joint's
      rotation vector.
    - ``root`` [m/s]: the root's speed, in nine frames of ten, over ``window`` [s], for places that
      tremble have none. ``slide`` [m/s]: speed of the slower
      foot, in the median, from which on a body slides, if a translation a hundredth as large would
      lower it to a ``share`` of that.
    - ``above`` [m]: how far the head is above the feet of who stands or sits, in the share
      ``standing`` of the frames at least. ``along``: cosine of the angle between an axis and a body
      that lies along it; ``level``: between z and a body that lies. ``height``: the root's height
      over its ground, least and most, in leg lengths.
    """

    slowest: float = 1.0
    fastest: float = 1000.0
    rotation: float = 2 * np.pi
    root: float = 25.0
    window: float = 0.2
    slide: float = 0.7
    share: float = 0.3
    above: float = 0.25
    standing: float = 0.35
    along: float = 0.85
    level: float = 0.3
    height: tuple[float, float] = (0.5, 1.8)


_LIKELY = Likely()


def check_rate(path, fps, period=None):
    """Raises InputError for frames a second, or a frame time ``period`` [s] of a file, that are no
    one's.
    """
    if _LIKELY.slowest <= fps <= _LIKELY.fastest:
        return
    told = f"{fps:.4g} frames a second"
    if period is not None:
        told = f"a frame time of {period:g} s ({told})"
    hint = ""
    if period is not None and _LIKELY.slowest <= 1000 / period <= _LIKELY.fastest:
        hint = f" in milliseconds? then give --fps {1000 / period:.4g};"
    if period is not None and _LIKELY.slowest <= period <= _LIKELY.fastest:
        hint += f" a rate? then --fps {period:.4g};"
    raise InputError(
        f"{path}: {told};{hint} {_LIKELY.slowest:g} to {_LIKELY.fastest:g} can be used: fps=30, or"
        " --fps 30"
    )


def check_rotations(path, poses):
    """Raises InputError where rotation vectors (T, J, 3) are longer than a turn."""
    length = np.linalg.norm(poses, axis=2)
    if length.max() <= 1.001 * _LIKELY.rotation:
        return
    frame, joint = np.unravel_index(length.argmax(), length.shape)
    raise InputError(
        f"{path}: a rotation vector of length {length.max():.3g} (frame {frame}, joint {joint});"
        " radians below 2π are needed: in degrees? then multiply poses by π/180"
    )


def stood(path, poses, translation, fps, up, other):
    """``(poses, translation)`` of a file, (T, 24, 3) [rad] and (T, 3) [m] in OneFit's world, with
    the head above the feet most of the time.

    A body that lies, or stands on its head, along one axis all the time, while the root is a leg's
    length up along it, is turned so that this axis is up. Else it is refused; where the user gave
    ``up`` ("y" or "z", else None), it stays. ``other``: (the other value of ``up``, which axis (3,)
    would then be up here). Raises InputError, also for a root that flies and for feet that slide.
    """
    feet, head = _places(poses, np.zeros_like(translation))
    trunk = head - feet.mean(axis=1)
    direction = trunk.mean(axis=0) / np.linalg.norm(trunk, axis=1).mean()
    stands = (trunk[:, 2] > _LIKELY.above).mean() > _LIKELY.standing
    level = abs(direction[2]) < _LIKELY.level and np.abs(direction).max() > _LIKELY.along
    if up is None and (level or not stands):
        k = int(np.abs(direction).argmax())
        axis = np.sign(direction[k]) * np.eye(3)[k]
        height = translation @ axis / skeleton.leg_length(skeleton.standard_joints())
        least, most = _LIKELY.height
        inside = ((least < height) & (height < most)).mean() > 0.9
        if abs(direction[k]) < _LIKELY.along or not inside:
            raise InputError(_lies(path, direction, other))
        turn = to_z(axis)
        poses, translation = poses.copy(), turn.apply(translation)
        poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    check_ways(path, poses, translation, fps)
    return poses, translation


def _lies(path, direction, other):
    """A line about a body whose head is beyond its feet in a ``direction`` (3,)."""
    if direction[2] < -_LIKELY.along:
        return f"{path}: its body stands on its head most of the time; turn the motion over"
    name, axis = other
    up = "z" if name == "y" else "y"
    advice = "turn it upright"
    if direction @ axis > _LIKELY.along:
        advice = f"give up={name!r}, or --motion-up {name}"
    return (
        f"{path}: with {up} up, its body lies down most of the time; {advice}, or up={up!r} if it"
        " really lies"
    )


def check_ways(path, poses, translation, fps):
    """Raises InputError for a root that flies, and for feet that slide, with ``poses`` (T, 24, 3)
    [rad] and ``translation`` (T, 3) [m] at ``fps`` frames a second.
    """
    if len(poses) < 2:
        return
    n = int(np.clip(round(_LIKELY.window * fps), 1, len(poses) - 1))
    speed = lambda x: np.linalg.norm(x[n:] - x[:-n], axis=-1) * fps / n
    fastest = np.percentile(speed(translation), 90)
    if fastest > _LIKELY.root:
        unit = "; in centimetres? then divide it by 100" if fastest < 100 * _LIKELY.root else ""
        raise InputError(
            f"{path}: its root moves at {fastest:.3g} m/s; metres and frames a second are"
            f" needed{unit}"
        )
    slower = lambda way: float(np.median(speed(_places(poses, way)[0]).min(axis=1)))
    slides = slower(translation)
    if slides > _LIKELY.slide and slower(translation / 100) < _LIKELY.share * slides:
        raise InputError(
            f"{path}: its feet slide at {slides:.3g} m/s; is its translation in centimetres? then"
            " divide it by 100"
        )


def _places(poses, translation):
    """Places of the feet (T, 2, 3) and of the head (T, 3) [m] of the standard body."""
    at = [skeleton.INDEX[name] for name in ("left_foot", "right_foot", "head")]
    places = skinning.joint_places(
        skeleton.standard_joints(),
        torch.as_tensor(poses, dtype=torch.float32),
        torch.as_tensor(translation, dtype=torch.float32),
    )[:, at]
    places = places.double().numpy()
    return places[:, :2], places[:, 2]


def to_z(axis):
    """The shortest rotation that takes an axis (3,) to z; about x where it is -z."""
    about = np.cross(axis, [0.0, 0.0, 1.0])
    if not about.any():
        about = np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(about * np.arccos(np.clip(axis[2], -1, 1)))
