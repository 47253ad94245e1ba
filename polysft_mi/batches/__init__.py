"""Many runs, each in a process of its own: scenes, or garments and motions, go in; their folders
and one table come out.

:mod:`jobs` says what there is to do and what was done before, :mod:`schedule` does it, :mod:`table`
writes the result.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "jobs": ["Job", "drapes", "runs"],
        "schedule": ["work"],
        "table": ["Table"],
    },
)
