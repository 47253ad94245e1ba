"""Kinds of motion that no network of ours is trained on: tests are made with them. See
:mod:`onefit.motion.generate`.
"""

import numpy as np

from . import figure
from .gaits import gait
from .script import Script, bump, cycle, ease, hanging, sides, step, wander


def jumping_jack(t, rng):
    """Small hops from feet together to feet apart and back, arms up by the sides and down."""
    rate = rng.uniform(0.75, 1.1)
    phase = rate * t + rng.uniform(0, 1)
    c = figure.stand(len(t))
    wide, high = rng.uniform(0.15, 0.28), rng.uniform(2.3, 2.75)
    p = phase % 1.0
    out = ease((p - 0.17) / 0.22) - ease((p - 0.64) / 0.22)  # feet and arms move while in the air
    hop = bump((p - 0.13) / 0.3) + bump((p - 0.6) / 0.3)
    arms = cycle(phase, [(0.0, 0.0), (0.05, 0.0), (0.45, 1.0), (0.55, 1.0), (0.95, 0.0)], 0.05)
    c["pelvis"][:, 2] = 0.08 * hop - 0.035
    c["turn"][:, 0] = 0.06
    c["spine"][:, 0] = 0.05 - 0.1 * out
    bent = rng.uniform(0.2, 0.5)
    zero = np.zeros(len(t))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        c[f"{side}_arm"] = np.stack(
            [0.12 + zero, 0.25 + (high - 0.25) * arms, 0.1 - 0.1 * arms, bent + zero], -1
        )
        c[f"{side}_foot"][:, 0] = sign * wide * out
        c[f"{side}_foot"][:, 2] = 0.06 * hop
        c[f"{side}_foot_turn"] = np.stack([0.12 + 0.55 * hop, 0.1 + 0.15 * out, zero], -1)
    return c


def box(t, rng):
    """Boxing: guard, jabs and hooks with either hand, the trunk behind them, small steps."""
    s = Script(rng)
    guards = {
        "left": figure.arm_to("left", (0.12, -0.3, 0.5)),
        "right": figure.arm_to("right", (-0.12, -0.24, 0.48)),
    }
    s.move(
        0.6,
        pelvis=(0, 0.02, -0.06),
        turn=(0.08, 0, -0.25),
        **{f"{side}_arm": arm for side, arm in guards.items()},
    )
    s.move(0.5, **step("right", -0.5, (0.0, 0.18), apart=0.04))
    while s.clock < t[-1] + 1:
        one, _, sign = sides(rng)
        fast, hook = rng.uniform(0.22, 0.35), rng.random() < 0.35
        arm = (1.35, 0.75, 0.25, 1.4) if hook else (rng.uniform(1.4, 1.75), -0.08, 0.3, 0.15)
        s.move(
            fast, pelvis=(0, -0.05, -0.07), turn=(0.12, 0, -0.25 - 0.3 * sign),
            spine=(0.08, 0, -0.3 * sign), head=(0.05, 0, 0.45 * sign + 0.2),
            **{f"{one}_arm": arm, f"{one}_hand": (0, 0)},
        )  # fmt: skip
        s.move(
            1.3 * fast, pelvis=(0, 0.02, -0.06), turn=(0.08, 0, -0.25), spine=(0.05, 0, 0),
            head=(0, 0, 0.2), **{f"{one}_arm": guards[one]},
        )  # fmt: skip
        s.hold(rng.choice([0.0, 0.1, 0.5, 0.9]))
    return s.channels(t)


