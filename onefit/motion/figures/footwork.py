"""Kinds of motion of the legs: squatting, kicking, sitting down, turning, lunging, jumping. See
:mod:`onefit.motion.generate`.
"""

import itertools

import numpy as np
from scipy.interpolate import BPoly
from scipy.ndimage import gaussian_filter1d

from . import figure
from .script import Script, hanging, sides, step

G = 9.81  # [m/s²]


def squat(t, rng):
    """Squats, shallow and deep, with arms in front, hanging or overhead."""
    s = Script(rng)
    wide, out = rng.uniform(0.02, 0.12), rng.uniform(0.15, 0.5)
    s.move(
        0.6,
        left_foot=(wide, 0, 0),
        left_foot_turn=(0, out, 0.1),
        pelvis=(-0.03, 0, -0.02),
        after=0.5,
    )
    s.move(0.6, right_foot=(-wide, 0, 0), right_foot_turn=(0, out, 0.1), pelvis=(0, 0, -0.03))
    while s.clock < t[-1] + 1:
        deep, pace = rng.uniform(0.12, 0.42), rng.uniform(0.7, 1.4)
        arm = [
            (rng.uniform(1.2, 1.7), 0.15, 0.2, 0.2),
            (0.3, 0.5, 0.2, 0.5),
            (rng.uniform(2.6, 2.9), 0.15, 0.0, 0.2),
        ][rng.choice(3)]
        s.move(
            pace, pelvis=(0, 0.45 * deep, -deep), turn=(1.4 * deep + rng.uniform(0, 0.15), 0, 0),
            spine=(0.5 * deep, 0, 0), head=(-1.2 * deep, 0, 0), left_arm=arm, right_arm=arm,
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.5))
        s.move(
            pace * rng.uniform(0.8, 1.1), pelvis=(0, 0, -0.02), turn=(0, 0, 0), spine=(0, 0, 0),
            head=(0, 0, 0), left_arm=hanging(rng), right_arm=hanging(rng),
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.5))
    return s.channels(t)


def kick(t, rng):
    """High kicks to the front with a nearly straight leg that swings from behind."""
    s = Script(
        rng, left_swing=2, right_swing=2
    )  # the leg's angle, and how far the foot is off the ground
    guard = (0.5, 0.4, 0.3, 1.4)
    s.move(0.5, left_arm=guard, right_arm=guard, pelvis=(0, 0, -0.03))
    while s.clock < t[-1] + 1:
        one, other, sign = sides(rng)
        high, pace = rng.uniform(1.1, 1.9), rng.uniform(0.45, 0.65)
        turn = f"{one}_foot_turn"
        s.move(0.5 * pace, **{f"{one}_swing": (0.0, 0.06), turn: (0.2, 0.1, 0)}, after=0.25 * pace)
        s.move(
            pace,
            pelvis=(-0.06 * sign, -0.03, -0.05),
            **{f"{one}_swing": (-0.5, 0.06), turn: (0.7, 0.1, 0)},
        )
        s.move(
            1.2 * pace, pelvis=(-0.085 * sign, 0.0, -0.02),
            turn=(-0.1 - 0.15 * high, -0.08 * sign, -0.15 * sign), spine=(0.2, 0, 0.2 * sign),
            head=(0.15, 0, 0), **{f"{one}_swing": (high, 0.06), turn: (0.5 - high, 0.05, 0)},
            **{f"{other}_arm": (1.3, 0.4, 0.2, 0.8), f"{one}_arm": (-0.4, 0.7, 0.1, 0.5)},
        )  # fmt: skip
        s.move(
            1.3 * pace, pelvis=(0, 0, -0.03), turn=(0, 0, 0), spine=(0.05, 0, 0), head=(0, 0, 0),
            left_arm=guard, right_arm=guard, after=1.1 * pace,
            **{f"{one}_swing": (0.0, 0.06), turn: (0, 0.1, 0)},
        )  # fmt: skip
        s.move(0.5 * pace, **{f"{one}_swing": (0.0, 0.0)})
        s.hold(rng.uniform(0.1, 0.5))
    c = s.channels(t)
    for side in ("left", "right"):  # about the hip
        swing, lift = c.pop(f"{side}_swing").T
        _, y, z = figure.BALL - figure.HIP
        y, z = z * np.sin(swing) + y * np.cos(swing) - y, z * np.cos(swing) - y * np.sin(swing) - z
        c[f"{side}_foot"] += np.stack([0 * y, y, z + lift], -1)
    return c


