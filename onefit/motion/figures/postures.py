"""Kinds of motion that go from posture to posture of trunk and arms: reaching, bending, folding the
arms and so on. See :mod:`onefit.motion.generate`.
"""

from . import figure
from .script import Script, hanging, sides, step


def idle(t, rng):
    """Standing, weight from one leg to the other, a look around, an arm that moves."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        one, other, _ = sides(rng)
        lean = rng.uniform(-0.055, 0.055)
        s.move(
            rng.uniform(1.2, 2.5), pelvis=(lean, rng.uniform(-0.02, 0.02), -0.2 * abs(lean)),
            turn=(0, -1.2 * lean, rng.uniform(-0.15, 0.15)),
            spine=(rng.uniform(-0.03, 0.1), 1.6 * lean, rng.uniform(-0.15, 0.15)),
            head=(rng.uniform(-0.2, 0.3), 0, rng.uniform(-0.8, 0.8)),
            **{
                f"{one}_arm": rng.uniform((-0.3, 0.2, 0, 0.1), (0.5, 0.5, 0.3, 1.2)),
                f"{other}_arm": hanging(rng)
            },
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 1.2))
    return s.channels(t)


def reach(t, rng):
    """Reaching up, to the front, to the side and across with one hand or both."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        one, other, sign = sides(rng)
        both = rng.random() < 0.35
        height = rng.uniform(0.9, 2.8)
        aside = rng.uniform(-0.35, 0.9) if height < 2.2 else rng.uniform(0.0, 0.4)
        arm = (
            height,
            max(aside, 0.0) if both else aside,
            rng.uniform(-0.2, 0.2),
            rng.uniform(0.05, 0.4),
        )
        high = max(0.0, height - 2.0)
        turned = (not both) * (0.35 - 0.5 * aside)
        s.move(
            rng.uniform(0.8, 1.4),
            spine=(0.12 * (1.6 - height), -0.2 * sign * (not both) * high, -sign * turned),
            pelvis=(0.0, -0.03, 0.0), turn=(0.1 * (height < 1.6), 0, -0.4 * sign * turned),
            head=(-0.35 * high, 0, sign * 0.3 * aside),
            **{
                f"{one}_arm": arm,
                f"{other}_arm": arm if both else rng.uniform(
                    (-0.4, 0.25, 0, 0.2), (0.1, 0.45, 0.2, 0.6)
                ), f"{one}_foot_turn": (0.5 * high, 0.1, 0),
                f"{other}_foot_turn": (0.5 * high * both, 0.1, 0), f"{one}_hand": (-0.3 * high, 0),
            },
        )  # fmt: skip
        s.hold(rng.uniform(0.1, 0.6))
        if rng.random() < 0.6:
            s.move(
                rng.uniform(0.8, 1.3), left_arm=hanging(rng), right_arm=hanging(rng),
                spine=(0, 0, 0), pelvis=(0, 0, -0.01), turn=(0, 0, 0), head=(0, 0, 0),
                left_foot_turn=(0, 0.1, 0), right_foot_turn=(0, 0.1, 0), left_hand=(0, 0),
                right_hand=(0, 0),
            )  # fmt: skip
            s.hold(rng.uniform(0.0, 0.4))
    return s.channels(t)


def twist(t, rng):
    """The trunk turned from side to side, arms swinging out, raised or on their way."""
    s = Script(rng)
    wide = rng.uniform(0.0, 0.1)
    one, other, sign = sides(rng)
    s.move(
        0.6,
        left_foot=(wide, 0, 0),
        pelvis=(-0.03, 0, -0.02),
        left_arm=(0.1, 0.6, 0.1, 0.6),
        right_arm=(0.1, 0.6, 0.1, 0.6),
        after=0.5,
    )
    s.move(0.6, right_foot=(-wide, 0, 0), pelvis=(0, 0, -0.03))
    while s.clock < t[-1] + 1:
        far, lift, bent = rng.uniform(0.4, 0.9), rng.uniform(0.7, 1.5), rng.uniform(0.3, 1.2)
        s.move(
            rng.uniform(0.6, 1.3), turn=(0, 0, 0.45 * sign * far),
            spine=(rng.uniform(0, 0.15), 0, 0.75 * sign * far), head=(0, 0, 0.5 * sign * far),
            **{f"{one}_arm": (0.0, lift, 0.1, bent), f"{other}_arm": (0.9, 0.6 * lift, 0.1, bent)},
        )  # fmt: skip
        s.hold(rng.uniform(0.0, 0.3))
        one, other, sign = other, one, -sign
    return s.channels(t)


