"""The exceptions of the package, and how a command line ends on them. Those for a user's mistake
are :mod:`polyfit.errors`', by the same names.
"""

from polyfit.errors import InputError, cli

__all__ = ["BadFrame", "InputError", "cli"]


class BadFrame(FloatingPointError):
    """The objective of ``frame`` is not finite."""

    def __init__(self, frame: int, value: float) -> None:
        super().__init__(f"the loss is {value}")
        self.frame = frame
