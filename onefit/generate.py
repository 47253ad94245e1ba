"""Motions made from nothing: walking, squatting, reaching and so on, each sequence different by its seed.

A kind is a function of times (T,) [s] and a random generator to the channels of :mod:`onefit.figure`. Kinds in :data:`HELD_OUT` are for
tests only: no network of ours is trained on them, nor on seeds from :data:`HELD_OUT_SEEDS` up.
"""

import zlib

import numpy as np
from polyfit.errors import InputError

from . import figure
from .script import Script, cycle, ease, wander

HELD_OUT_SEEDS = 1_000_000  # seeds from here up are never trained on
DEG = np.pi / 180


def generate(name, seconds=10.0, seed=0, fps=30.0):
    """The :class:`~onefit.motion.Motion` of the kind ``name``; the same seed gives the same motion, at any rate and for any length.

    Raises InputError for a kind that does not exist, or a length that has no two frames.
    """
    if name not in KINDS:
        raise InputError(f"no kind of motion {name!r}; there are {', '.join(KINDS)}")
    if not (0 < fps < 10_000 and 1 <= seconds * fps <= 1e6):
        raise InputError(f"a motion of {seconds} s at {fps} frames a second; at least one frame, at most a million are needed")
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    flipped = rng.random() < 0.5
    t = np.arange(int(round(seconds * fps))) / fps
    channels = KINDS[name](t, rng)
    alive = np.random.default_rng([zlib.crc32(name.encode()), seed, 1])
    channels = _alive(channels, t, alive)
    motion = figure.motion(channels, fps, f"{name}-{seed}")
    return motion.mirrored() if flipped else motion


def _alive(channels, t, rng):
    """Breath and sway, so that nothing ever stands quite still."""
    breath = np.sin(2 * np.pi * t / rng.uniform(3.0, 4.5) + rng.uniform(0, 6))
    c = dict(channels)
    c["spine"] = c["spine"] + wander(t, rng, (0.012, 0.012, 0.02), 5.0) - 0.012 * breath[:, None] * [1, 0, 0]
    c["head"] = c["head"] + wander(t, rng, (0.04, 0.03, 0.08), 4.0)
    for side in ("left", "right"):
        c[f"{side}_arm"] = c[f"{side}_arm"] + wander(t, rng, (0.025, 0.015, 0.02, 0.03), 4.0) + 0.008 * breath[:, None] * [0, 1, 0, 0]
    return c


# --- on the spot -------------------------------------------------------------------------------------------------------------------------