def sit(t, rng):
    """Sitting down on a chair that is not there, hands on the thighs or beside, leaning and looking
    round, and standing up.
    """
    s = Script(rng)
    while s.clock < t[-1] + 1:
        deep, pace = rng.uniform(0.31, 0.38), rng.uniform(0.8, 1.2)
        apart = rng.uniform(0.0, 0.3)
        seat, on_thighs, far = (0.0, 0.4, -deep), rng.random() < 0.7, rng.uniform(0.16, 0.3)

        def posture(spine, seat=seat, on_thighs=on_thighs, far=far, apart=apart):
            turn = (-0.12, 0, 0)
            arms = {"left": (0.0, 0.4, 0.1, 0.35), "right": (0.0, 0.4, 0.1, 0.35)}
            if on_thighs:
                for side, sign in (("left", 1.0), ("right", -1.0)):
                    place = np.array(
                        [sign * (0.13 + 0.5 * apart * far), seat[1] - far, seat[2] + 0.21]
                    )
                    arms[side] = figure.arm_to(
                        side, figure.in_chest(place, seat, turn, spine), pole=(1.0, 0.6, -0.6)
                    )
            return {
                "pelvis": seat,
                "turn": turn,
                "spine": spine,
                "left_arm": arms["left"],
                "right_arm": arms["right"],
            }

        s.move(
            pace, pelvis=(0, 0.33, -0.75 * deep), turn=(0.55, 0, 0), spine=(0.25, 0, 0),
            head=(-0.4, 0, 0), left_arm=(0.7, 0.35, 0.1, 0.6), right_arm=(0.7, 0.35, 0.1, 0.6),
            left_foot_turn=(0, 0.1, apart), right_foot_turn=(0, 0.1, apart), after=0.7 * pace,
        )  # fmt: skip
        s.move(pace, head=(0, 0, 0), **posture((0.12, 0, 0)))
        for _ in range(rng.integers(1, 4)):
            spine = (rng.uniform(-0.05, 0.35), rng.uniform(-0.12, 0.12), rng.uniform(-0.3, 0.3))
            s.move(
                rng.uniform(0.8, 1.6),
                head=(rng.uniform(-0.3, 0.2), 0, rng.uniform(-0.6, 0.6)),
                **posture(spine),
            )
        s.move(
            0.5 * pace,
            left_arm=(0.7, 0.45, 0.1, 0.8),
            right_arm=(0.7, 0.45, 0.1, 0.8),
            after=0.2 * pace,
        )
        s.move(
            0.8 * pace,
            pelvis=(0, 0.3, -0.75 * deep),
            turn=(0.6, 0, 0),
            spine=(0.25, 0, 0),
            head=(-0.4, 0, 0),
            after=0.55 * pace,
        )
        s.move(
            pace,
            pelvis=(0, 0, 0),
            turn=(0, 0, 0),
            spine=(0, 0, 0),
            head=(0, 0, 0),
            left_arm=hanging(rng),
            right_arm=hanging(rng),
        )
        s.hold(rng.uniform(0.1, 0.6))
    return s.channels(t)


