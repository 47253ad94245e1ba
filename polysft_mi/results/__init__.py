"""What a run leaves, and what it is worth: a track in; files in the run's folder, figures and
exports out.

It needs no Mitsuba but to write a run's folder (:mod:`outputs`). :mod:`polysft_mi.pictures` draws.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "comparison": ["Comparison", "compare"],
        "evaluation": ["evaluate", "per_frame", "score"],
        "formats": ["FORMATS", "export"],
        "progress": ["Progress"],
        "run": ["Run"],
        "truth": ["Truth", "load_npz", "read_surface"],
    },
)
