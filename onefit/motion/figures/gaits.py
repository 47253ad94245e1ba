"""Kinds of motion that go somewhere on their feet: walking, running, sneaking. See
:mod:`onefit.motion.generate`.
"""

import numpy as np

from . import figure
from .script import cycle, ease


def _along(path, side, curvature):
    """Places (T, 2) in the world and headings (T,), of lengths ``path`` and offsets to the left
    ``side`` along an arc that starts to -y.
    """
    k = curvature if abs(curvature) > 1e-6 else 1e-6
    yaw = k * path
    x, y = (1 - np.cos(yaw)) / k, -np.sin(yaw) / k
    return np.stack([x + side * np.cos(yaw), y + side * np.sin(yaw)], -1), yaw


def gait(t, rng, *, stride, rate, stance, lift, heel, sway, bob, narrow, behind, curvature):
    """(channels of pelvis and feet, phase (T,)) of a gait. A print stays where it is; at phase 0
    the left foot touches the ground.

    ``stride`` [m] from print to print of one foot, ``rate`` strides a second, ``stance`` the part
    of the time that a foot is on the ground; ``lift`` and ``heel`` courses of (phase, height of the
    ball [m]) and (phase, pitch of the foot [rad]); ``sway`` and ``bob`` of the pelvis [m];
    ``narrow``, how much closer to the middle than in standing the feet are put [m]; ``behind``, how
    far behind the hips a print is at mid-stance [m]; ``curvature`` of the way [1/m].
    """
    phase = rate * t + rng.uniform(0, 1)
    c = figure.stand(len(t))
    middle = np.cos(2 * np.pi * (phase - stance / 2))
    c["pelvis"][:, :2], yaw = _along(stride * (phase - phase[0]), sway * middle, curvature)
    c["pelvis"][:, 2] = bob * np.cos(4 * np.pi * (phase - stance / 2))
    c["turn"][:, 2] = yaw
    front = -figure.BALL[1]
    for name, offset, sign in (("left", 0.0, 1.0), ("right", 0.5, -1.0)):
        at = phase + offset
        n, p = np.floor(at), at - np.floor(at)
        path = (
            stride * (n + ease((p - stance) / (1 - stance)) + stance / 2 - offset - phase[0])
            - behind
        )
        place, yaw = _along(path, sign * (figure.BALL[0] - narrow), curvature)
        place += front * np.stack([np.sin(yaw), -np.cos(yaw)], -1)
        c[f"{name}_foot"][:, :2] = place - [sign * figure.BALL[0], -front]
        c[f"{name}_foot"][:, 2] = cycle(at, lift, 0.03)
        c[f"{name}_foot_turn"] = np.stack([cycle(at, heel, 0.03), 0.1 + sign * yaw, 0 * yaw], -1)
    return c, phase


def walk(t, rng):
    """Walking at 0.7 to 1.6 m/s, straight on or in a bend."""
    speed = rng.uniform(0.7, 1.6)
    stride = (0.25 + 0.85 * speed**0.5) * rng.uniform(0.95, 1.05)
    push = rng.uniform(0.85, 1.05) * min(1.0, 0.55 + 0.35 * speed)
    c, phase = gait(
        t, rng, stride=stride, rate=speed / stride, stance=0.62, sway=rng.uniform(0.015, 0.03),
        bob=0.008 + 0.005 * speed,
        lift=[(0.0, 0.0), (0.59, 0.0), (0.71, 0.06 + 0.04 * speed), (0.84, 0.035), (0.97, 0.005)],
        narrow=rng.uniform(0.02, 0.05), behind=0.05 + 0.02 * speed,
        heel=[
            (0.0, -0.25), (0.1, 0.0), (0.3, 0.0), (0.5, 0.45 * push), (0.62, push),
            (0.7, 0.8 * push), (0.86, -0.1), (0.96, -0.3)
        ], curvature=rng.uniform(-0.25, 0.25),
    )  # fmt: skip
    wave, beat = np.cos(2 * np.pi * phase), np.cos(2 * np.pi * (phase - 0.31))
    zero = np.zeros(len(t))
    swing = rng.uniform(0.2, 0.6) * (0.5 + 0.5 * speed)
    c["pelvis"][:, 2] -= 0.02
    c["turn"] += np.stack([0.02 + 0.03 * speed + zero, -0.05 * beat, -0.11 * speed * wave], -1)
    c["spine"] = np.stack([rng.uniform(0, 0.08) + zero, 0.05 * beat, 0.18 * speed * wave], -1)
    c["head"] = np.stack([zero, zero, -0.06 * speed * wave], -1)
    bent = rng.uniform(0.15, 0.6)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        forward = sign * np.cos(2 * np.pi * (phase - 0.03))
        c[f"{side}_arm"] = np.stack(
            [swing * forward, 0.23 + zero, 0.15 + zero, bent + 0.5 * swing * (1 + forward)], -1
        )
    return c


def run(t, rng):
    """Running at 2 to 3.6 m/s, straight on or in a wide bend."""
    speed = rng.uniform(2.0, 3.6)
    rate = rng.uniform(1.35, 1.5)
    c, phase = gait(
        t, rng, stride=speed / rate, rate=rate, stance=0.3, sway=0.01, bob=-0.03, narrow=0.06,
        behind=0.04 + 0.02 * speed,
        lift=[
            (0.0, 0.0), (0.3, 0.0), (0.42, 0.16), (0.55, 0.16 + 0.07 * speed), (0.7, 0.28),
            (0.9, 0.07)
        ],
        heel=[
            (0.0, -0.1), (0.06, 0.0), (0.14, 0.1), (0.32, 0.9), (0.52, 1.4), (0.7, 0.5), (0.9, -0.1)
        ], curvature=rng.uniform(-0.08, 0.08),
    )  # fmt: skip
    wave, beat = np.cos(2 * np.pi * phase), np.cos(2 * np.pi * (phase - 0.15))
    zero = np.zeros(len(t))
    c["pelvis"][:, 2] -= 0.06
    c["turn"] += np.stack([0.08 + 0.03 * speed + zero, -0.06 * beat, -0.2 * wave], -1)
    c["spine"] = np.stack([0.08 + 0.03 * np.cos(4 * np.pi * phase), 0.05 * beat, 0.4 * wave], -1)
    c["head"] = np.stack([-0.12 + zero, zero, -0.2 * wave], -1)
    swing, bent = rng.uniform(0.55, 0.8), rng.uniform(1.3, 1.7)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        forward = sign * np.cos(2 * np.pi * (phase - 0.02))
        c[f"{side}_arm"] = np.stack(
            [swing * forward - 0.1, 0.33 + zero, 0.25 + 0.2 * forward, bent + 0.25 * forward], -1
        )
    return c
