"""The exception for a user's mistake, and how a command line ends on it: those of
:mod:`polyfit.errors`, by the same names.
"""

from polyfit.errors import InputError, cli

__all__ = ["InputError", "cli"]
