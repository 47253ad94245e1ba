"""Lengths as people write them: ``0.297 0.210``, ``297mm 210mm``, ``29.7cm``, ``11in``, ``A4``."""

import re

from polysft_mi.errors import InputError

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
SHEETS = {
    "A0": (1.189, 0.841),
    "A1": (0.841, 0.594),
    "A2": (0.594, 0.420),
    "A3": (0.420, 0.297),
    "A4": (0.297, 0.210),
    "A5": (0.210, 0.148),
    "A6": (0.148, 0.105),
    "LETTER": (0.2794, 0.2159),
    "LEGAL": (0.3556, 0.2159),
    "TABLOID": (0.4318, 0.2794),
}
SMALLEST, LARGEST = 0.005, 20.0  # m, a side of a sheet
_FORMS = "give --size WIDTH HEIGHT, as in 0.297 0.210 (metres), 297mm 210mm, or a name such as A4"


def parse_size(words, aspect=None):
    """(width, height) [m] of a sheet, from the words behind ``--size``.

    Two lengths, one (of a square), or the name of a sheet of paper, which lies as the photo does,
    whose width / height is ``aspect``. Raises InputError for what is none of these, and for sizes
    that no sheet has.
    """
    words = [
        part for word in words for part in re.split(r"[x×](?=\s*\d)|\s+", str(word).strip()) if part
    ]
    if len(words) == 1 and words[0].upper() in SHEETS:
        long, short = SHEETS[words[0].upper()]
        return (short, long) if aspect is not None and aspect < 1 else (long, short)
    if len(words) not in (1, 2):
        raise InputError(f"--size {' '.join(words)}: {len(words)} lengths; {_FORMS}")
    numbers, units = zip(*(_length(word) for word in words))
    unit = next((u for u in units if u), None)
    units = [u or unit for u in units]  # 297 210mm: the unit is that of both
    size = tuple(n * UNITS[u or "m"] for n, u in zip(numbers, units))
    if any(n <= 0 for n in size):
        raise InputError(f"--size {' '.join(words)}: a length must be positive")
    if unit is None and max(size) > 3:  # 8.5 11 is not metres
        raise InputError(
            f"--size {' '.join(words)}: numbers without a unit are metres, a sheet of"
            f" {_text(size)}; {_suggestion(numbers)}"
        )
    if not (min(size) >= SMALLEST and max(size) <= LARGEST):
        raise InputError(
            f"--size {' '.join(words)}: a sheet of {_text(size)}; {1e3 * SMALLEST:g} mm to"
            f" {LARGEST:g} m a side can be used"
        )
    return size if len(size) == 2 else size * 2


def _length(word):
    match = re.fullmatch(r"([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?|[0-9]+\.)\s*([a-zA-Z]*)", word)
    if not match or match[2].lower() not in (*UNITS, ""):
        raise InputError(f"--size: {word!r} is not a length in {', '.join(UNITS)}; {_FORMS}")
    return float(match[1]), match[2].lower()


def _suggestion(numbers):
    unit = "mm" if max(numbers) >= 60 else "cm" if max(numbers) >= 15 else "in"
    return f"say the unit, as in --size {' '.join(f'{n:g}{unit}' for n in numbers)}"


def _text(size):
    return " by ".join(f"{n:g} m" for n in size)
