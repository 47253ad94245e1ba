"""Motions made from nothing: walking, squatting, reaching and so on, each sequence different by its
seed.

A kind is a function of times (T,) [s] and a random generator to the channels of
:mod:`onefit.motion.figures.figure`. Kinds in :data:`HELD_OUT` are for tests only: no network of
ours is trained on them, nor on seeds from :data:`HELD_OUT_SEEDS` up.
"""

import zlib

import numpy as np

from onefit.body import skeleton
from onefit.motion.figures import figure, footwork, gaits, heldout, postures
from onefit.motion.figures.script import wander
from polyfit.errors import InputError, as_number, number

HELD_OUT_SEEDS = 1_000_000  # seeds from here up are never trained on


def generate(name, seconds=10.0, seed=0, fps=30.0):
    """``(poses (T, 24, 3) [rad], translation (T, 3) [m])`` of the kind ``name``. The same seed
    gives the same motion, at any rate and for any length. :meth:`onefit.Motion.generate` makes a
    motion of them.

    Raises InputError for a kind that does not exist, a length that has no frame, or a negative
    seed.
    """
    if name not in KINDS:
        raise InputError(f"no kind of motion {name!r}; there are {', '.join(KINDS)}")
    length, rate = as_number(seconds), as_number(fps)
    if not (0 < rate < 10_000 and 1 <= length * rate <= 1e6):
        raise InputError(
            f"a motion of {seconds} s at {fps} frames a second; at least one frame, at most a"
            " million are needed"
        )
    seed = number("seed", seed, 0, whole=True)
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    flipped = rng.random() < 0.5
    t = np.arange(round(seconds * fps)) / fps
    channels = KINDS[name](t, rng)
    alive = np.random.default_rng([zlib.crc32(name.encode()), seed, 1])
    channels = _alive(channels, t, alive)
    poses, translation = figure.poses_of(channels, fps)
    return skeleton.mirrored(poses, translation) if flipped else (poses, translation)


def _alive(channels, t, rng):
    """Breath and sway, so that nothing ever stands quite still."""
    breath = np.sin(2 * np.pi * t / rng.uniform(3.0, 4.5) + rng.uniform(0, 6))
    c = dict(channels)
    c["spine"] = (
        c["spine"] + wander(t, rng, (0.012, 0.012, 0.02), 5.0) - 0.012 * breath[:, None] * [1, 0, 0]
    )
    c["head"] = c["head"] + wander(t, rng, (0.04, 0.03, 0.08), 4.0)
    for side in ("left", "right"):
        c[f"{side}_arm"] = (
            c[f"{side}_arm"]
            + wander(t, rng, (0.025, 0.015, 0.02, 0.03), 4.0)
            + 0.008 * breath[:, None] * [0, 1, 0, 0]
        )
    return c


_TRAINING = (
    postures.idle, gaits.walk, gaits.run, footwork.squat, postures.reach, postures.twist,
    postures.arms_up, postures.arms_crossed, footwork.kick, footwork.sit, footwork.turn,
    footwork.side_step, footwork.lunge, postures.bend, postures.stretch, footwork.jump,
    postures.improvise,
)  # fmt: skip
_HELD_OUT = (
    heldout.jumping_jack,
    heldout.box,
    heldout.sneak,
    heldout.wave,
    heldout.pick_up,
    heldout.dance,
)
TRAINING = tuple(kind.__name__ for kind in _TRAINING)
HELD_OUT = tuple(kind.__name__ for kind in _HELD_OUT)
KINDS = {kind.__name__: kind for kind in _TRAINING + _HELD_OUT}
