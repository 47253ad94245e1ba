"""What a surface costs. In: a problem, and the unknowns of frames. Out: the objective's terms, with
gradients by automatic differentiation (any renderer), or a quadratic model in closed form. Import
only after a Mitsuba variant is set.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "context": ["FrameContext", "FrameMemory", "Stage", "stages_of"],
        "objective": ["FrozenObjective", "Objective", "jet_unknowns"],
        "problem": ["Problem"],
        "quadratic": ["QuadraticModel"],
        "terms": ["TERMS"],
    },
)