def wave(t, rng):
    """An arm waved overhead, the other one hanging or on the way up too."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        one, other, sign = sides(rng)
        both = rng.random() < 0.3
        up = np.array([0.25, rng.uniform(1.9, 2.3), -0.2, 0.9])
        pace = rng.uniform(0.8, 1.1)
        rest = {f"{other}_arm": up} if both else {}
        s.move(
            pace,
            spine=(-0.05, -0.08 * sign, 0),
            head=(-0.1, 0, 0.2 * sign),
            **{f"{one}_arm": up, f"{one}_hand": (0, 0.4)},
            **rest,
        )
        beat = rng.uniform(0.3, 0.45)
        for k in range(rng.integers(3, 8)):
            to = up + np.array([0, 0.2, 0, -0.5]) * (1 if k % 2 else -1)
            s.move(
                beat,
                spine=(-0.05, -0.08 * sign + 0.04 * (-1) ** k, 0),
                **{f"{one}_arm": to},
                **({f"{other}_arm": to} if both else {}),
            )
        s.move(
            pace,
            left_arm=hanging(rng),
            right_arm=hanging(rng),
            spine=(0, 0, 0),
            head=(0, 0, 0),
            **{f"{one}_hand": (0, 0)},
        )
        s.hold(rng.uniform(0.0, 0.6))
    return s.channels(t)


def pick_up(t, rng):
    """Picking something up from the floor with both hands, lifting it overhead, putting it down."""
    s = Script(rng)
    apart = rng.uniform(0.08, 0.13)
    for foot, sign in (("left", 1.0), ("right", -1.0)):
        s.move(
            0.5,
            **{f"{foot}_foot": (sign * apart, 0, 0), f"{foot}_foot_turn": (0, 0.45, 0.2)},
            after=0.45,
        )
    upright = {
        "pelvis": (0, 0, -0.02),
        "turn": (0, 0, 0),
        "spine": (-0.02, 0, 0),
        "head": (0, 0, 0),
    }
    pole = (0.6, 0.3, -0.6)
    chest = {"left_arm": (0.75, 0.2, 0.25, 1.5), "right_arm": (0.75, 0.2, 0.25, 1.5)}
    # arms go ahead of the trunk, clear of the thighs
    before = {
        f"{side}_arm": figure.arm_to(side, (sign * 0.12, -0.42, 0.36), pole)
        for side, sign in (("left", 1.0), ("right", -1.0))
    }
    while s.clock < t[-1] + 1:
        deep, pace, aside = rng.uniform(0.3, 0.4), rng.uniform(1.0, 1.5), rng.uniform(-0.06, 0.06)
        pelvis, turn, spine = (0, 0.16, -deep), (0.8, 0, 0), (0.5, 0, 3 * aside)
        arms = {}
        for side, sign in (("left", 1.0), ("right", -1.0)):
            place = np.array([sign * 0.09 + aside, -0.33, -0.64])
            arms[f"{side}_arm"] = figure.arm_to(
                side, figure.in_chest(place, pelvis, turn, spine), pole
            )
        floor = {"pelvis": pelvis, "turn": turn, "spine": spine, "head": (-0.2, 0, 0), **arms}
        s.move(0.6 * pace, **before, after=0.3 * pace)
        s.move(pace, **floor)
        s.hold(rng.uniform(0.1, 0.3))
        s.move(0.8 * pace, **before, after=0.25 * pace)
        s.move(pace, **upright, after=0.6 * pace)
        s.move(0.8 * pace, **chest)
        if rng.random() < 0.6:
            s.move(
                0.9,
                left_arm=(2.7, 0.1, 0.0, 0.4),
                right_arm=(2.7, 0.1, 0.0, 0.4),
                spine=(-0.1, 0, 0),
                head=(-0.4, 0, 0),
            )
            s.hold(0.3)
            s.move(0.9, **chest, spine=(-0.02, 0, 0), head=(0, 0, 0))
        s.move(0.6 * pace, **before, after=0.3 * pace)
        s.move(pace, **floor)
        s.move(0.8 * pace, **before, after=0.25 * pace)
        s.move(pace, **upright, after=0.8 * pace)
        s.move(0.8 * pace, left_arm=hanging(rng), right_arm=hanging(rng))
        s.hold(rng.uniform(0.0, 0.5))
    return s.channels(t)


def dance(t, rng):
    """Step and touch from side to side on a beat, hips and shoulders swinging, arms in waves."""
    beat = rng.uniform(0.75, 1.0)
    phase = beat * t + rng.uniform(0, 1)
    c = figure.stand(len(t))
    zero = np.zeros(len(t))
    swing = np.sin(2 * np.pi * phase)
    c["pelvis"] = np.stack(
        [0.13 * swing, 0.02 * np.cos(2 * np.pi * phase), -0.06 + 0.025 * np.cos(4 * np.pi * phase)],
        -1,
    )
    c["turn"] = np.stack([0.05 + zero, -0.12 * swing, 0.25 * np.sin(2 * np.pi * phase + 0.8)], -1)
    c["spine"] = np.stack(
        [
            0.05 + 0.06 * np.cos(4 * np.pi * phase),
            0.25 * swing,
            -0.4 * np.sin(2 * np.pi * phase + 0.5),
        ],
        -1,
    )
    c["head"] = np.stack([0.06 * np.cos(4 * np.pi * phase), -0.1 * swing, 0.2 * swing], -1)
    slow = wander(t, rng, (1.0, 1.0), 7.0)
    for k, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        lift = 1.0 + 0.45 * np.tanh(slow[:, k]) + 0.35 * sign * np.sin(2 * np.pi * phase + 0.4)
        c[f"{side}_arm"] = np.stack(
            [
                0.5 + 0.3 * np.cos(2 * np.pi * phase + k),
                lift,
                0.2 + zero,
                1.1 + 0.4 * sign * np.cos(2 * np.pi * phase),
            ],
            -1,
        )
        p = (phase + (0.5 if side == "left" else 0.0)) % 1.0
        near = ease((p - 0.1) / 0.24) - ease(
            (p - 0.6) / 0.24
        )  # the foot that comes in touches, then steps out again
        c[f"{side}_foot"][:, 0] = sign * (0.16 - 0.17 * near)
        c[f"{side}_foot"][:, 2] = 0.05 * (bump((p - 0.06) / 0.32) + bump((p - 0.56) / 0.32))
        c[f"{side}_foot_turn"] = np.stack([0.45 * near, 0.15 + zero, zero], -1)
    return c


def sneak(t, rng):
    """Going slowly with bent knees, on tiptoe, arms held up in front."""
    speed = rng.uniform(0.35, 0.6)
    rate = rng.uniform(0.45, 0.6)
    c, phase = gait(
        t, rng, stride=speed / rate, rate=rate, stance=0.62, sway=0.05, bob=0.02, narrow=0.03,
        behind=0.02, curvature=rng.uniform(-0.3, 0.3),
        lift=[(0.0, 0.0), (0.6, 0.0), (0.78, 0.22), (0.9, 0.12)],
        heel=[(0.0, 0.45), (0.1, 0.2), (0.4, 0.1), (0.62, 0.8), (0.8, 0.5)],
    )  # fmt: skip
    wave = np.cos(2 * np.pi * phase)
    zero = np.zeros(len(t))
    c["pelvis"][:, 2] -= rng.uniform(0.08, 0.18)
    c["pelvis"][:, 1] += 0.08
    c["turn"] += np.stack([0.25 + zero, 0 * wave, -0.15 * wave], -1)
    c["spine"] = np.stack([rng.uniform(0.2, 0.45) + zero, 0.06 * wave, 0.2 * wave], -1)
    c["head"] = np.stack([-0.4 + zero, zero, 0.5 * np.sin(np.pi * phase)], -1)
    lift, bent = rng.uniform(0.6, 1.1), rng.uniform(1.2, 1.7)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        c[f"{side}_arm"] = np.stack(
            [lift + 0.25 * sign * wave, 0.35 + zero, 0.1 + zero, bent - 0.15 * sign * wave], -1
        )
        c[f"{side}_hand"] = np.stack([0.5 + zero, zero], -1)
    return c
