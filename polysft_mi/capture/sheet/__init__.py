"""The sheet: its size, its template, and its pose in the first frame.

In: the lengths or the OBJ that a person gives, the photo, the first frame. Out: a :class:`Sheet`
and its :class:`Pose`.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "placing": ["Placed", "place"],
        "pose": ["Matches", "Pose", "from_corners", "from_matches", "match"],
        "size": ["parse_size"],
        "template": ["Sheet", "from_obj", "grid"],
    },
)
