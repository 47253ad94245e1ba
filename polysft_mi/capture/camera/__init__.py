"""The camera that took a video.

In: a camera file, a field of view, a focal length on film, or views of a board. Out: a
:class:`Lens`, and frames freed from its distortion (:class:`Undistortion`).
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "calibration": ["calibrate"],
        "files": ["read_lens"],
        "lens": ["Lens", "Undistortion"],
    },
)
