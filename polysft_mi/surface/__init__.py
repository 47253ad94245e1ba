"""The surface: a template held by one jet, or by several that are blended.

In: a mesh with texture coordinates, and the unknowns of a frame. Out: a :class:`Template`, and the
vertices [m, camera frame] of a :class:`JetAtlas`, differentiable by Dr.Jit. What takes Dr.Jit
needs a Mitsuba variant that is set.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["meshio"],
    submod_attrs={
        "atlas": ["Atlas", "State", "Surface"],
        "bending": ["hinges", "slides"],
        "patch": ["JetAtlas", "Unknowns"],
        "pattern": ["Pattern"],
        "template": ["Template"],
    },
)