def idle(t, rng):
    """Standing, weight from one leg to the other, a look around, a hand that moves."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        lean = rng.uniform(-0.055, 0.055)
        arm, other = rng.uniform((-0.3, 0.15, 0, 0.1), (0.5, 0.5, 0.3, 1.2)), rng.uniform((-0.2, 0.15, 0, 0.1), (0.2, 0.35, 0.3, 0.5))
        s.move(
            rng.uniform(1.2, 2.5), pelvis=(lean, rng.uniform(-0.02, 0.02), -0.2 * abs(lean)), turn=(0, -1.2 * lean, rng.uniform(-0.15, 0.15)),
            spine=(rng.uniform(-0.03, 0.1), 1.6 * lean, rng.uniform(-0.15, 0.15)), head=(rng.uniform(-0.2, 0.3), 0, rng.uniform(-0.8, 0.8)),
            left_arm=arm, right_arm=other,
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 1.2))
    return s.channels(t)


def squat(t, rng):
    """Squats, shallow and deep, with arms in front, hanging or overhead."""
    s = Script(rng)
    wide, out = rng.uniform(0.02, 0.12), rng.uniform(0.15, 0.5)
    feet = {"left_foot": (wide, 0, 0), "right_foot": (-wide, 0, 0), "left_foot_turn": (0, out, 0.1), "right_foot_turn": (0, out, 0.1)}
    s.move(0.6, left_foot=feet["left_foot"], left_foot_turn=feet["left_foot_turn"], pelvis=(-0.03, 0, -0.02), after=0.5)
    s.move(0.6, right_foot=feet["right_foot"], right_foot_turn=feet["right_foot_turn"], pelvis=(0, 0, -0.03))
    while s.clock < t[-1] + 1:
        deep, pace = rng.uniform(0.12, 0.42), rng.uniform(0.7, 1.4)
        style = rng.choice(3)
        arm = [(rng.uniform(1.2, 1.7), 0.15, 0.2, 0.2), (0.4, 0.45, 0.2, 0.5), (rng.uniform(2.6, 2.9), 0.15, 0.0, 0.2)][style]
        s.move(
            pace, pelvis=(0, 0.3 * deep, -deep), turn=(1.4 * deep + rng.uniform(0, 0.15), 0, 0), spine=(0.5 * deep, 0, 0),
            head=(-1.2 * deep, 0, 0), left_arm=arm, right_arm=arm,
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.5))
        s.move(
            pace * rng.uniform(0.8, 1.1), pelvis=(0, 0, -0.02), turn=(0, 0, 0), spine=(0, 0, 0), head=(0, 0, 0),
            left_arm=figure.STAND["left_arm"], right_arm=figure.STAND["right_arm"],
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.5))
    return s.channels(t)


def reach(t, rng):
    """Reaching up, to the front, to the side and down with one hand or both."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        height, across = rng.uniform(0.9, 2.8), rng.uniform(-0.3, 0.9)
        arm = (height, across * (0.4 + 0.6 * (height < 2.2)), rng.uniform(-0.2, 0.2), rng.uniform(0.05, 0.4))
        both = rng.random() < 0.35
        other = arm if both else (rng.uniform(-0.4, 0.1), 0.3, 0.1, rng.uniform(0.2, 0.6))
        high = max(0.0, height - 2.0)
        s.move(
            rng.uniform(0.8, 1.4), left_arm=arm, right_arm=other, spine=(0.25 * (1.6 - height) * 0.5, -0.15 * (not both), -0.35 * (not both)),
            pelvis=(0.03 * (not both), -0.03, 0.0), turn=(0.1 * (height < 1.6), 0, -0.15 * (not both)), head=(-0.35 * high, 0, 0.2 * across),
            right_foot_turn=(0.5 * high, 0.1, 0), left_foot_turn=(0.3 * high * both, 0.1, 0),
        )  # fmt: skip
        s.hold(rng.uniform(0.1, 0.6))
        if rng.random() < 0.6:
            s.move(
                rng.uniform(0.8, 1.3), left_arm=(0.0, 0.25, 0.1, 0.3), right_arm=(0.0, 0.25, 0.1, 0.3), spine=(0, 0, 0), pelvis=(0, 0, -0.01),
                turn=(0, 0, 0), head=(0, 0, 0), right_foot_turn=(0, 0.1, 0), left_foot_turn=(0, 0.1, 0),
            )  # fmt: skip
            s.hold(rng.uniform(0.0, 0.4))
    return s.channels(t)


def twist(t, rng):
    """The trunk turned from side to side, arms swinging out, raised or on their way."""
    s = Script(rng)
    side, wide = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 0.1)
    s.move(0.7, left_foot=(wide, 0, 0), right_foot=(-wide, 0, 0), pelvis=(0, 0, -0.03))
    while s.clock < t[-1] + 1:
        far, lift = rng.uniform(0.4, 0.9), rng.uniform(0.5, 1.5)
        bent = rng.uniform(0.2, 1.2)
        arm, other = (0.2, lift, 0.1, bent), (0.7, 0.75 * lift, 0.1, bent)
        s.move(
            rng.uniform(0.6, 1.3), turn=(0, 0, 0.45 * side * far), spine=(rng.uniform(0, 0.15), 0, 0.75 * side * far),
            head=(0, 0, 0.5 * side * far), left_arm=arm if side > 0 else other, right_arm=other if side > 0 else arm,
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.3))
        side = -side
    return s.channels(t)


