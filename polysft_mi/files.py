"""Files that are either whole or not there: those of :mod:`polyfit.files`, by the same names."""

from polyfit.files import FULL, aside, folder_aside, naming

__all__ = ["FULL", "aside", "folder_aside", "naming"]
