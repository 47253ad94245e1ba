"""Many runs, each in a process of its own: scenes, or garments and motions, go in; their folders
and one table come out.

:mod:`jobs` says what there is to do and what was done before, :mod:`schedule` does it, :mod:`table`
writes the result.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "jobs": ["Job", "drapes", "runs"],
        "schedule": ["work"],
        "table": ["Table"],
    },
)
