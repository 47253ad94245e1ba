"""Timing of generated motions: everything that moves here has a continuous acceleration."""

import numpy as np

from .figure import BALL, stand


def ease(x):
    """From 0 at x <= 0 to 1 at x >= 1 with the least jerk: 10 x³ - 15 x⁴ + 6 x⁵, velocity and
    acceleration zero at both ends.
    """
    x = np.clip(x, 0.0, 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))


def bump(x):
    """0 outside of 0 < x < 1, 1 at 1/2, velocity and acceleration zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return 64.0 * (x * (1.0 - x)) ** 3


def wander(t, rng, size, period):
    """Slow, aimless movement (T, len(size)) of about ``size``: three sines each, of about
    ``period`` seconds.
    """
    total = np.zeros((len(t), len(size)))
    for part in (1.0, 0.6, 0.35):
        turn = 2 * np.pi * t[:, None] / (period * part * rng.uniform(0.8, 1.25, len(size)))
        total += part * np.sin(turn + rng.uniform(0, 2 * np.pi, len(size)))
    return total * np.asarray(size) / 1.95


def cycle(phase, keys, width=0.04):
    """A periodic course through ``keys``, pairs (phase from 0 to 1, value): straight between them,
    then smoothed by a Gaussian of ``width``."""
    at, values = zip(*keys, strict=True)
    count = 512
    samples = np.interp(np.arange(count) / count, at, values, period=1.0)
    spectrum = np.fft.rfft(samples) * np.exp(-2 * (np.pi * width * np.arange(count // 2 + 1)) ** 2)
    order = np.arange(33)  # a width of 0.02 leaves less than 1e-3 of what is beyond
    waves = (
        np.exp(2j * np.pi * np.asarray(phase)[:, None] * order)
        * spectrum[:33]
        * np.where(order == 0, 1.0, 2.0)
        / count
    )
    return waves.real.sum(1)


class Script:
    """A course of movements from posture to posture, each eased in and out; movements may overlap,
    because they add up.

    ``move(0.8, spine=(0.3, 0, 0), pelvis=...)`` takes 0.8 s to bring channels of
    :mod:`onefit.motion.figures.figure` to new values, the others stay. A foot that goes elsewhere
    is lifted on its way. ``channels(t)`` gives the figure's channels at times t, and those of
    ``others`` (sizes by names), which start at zero.
    """

    def __init__(self, rng, **others):
        self.rng = rng
        self.clock = 0.0
        self.now = {name: values[0] for name, values in stand(1).items()} | {
            name: np.zeros(size) for name, size in others.items()
        }
        self._start = dict(self.now)
        self._moves = []

    def hold(self, seconds):
        self.clock += seconds

    def move(self, seconds, after=None, **changes):
        """Reach ``changes`` in ``seconds``; the next movement starts then, or ``after`` seconds
        from this one's start where that is given."""
        for name, value in changes.items():
            value = np.asarray(value, dtype=np.float64)
            # limbs do not start all at once: the trunk leads, arms and head follow
            lag = (
                0.0
                if name.endswith(("foot", "turn", "swing")) or name == "pelvis"
                else self.rng.uniform(0.0, 0.12) * seconds
            )
            self._moves.append((name, self.clock + lag, seconds, value - self.now[name]))
            self.now[name] = value
        self.clock += seconds if after is None else after

    def channels(self, t):
        total = {name: np.tile(self._start[name], (len(t), 1)) for name in self._start}
        for name, start, seconds, change in self._moves:
            x = (t - start) / seconds
            if not name.endswith("foot"):
                total[name] += ease(x)[:, None] * change
                continue
            total[name] += ease((x - 0.1) / 0.8)[:, None] * change  # up first, then along
            far = np.linalg.norm(change[:2])
            if far > 0.01 and abs(change[2]) < 0.05:
                total[name][:, 2] += bump(x) * (0.04 + 0.12 * far)
        return total


def sides(rng):
    """The sides in a random order, with the first one's sign (left is 1)."""
    return ("left", "right", 1.0) if rng.random() < 0.5 else ("right", "left", -1.0)


def hanging(rng):
    """An arm hanging, (4,), a bit different every time."""
    return rng.uniform((-0.1, 0.18, 0.0, 0.15), (0.2, 0.3, 0.2, 0.5))


def step(foot, yaw, place=(0.0, 0.0), apart=0.0):
    """Changes that put a foot where it belongs for a body at ``place`` (2,) [m] that faces ``yaw``,
    its feet ``apart`` [m] farther out.
    """
    sign = 1.0 if foot == "left" else -1.0
    x, y = sign * (BALL[0] + apart), BALL[1]
    c, w = np.cos(yaw), np.sin(yaw)
    to = (c * x - w * y + place[0] - sign * BALL[0], w * x + c * y + place[1] - BALL[1], 0.0)
    return {f"{foot}_foot": to, f"{foot}_foot_turn": (0, 0.1 + sign * yaw, 0)}
