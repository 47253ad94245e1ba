"""Files that are either whole or not there: those of :mod:`polyfit.files`, by the same names."""

from polyfit.files import DISK_FULL_ERRORS, aside, folder_aside, naming

__all__ = ["DISK_FULL_ERRORS", "aside", "folder_aside", "naming"]