def arms_up(t, rng):
    """Both arms lifted overhead by the front or by the sides, and let down again."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        high, pace, bent = rng.uniform(2.2, 2.95), rng.uniform(0.9, 1.6), rng.uniform(0.05, 0.5)
        by_front = rng.random() < 0.5
        up = (high, 0.2, 0.0, bent) if by_front else (0.15, high, 0.0, bent)
        s.move(pace, left_arm=up, right_arm=up, spine=(-0.15, rng.uniform(-0.2, 0.2), 0), head=(-0.3, 0, 0), pelvis=(0, -0.02, 0))
        s.hold(rng.uniform(0.1, 0.8))
        down = (0.0, rng.uniform(0.2, 0.5), 0.1, rng.uniform(0.1, 0.5))
        s.move(pace, left_arm=down, right_arm=down, spine=(0.05, 0, 0), head=(0, 0, 0), pelvis=(0, 0, -0.01))
        s.hold(rng.uniform(0.0, 0.5))
    return s.channels(t)


# --- going somewhere ---------------------------------------------------------------------------------------------------------------------


def _along(path, side, curvature):
    """Places (T, 2) in the world and headings (T,), of lengths ``path`` and offsets to the left ``side`` along a curve that starts to -y."""
    yaw = curvature * path
    k = curvature if abs(curvature) > 1e-6 else 1e-6
    x, y = (1 - np.cos(k * path)) / k, -np.sin(k * path) / k
    return np.stack([x + side * np.cos(yaw), y + side * np.sin(yaw)], -1), yaw


def _gait(t, rng, *, stride, rate, stance, lift, heel, sway, bob, width, curvature):
    """Channels of pelvis and feet of a gait: ``stride`` [m] between prints of a foot, ``rate`` strides a second, ``stance`` the part of the
    time that a foot is on the ground, ``lift`` and ``heel`` courses of (phase, height of the ball [m]) and (phase, pitch [rad]).

    A foot's print stays where it is; phase 0 is where the left foot touches the ground.
    """
    phase = rate * t + rng.uniform(0, 1)
    c = figure.stand(len(t))
    place, yaw = _along(stride * (phase - phase[0]), sway * np.cos(2 * np.pi * (phase - stance / 2)), curvature)
    c["pelvis"][:, :2] = place
    c["pelvis"][:, 2] = bob * np.cos(4 * np.pi * (phase - stance / 2))
    c["turn"][:, 2] = yaw
    for name, offset, sign in (("left", 0.0, 1.0), ("right", 0.5, -1.0)):
        at = phase + offset
        n, p = np.floor(at), at - np.floor(at)
        path = stride * (n + ease((p - stance) / (1 - stance)) + stance / 2 - offset - phase[0])
        out, front = figure.BALL[0] - width, -figure.BALL[1]
        place, foot_yaw = _along(path, sign * out, curvature)
        place = place + front * np.stack([np.sin(foot_yaw), -np.cos(foot_yaw)], -1)
        c[f"{name}_foot"][:, :2] = place - [sign * figure.BALL[0], -front]
        c[f"{name}_foot"][:, 2] = cycle(at, lift, 0.03)
        c[f"{name}_foot_turn"] = np.stack([cycle(at, heel, 0.03), 0.1 + sign * foot_yaw, np.zeros(len(t))], -1)
    return c, phase


def walk(t, rng):
    """Walking at 0.7 to 1.7 m/s, straight on or in a bend."""
    speed = rng.uniform(0.7, 1.7)
    stride = 0.85 * speed**0.5 * rng.uniform(0.95, 1.1) + 0.25
    push = rng.uniform(0.75, 1.0) * min(1.0, 0.55 + 0.35 * speed)
    c, phase = _gait(
        t, rng, stride=stride, rate=speed / stride, stance=0.62, sway=rng.uniform(0.015, 0.03), bob=0.012 + 0.01 * speed,
        lift=[(0.0, 0.0), (0.6, 0.0), (0.72, 0.05), (0.85, 0.02), (0.97, 0.005)], width=rng.uniform(0.02, 0.05),
        heel=[(0.0, -0.3), (0.1, 0.0), (0.36, 0.0), (0.62, push), (0.7, 0.8 * push), (0.86, -0.1), (0.97, -0.35)],
        curvature=rng.uniform(-0.25, 0.25),
    )  # fmt: skip
    wave, beat = np.cos(2 * np.pi * phase), np.cos(2 * np.pi * (phase - 0.31))
    swing = rng.uniform(0.2, 0.6) * (0.5 + 0.5 * speed)
    c["turn"] += np.stack([0.02 + 0.03 * speed + 0 * wave, -0.05 * beat, -0.09 * speed * wave], -1)
    c["spine"] = np.stack([rng.uniform(0, 0.08) + 0 * wave, 0.05 * beat, 0.16 * speed * wave], -1)
    c["head"] = np.stack([0.0 * wave, 0.0 * wave, -0.06 * speed * wave], -1)
    bent = rng.uniform(0.15, 0.6)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        forward = sign * np.cos(2 * np.pi * (phase - 0.03))
        c[f"{side}_arm"] = np.stack([swing * forward, 0.17 + 0 * wave, 0.15 + 0 * wave, bent + 0.5 * swing * (1 + forward)], -1)
    return c


def run(t, rng):
    """Running at 2.2 to 4 m/s, straight on or in a wide bend."""
    speed = rng.uniform(2.2, 4.0)
    rate = rng.uniform(1.3, 1.5)
    c, phase = _gait(
        t, rng, stride=speed / rate, rate=rate, stance=0.38, sway=0.012, bob=-0.035, width=0.07,
        lift=[(0.0, 0.0), (0.36, 0.0), (0.5, 0.22), (0.62, 0.2 + 0.07 * speed), (0.75, 0.3), (0.9, 0.06)],
        heel=[(0.0, -0.15), (0.08, 0.0), (0.2, 0.1), (0.4, 0.9), (0.6, 1.5), (0.75, 0.5), (0.9, -0.1)],
        curvature=rng.uniform(-0.08, 0.08),
    )  # fmt: skip
    wave, beat = np.cos(2 * np.pi * phase), np.cos(2 * np.pi * (phase - 0.19))
    c["pelvis"][:, 2] -= 0.05
    c["turn"] += np.stack([0.1 + 0.03 * speed + 0 * wave, -0.06 * beat, -0.2 * wave], -1)
    c["spine"] = np.stack([0.08 + 0.03 * np.cos(4 * np.pi * phase), 0.05 * beat, 0.4 * wave], -1)
    c["head"] = np.stack([-0.12 + 0 * wave, 0 * wave, -0.2 * wave], -1)
    swing, bent = rng.uniform(0.6, 0.85), rng.uniform(1.3, 1.7)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        forward = sign * np.cos(2 * np.pi * (phase - 0.02))
        c[f"{side}_arm"] = np.stack([swing * forward - 0.1, 0.3 + 0 * wave, 0.3 + 0.2 * forward, bent + 0.25 * forward], -1)
    return c


def kick(t, rng):
    """High kicks to the front, one leg after the other or always the same, after a step back with the kicking leg."""
    s = Script(rng)
    s.move(0.5, left_arm=(0.5, 0.4, 0.3, 1.4), right_arm=(0.5, 0.4, 0.3, 1.4), pelvis=(0, 0, -0.03))
    side = rng.choice(["left", "right"])
    while s.clock < t[-1] + 1:
        sign = 1.0 if side == "left" else -1.0
        foot, other = f"{side}_foot", "right" if side == "left" else "left"
        high, out = rng.uniform(0.6, 1.15), rng.uniform(-0.1, 0.15)
        pace = rng.uniform(0.4, 0.6)
        s.move(pace, pelvis=(-0.05 * sign, 0.05, -0.05), **{foot: (0, 0.35, 0), f"{foot}_turn": (0.5, 0.15, 0)})
        s.move(
            pace, pelvis=(-0.085 * sign, 0.0, -0.02), turn=(-0.12 - 0.25 * high, -0.1 * sign, -0.15 * sign), spine=(0.1, 0, 0.2 * sign),
            **{foot: (out * sign, -0.35 - 0.28 * high, high), f"{foot}_turn": (0.6 - 1.3 * high, 0.05, 0)},
            **{f"{other}_arm": (1.3, 0.4, 0.2, 0.8), f"{side}_arm": (-0.4, 0.7, 0.1, 0.5)},
        )  # fmt: skip
        s.move(
            pace * 1.2, pelvis=(0, 0, -0.03), turn=(0, 0, 0), spine=(0.05, 0, 0), left_arm=(0.5, 0.4, 0.3, 1.4), right_arm=(0.5, 0.4, 0.3, 1.4),
            **{foot: (0, 0, 0), f"{foot}_turn": (0, 0.1, 0)},
        )  # fmt: skip
        s.hold(rng.uniform(0.1, 0.5))
        if rng.random() < 0.6:
            side = other
    return s.channels(t)


_TRAINING = (idle, walk, run, squat, reach, twist, arms_up, kick)
_HELD_OUT = ()
TRAINING = tuple(kind.__name__ for kind in _TRAINING)
HELD_OUT = tuple(kind.__name__ for kind in _HELD_OUT)
KINDS = {kind.__name__: kind for kind in _TRAINING + _HELD_OUT}
