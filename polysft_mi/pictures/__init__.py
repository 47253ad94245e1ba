"""Pictures of a run: surfaces, images and figures in; PNG, EXR, video and one HTML page out.

The album of a run is drawn while it tracks (:class:`Drawing`); its report and comparisons read a
finished run, the viewer also one at work, or a drape. Meshes are drawn by
:mod:`polyfit.pictures.stage`. matplotlib, plotly, viser and Mitsuba are loaded on use.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "comparison": ["write_comparison"],
        "drawing": ["Drawing"],
        "exr": ["read_exr", "write_exr"],
        "moving": ["Source"],
        "report.page": ["write_report"],
        "viewer": ["Viewer"],
    },
)