def arms_up(t, rng):
    """Both arms lifted overhead by the front or by the sides, and let down again."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        high, pace, bent = rng.uniform(2.2, 2.95), rng.uniform(0.9, 1.6), rng.uniform(0.05, 0.5)
        up = (high, 0.2, 0.0, bent) if rng.random() < 0.5 else (0.15, high, 0.0, bent)
        s.move(
            pace,
            left_arm=up,
            right_arm=up,
            spine=(-0.15, rng.uniform(-0.2, 0.2), 0),
            head=(-0.3, 0, 0),
            pelvis=(0, -0.02, 0),
        )
        s.hold(rng.uniform(0.1, 0.8))
        s.move(
            pace,
            left_arm=hanging(rng),
            right_arm=hanging(rng),
            spine=(0.05, 0, 0),
            head=(0, 0, 0),
            pelvis=(0, 0, -0.01),
        )
        s.hold(rng.uniform(0.0, 0.5))
    return s.channels(t)


def arms_crossed(t, rng):
    """Arms folded in front of the chest, one over the other, and opened again."""
    s = Script(rng)
    while s.clock < t[-1] + 1:
        one, other, sign = sides(rng)
        low, pace = rng.uniform(-0.02, 0.04), rng.uniform(0.9, 1.5)
        inner = figure.arm_to(one, (0.03 * sign, -0.222, 0.2 + low), pole=(0.7, 0.2, -1.0))
        outer = figure.arm_to(other, (-0.03 * sign, -0.272, 0.33 + low), pole=(1.2, 0.0, -0.6))
        before = (0.75, 0.25, 0.3, 1.3)
        s.move(
            0.7 * pace,
            **{f"{one}_arm": (0.6, 0.2, 0.4, 1.5), f"{other}_arm": before},
            spine=(0.03, 0, 0),
        )
        s.move(
            0.6 * pace,
            **{f"{one}_arm": inner, f"{other}_arm": (0.95, 0.15, 0.5, 1.4)},
            after=0.45 * pace,
        )
        s.move(
            0.6 * pace,
            **{f"{other}_arm": outer, f"{one}_hand": (0.1, 0), f"{other}_hand": (0.35, 0)},
        )
        for _ in range(rng.integers(1, 4)):
            s.move(
                rng.uniform(0.7, 1.4), turn=(0, 0, rng.uniform(-0.2, 0.2)),
                spine=(rng.uniform(-0.1, 0.15), rng.uniform(-0.1, 0.1), rng.uniform(-0.3, 0.3)),
                head=(rng.uniform(-0.2, 0.2), 0, rng.uniform(-0.5, 0.5)),
                pelvis=(rng.uniform(-0.04, 0.04), 0, -0.01),
            )  # fmt: skip
        s.move(0.6 * pace, **{f"{other}_arm": before, f"{other}_hand": (0, 0)}, after=0.3 * pace)
        s.move(
            0.8 * pace,
            **{f"{one}_arm": (0.6, 0.3, 0.2, 1.2), f"{one}_hand": (0, 0)},
            after=0.6 * pace,
        )
        s.move(
            pace,
            left_arm=hanging(rng),
            right_arm=hanging(rng),
            turn=(0, 0, 0),
            spine=(0, 0, 0),
            head=(0, 0, 0),
        )
        s.hold(rng.uniform(0.0, 0.5))
    return s.channels(t)


def bend(t, rng):
    """Bending down to the front until the hands reach for the toes, and to the sides with an arm
    overhead.
    """
    s = Script(rng)
    while s.clock < t[-1] + 1:
        pace = rng.uniform(1.0, 1.6)
        if rng.random() < 0.55:
            lean, curl = rng.uniform(0.5, 1.1), rng.uniform(0.4, 0.9)
            arm = (lean + curl + rng.uniform(-0.1, 0.3), 0.15, 0.1, 0.15)
            s.move(
                0.8 * pace, left_arm=arm, right_arm=arm, after=0.05
            )  # arms first, clear of the thighs
            s.move(
                pace, pelvis=(0, 0.11 * lean, -0.03 - 0.05 * rng.random()), turn=(lean, 0, 0),
                spine=(curl, 0, rng.uniform(-0.2, 0.2)), head=(rng.uniform(-0.2, 0.4), 0, 0),
            )  # fmt: skip
        else:
            one, other, sign = sides(rng)
            far = rng.uniform(0.3, 0.6)
            s.move(
                pace, pelvis=(0.05 * sign, 0, -0.01), turn=(0, -0.25 * sign * far, 0),
                spine=(0, -sign * far, 0), head=(0, -0.4 * sign * far, 0),
                **{
                    f"{one}_arm": (0.1, rng.uniform(2.4, 2.8), 0.0, 0.5),
                    f"{other}_arm": (0.15, 0.3 + 1.2 * far, 0.1, 0.2)
                },
            )  # fmt: skip
        s.hold(rng.uniform(0.1, 0.6))
        s.move(
            pace,
            pelvis=(0, 0, -0.01),
            turn=(0, 0, 0),
            spine=(0, 0, 0),
            head=(0, 0, 0),
            after=0.55 * pace,
        )
        s.move(0.8 * pace, left_arm=hanging(rng), right_arm=hanging(rng))
        s.hold(rng.uniform(0.0, 0.4))
    return s.channels(t)


def stretch(t, rng):
    """Arms swung out, drawn across the chest one at a time, and lifted to the sides; shoulders and
    trunk follow.
    """
    s = Script(rng)
    while s.clock < t[-1] + 1:
        pace = rng.uniform(0.8, 1.5)
        one, other, sign = sides(rng)
        style = rng.choice(3)
        if style == 0:  # open wide, then close in front
            for _ in range(rng.integers(1, 4)):
                s.move(
                    0.7 * pace,
                    left_arm=(1.45, 1.35, 0, 0.25),
                    right_arm=(1.45, 1.35, 0, 0.25),
                    spine=(-0.12, 0, 0),
                    head=(-0.1, 0, 0),
                )
                s.move(
                    0.7 * pace,
                    left_arm=(1.4, 0.05, 0.1, 0.3),
                    right_arm=(1.4, 0.05, 0.1, 0.3),
                    spine=(0.15, 0, 0),
                    head=(0.1, 0, 0),
                )
        elif style == 1:  # one arm across
            s.move(
                pace, spine=(0.03, 0, -0.3 * sign), head=(0, 0, 0.2 * sign),
                **{f"{one}_arm": (1.4, -0.45, 0.1, 0.35), f"{other}_arm": (0.2, 0.35, 0.2, 0.5)},
            )  # fmt: skip
            s.hold(rng.uniform(0.2, 0.7))
        else:  # elbows out, hands at the chest
            arm = (0.5, 1.15, 0.9, 1.9)
            s.move(pace, left_arm=arm, right_arm=arm, spine=(0.05, 0, 0))
            for _ in range(rng.integers(1, 4)):
                s.move(
                    0.6 * pace, spine=(0.05, 0, rng.uniform(-0.5, 0.5)), left_arm=arm, right_arm=arm
                )
        s.move(pace, left_arm=hanging(rng), right_arm=hanging(rng), spine=(0, 0, 0), head=(0, 0, 0))
        s.hold(rng.uniform(0.0, 0.4))
    return s.channels(t)


def improvise(t, rng):
    """One posture after another at random: hands anywhere before and beside the body, trunk and
    hips moving, small steps.
    """
    s = Script(rng)
    s.move(0.5, left_arm=(0.1, 0.6, 0.1, 0.4), right_arm=(0.1, 0.6, 0.1, 0.4), after=0.2)
    while s.clock < t[-1] + 1:
        changes = {}
        for side, sign in (("left", 1.0), ("right", -1.0)):
            if rng.random() < 0.75:
                place = rng.uniform((0.12, -0.6, 0.22), (0.6, -0.28, 0.95))
                if rng.random() < 0.35:
                    place = rng.uniform((0.42, -0.4, 0.05), (0.65, 0.05, 0.9))
                changes[f"{side}_arm"] = figure.arm_to(
                    side, place * [sign, 1, 1], pole=(rng.uniform(0.4, 1.2), 0.4, -1.0)
                )
                changes[f"{side}_hand"] = rng.uniform((-0.4, -0.3), (0.4, 0.8))
        low = rng.uniform(0.0, 0.14)
        s.move(
            rng.uniform(0.6, 1.3), after=rng.uniform(0.5, 1.1),
            pelvis=(rng.uniform(-0.08, 0.08), rng.uniform(-0.04, 0.06), -low),
            turn=(rng.uniform(-0.05, 0.25), rng.uniform(-0.12, 0.12), rng.uniform(-0.3, 0.3)),
            head=rng.uniform((-0.3, -0.2, -0.6), (0.3, 0.2, 0.6)),
            spine=rng.uniform((-0.15, -0.25, -0.4), (0.4, 0.25, 0.4)), **changes,
        )  # fmt: skip
        if rng.random() < 0.5:
            foot = rng.choice(["left", "right"])
            s.move(
                0.5,
                **step(
                    foot,
                    rng.uniform(-0.25, 0.25),
                    rng.uniform((-0.05, -0.15), (0.05, 0.1)),
                    apart=rng.uniform(0, 0.15),
                ),
                after=0.3,
            )
    return s.channels(t)
