"""The sheet's silhouette in every frame.

In: the frames, the photo, and the template's projection in the first frame. Out: masks (H, W)
uint8, 0 or 255. GrabCut finds the border by colour (:class:`Masks`); where the print has the colour
of the background, the photo tells where the sheet ends (:class:`Registration`).
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "grabcut": ["MaskSettings", "Masks", "beyond", "drawn_in", "iou", "silhouette"],
        "registration": ["Registration"],
    },
)
