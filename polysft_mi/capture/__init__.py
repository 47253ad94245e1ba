"""From a video and a photo of the sheet, or from a folder that is there, to a scene file.

In: what a person filmed, measured and photographed. Out: a folder with frames, masks, template,
texture, camera and ``scene.xml``, which ``polysft run`` takes. Where the sheet is,
:mod:`polysft_mi.poses` tells.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "evidence": ["GivenEvidence"],
        "known_folder": ["prepare_folder"],
        "layouts": ["FORMS", "Layout", "recognise"],
        "masks": ["iou"],
        "rig": ["GivenRig"],
        "scene_file": ["scene_xml"],
        "sheet": ["Sheet"],
        "video": ["prepare_video"],
    },
)
