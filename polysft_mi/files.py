"""Files that are either whole or not there: those of :mod:`polyfit.files`, by the same names."""

from polyfit.files import FULL, aside, naming

__all__ = ["FULL", "aside", "naming"]
