"""What the images say of a surface: frames and the template's texture in; how well a surface
explains a frame, to second order at its vertices, out. The solver asks one object,
:class:`polysft_mi.images.data_term.DataTerm`. Import only after a Mitsuba variant is set.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["differentiable"],
    submod_attrs={
        "chroma": ["colour_cast"],
        "data_term": ["Appearance", "DataTerm", "Evaluation"],
        "depth": ["DepthData", "DepthNoise"],
        "gather": ["Images"],
        "light": ["Light"],
        "pixels": ["packed"],
        "pyramid": ["Level", "POOL", "compared"],
    },
)
