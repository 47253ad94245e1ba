"""PolySfT on Mitsuba 3: the surface of a textured template in every frame of a video, by
differentiable rendering.

A scene file goes in, the folder of a run comes out::

    import polysft_mi

    outcome = polysft_mi.reconstruct("scene.xml", "out")
    vertices = polysft_mi.Run.open("out").vertices  # (T, N, 3), metres

On the command line that is ``python -m polysft_mi.run scene.xml -o out``. Importing the package
imports neither Mitsuba nor Dr.Jit and sets no variant: :func:`set_variant` does both, once.
``docs/api.md`` lists the public names; other packages may change without notice.
"""

from . import lazy

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["bridge", "solvers"],
    submod_attrs={
        "camera": ["Intrinsics"],
        "errors": ["InputError"],
        "objective.problem": ["Problem"],
        "results.evaluation": ["score"],
        "results.run": ["Run"],
        "results.truth": ["Truth"],
        "run": ["Outcome", "reconstruct"],
        "scene.experiment": ["Experiment", "load"],
        "scene.plugins": ["register"],
        "scene.sequence": ["Sequence"],
        "scene.settings": ["Settings"],
        "tracker": ["FrameTracker", "Track", "track"],
    },
    with_variant=[
        *("Experiment", "FrameTracker", "Problem", "Track"),
        *("bridge", "load", "register", "solvers", "track"),
    ],
    handed_on={"polyfit.backend": ["set_variant"]},
)