def turn(t, rng):
    """Turning round on the spot, step by step, by a quarter to a full turn."""
    s = Script(rng)
    yaw = 0.0
    while s.clock < t[-1] + 1:
        direction = rng.choice([-1.0, 1.0])
        first, second = ("left", "right") if direction > 0 else ("right", "left")
        part, pace = rng.uniform(0.5, 0.85), rng.uniform(0.38, 0.6)
        arms = rng.uniform(0.32, 0.7)
        for k in range(rng.integers(2, 7)):
            yaw += direction * part
            swing = (-1) ** k * 0.25
            s.move(
                0.9 * pace, turn=(0.03, 0, yaw - 0.3 * direction * part),
                head=(0.05, 0, 0.35 * direction), spine=(0.03, 0, 0.2 * direction),
                left_arm=(swing, arms, 0.1, 0.5), right_arm=(-swing, arms, 0.1, 0.5), after=0.05,
                pelvis=(0, 0, -0.03),
            )  # fmt: skip
            for foot in (first, second):
                s.move(0.85 * pace, **step(foot, yaw), after=0.75 * pace)
        s.move(
            0.7,
            turn=(0, 0, yaw),
            head=(0, 0, 0),
            spine=(0, 0, 0),
            pelvis=(0, 0, -0.01),
            left_arm=hanging(rng),
            right_arm=hanging(rng),
        )
        s.hold(rng.uniform(0.0, 0.8))
    return s.channels(t)


def side_step(t, rng):
    """Steps to the side and back, feet together and apart, arms out or swinging."""
    s = Script(rng)
    x = 0.0
    while s.clock < t[-1] + 1:
        one, other, sign = sides(rng)
        far, pace, lift, low = (
            rng.uniform(0.25, 0.45),
            rng.uniform(0.35, 0.6),
            rng.uniform(0.3, 1.2),
            rng.uniform(0.03, 0.12),
        )
        for _ in range(rng.integers(1, 4)):
            x += sign * far
            s.move(
                pace, pelvis=(x - 0.5 * sign * far, 0.03, -low), turn=(0.1, 0.05 * sign, 0),
                spine=(0.06, -0.1 * sign, 0), left_arm=(0.1, lift, 0.1, 0.4),
                right_arm=(0.1, lift, 0.1, 0.4), **step(one, 0.0, (x, 0.0)),
            )  # fmt: skip
            s.move(
                pace, pelvis=(x, 0, -0.02), turn=(0.03, 0, 0), spine=(0.02, 0, 0),
                left_arm=(0.3, 0.3, 0.2, 0.8), right_arm=(0.3, 0.3, 0.2, 0.8),
                **step(other, 0.0, (x, 0.0)),
            )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.4))
    return s.channels(t)


