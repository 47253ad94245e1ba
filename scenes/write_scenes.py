"""Write the scene files of this folder: ``python scenes/write_scenes.py``, by the writer of
``polysft_mi.capture``.

``SCENES`` holds what differs between them. The data of a scene that is no demo is given by ``-D
data=FOLDER``.
"""

import os

from polysft_mi.camera import Intrinsics
from polysft_mi.capture import Layout, scene_xml

HERE = os.path.dirname(os.path.abspath(__file__))


def _cloth(**settings):
    camera = Intrinsics(552, 552, 240, 180, 480, 360)
    return Layout(
        "cloth", camera, "frames", "masks", "texture.png", "template.obj", settings=settings
    )


def _demo(**settings):
    camera = Intrinsics(368, 368, 160, 120, 320, 240)
    return Layout(
        "cloth", camera, "frames", "masks", "texture.jpg", "template.obj", settings=settings
    )


SCENES = {
    "demo": _demo(last=11),
    "demo_shirt": _demo(),
    "flag": _cloth(),
    "bend": _cloth(),
    "paper": _cloth(),
    "curtain": _cloth(),
    "corner": _cloth(),
    "hand": _cloth(),
    "poster": _cloth(),
    "tube": _cloth(),
    "shirt": _cloth(),
    "ball": _cloth(),
    "kinect_paper": Layout(
        "Kinect-Paper",
        Intrinsics(528.0144, 528.0144, 320, 240, 640, 480),
        "frame_*.png",
        "",
        "frame_001.png",
    ),
    "phi_sft_R1": Layout(
        "phi-SfT",
        Intrinsics(971.522, 944.575, 962.134, 554.778, 1920, 1080),
        "rgbs",
        "masks",
        "texture.png",
        "0_R1_quad.obj",
        flip=True,
    ),
}


DEMOS = {
    "demo": "A poster that bends, frames 0 to 11 of 45 (-D last=-1: all)",
    "demo_shirt": "A T-shirt, whose texture has seams, 12 frames",
}


def text(name):
    """The text of the scene file ``name``.xml."""
    if name in DEMOS:
        comment = f"{DEMOS[name]}: python -m polysft_mi.run scenes/{name}.xml -o OUT"
        return scene_xml(SCENES[name], name, comment=comment)
    comment = (
        f"The sequence {name}, in the form {SCENES[name].form}: python -m polysft_mi.run"
        f" scenes/{name}.xml -D data=FOLDER -o OUT"
    )
    return scene_xml(SCENES[name], f"../data/{name}", comment=comment)


if __name__ == "__main__":
    for name in SCENES:
        with open(os.path.join(HERE, f"{name}.xml"), "w", encoding="utf-8") as file:
            file.write(text(name))
        print(os.path.join(HERE, f"{name}.xml"))
