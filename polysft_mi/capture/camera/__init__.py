"""The camera that took a video.

In: a camera file, a field of view, a focal length on film, or views of a board. Out: a
:class:`Lens`, and frames freed from its distortion (:class:`Undistortion`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "calibration": ["calibrate"],
        "files": ["read_lens"],
        "lens": ["Lens", "Undistortion"],
    },
)