def lunge(t, rng):
    """Long steps forward into a deep lunge and back, hands at the sides, overhead or on the way."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        one, other, _ = sides(rng)
        far, deep, pace = rng.uniform(0.5, 0.8), rng.uniform(0.18, 0.34), rng.uniform(0.7, 1.1)
        arm = [
            (0.1, 0.35, 0.1, 0.3),
            (rng.uniform(2.5, 2.9), 0.15, 0.0, 0.2),
            (0.2, 1.4, 0.0, 0.2),
            (1.3, 0.2, 0.2, 0.3),
        ][rng.choice(4)]
        s.move(
            pace, pelvis=(0, -0.48 * far, -deep), turn=(0.1, 0, rng.uniform(-0.1, 0.1)),
            spine=(0.02, 0, rng.uniform(-0.3, 0.3)), left_arm=arm, right_arm=arm,
            **{f"{one}_foot": (0, -far, 0), f"{other}_foot_turn": (rng.uniform(0.6, 0.9), 0.02, 0)},
        )  # fmt: skip
        s.hold(rng.uniform(0.1, 0.6))
        s.move(
            pace, pelvis=(0, 0, -0.01), turn=(0, 0, 0), spine=(0, 0, 0), left_arm=hanging(rng),
            right_arm=hanging(rng), **{f"{one}_foot": (0, 0, 0), f"{other}_foot_turn": (0, 0.1, 0)},
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.4))
    return s.channels(t)


def _flights(t, starts, heights):
    """Course of the ground-free height (T,) [m] of jumps that leave the ground at ``starts`` [s]
    and rise by ``heights`` [m]: parabolas.
    """
    fine = np.arange(t[0] - 1, t[-1] + 1, 1 / 480)
    total = np.zeros(len(fine))
    for start, height in zip(starts, heights, strict=True):
        half = np.sqrt(2 * height / G)
        total += np.maximum(0.0, height - 0.5 * G * (fine - start - half) ** 2) * (
            np.abs(fine - start - half) <= half
        )
    return fine, total


def jump(t, rng):
    """Jumps from both feet: crouch, spring, land in the knees; arms swing along or reach up."""
    s = Script(rng)
    keys, values, flights = [0.0], [[-0.01, 0.0, 0.0]], []
    s.move(0.3, left_arm=(0.1, 0.3, 0.1, 0.5), right_arm=(0.1, 0.3, 0.1, 0.5))
    while s.clock < t[-1] + 1:
        height, deep = rng.uniform(0.06, 0.25), rng.uniform(0.18, 0.3)
        v, half = np.sqrt(2 * G * height), np.sqrt(2 * height / G)
        load, push, soak = rng.uniform(0.5, 0.8), 2.6 * deep / v, rng.uniform(0.28, 0.4)
        start = s.clock
        lift = start + load + push
        up = [(2.4, 0.2, 0, 0.3), (0.8, 0.5, 0.2, 1.0), (0.2, 1.5, 0.0, 0.3)][rng.choice(3)]
        # the pelvis: crouch, spring off with the velocity of the flight, fall, land, stand
        keys += [
            start,
            start + load,
            lift,
            lift + half,
            lift + 2 * half,
            lift + 2 * half + soak,
            lift + 2 * half + soak + 0.8,
        ]
        values += [
            [-0.01, 0, 0],
            [-deep, 0, 0],
            [0.07, v, -G],
            [0.07 + height, 0, -G],
            [0.07, -v, -G],
            [-0.8 * deep, 0, 0],
            [-0.01, 0, 0],
        ]
        flights.append((lift, height))
        s.move(
            load,
            turn=(1.5 * deep, 0, 0),
            spine=(0.3, 0, 0),
            head=(-0.3, 0, 0),
            left_arm=(-0.7, 0.25, 0, 0.2),
            right_arm=(-0.7, 0.25, 0, 0.2),
        )
        s.move(
            push + 0.5 * half, turn=(0, 0, 0), spine=(-0.05, 0, 0), head=(0, 0, 0), left_arm=up,
            right_arm=up, left_foot_turn=(0.75, 0.1, 0), right_foot_turn=(0.75, 0.1, 0),
        )  # fmt: skip
        s.hold(0.5 * half)
        s.move(
            half + 0.3 * soak,
            left_foot_turn=(0, 0.1, 0),
            right_foot_turn=(0, 0.1, 0),
            after=0.6 * half,
        )
        s.move(
            0.4 * half + soak,
            turn=(deep, 0, 0),
            spine=(0.25, 0, 0),
            left_arm=(0.5, 0.4, 0.1, 0.5),
            right_arm=(0.5, 0.4, 0.1, 0.5),
        )
        s.move(
            0.8,
            turn=(0, 0, 0),
            spine=(0, 0, 0),
            left_arm=(0.1, 0.3, 0.1, 0.5),
            right_arm=(0.1, 0.3, 0.1, 0.5),
        )
        s.hold(rng.uniform(0.1, 0.6))
    c = s.channels(t)
    first = [i for i, (a, b) in enumerate(itertools.pairwise(keys)) if b > a]  # holds of no length
    keys, values = [keys[i] for i in first] + [keys[-1]], [values[i] for i in first] + [values[-1]]
    height = BPoly.from_derivatives(keys, values)(np.minimum(t, keys[-1]))
    fine, free = _flights(t, *zip(*flights, strict=True))
    feet = np.interp(t, fine, gaussian_filter1d(free, 480 * 0.03))
    c["pelvis"][:, 2] = height
    c["pelvis"][:, 1] = (
        0.3 * np.logaddexp(0.0, -height / 0.03) * 0.03
    )  # the seat goes back as it goes down
    for side in ("left", "right"):
        c[f"{side}_foot"][:, 2] += feet
    return c
