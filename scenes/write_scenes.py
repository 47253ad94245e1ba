"""Write the scene files of this folder: ``python scenes/write_scenes.py``, by the writer of
``polysft_mi.capture``.

``SCENES`` holds what differs between them. The data of a scene that is no demo is given by ``-D
data=FOLDER``. ``demo.xml`` and ``demo/`` are links to the data of the package ``polysft_mi``.
"""

import argparse
import os
import re

from polysft_mi.camera import Intrinsics
from polysft_mi.capture import Layout, scene_xml
from polysft_mi.scene import PRESETS

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


def _lit(**settings):
    camera = Intrinsics(184, 184, 80, 60, 160, 120)
    return Layout(
        "cloth", camera, "frames", "masks", "texture.png", "template.obj", settings=settings
    )


def _dressed(**settings):
    camera = Intrinsics(600, 600, 180, 240, 360, 480)
    pose = (
        (1.0, 0.0, 0.0, -0.004818422719836235),
        (0.0, 0.0, -1.0, 0.4208582937717438),
        (0.0, 1.0, 0.0, 2.084437608718872),
        (0.0, 0.0, 0.0, 1.0),
    )
    named = "frames", "masks", "texture.jpg", "template.obj"
    return Layout("cloth", camera, *named, settings=settings, world_to_camera=pose)


# The paper's solver and what it couples, a frame at a time. Noise asks for squares, whose gradient
# has no bias, and plain paper for edges that hold.
LIT = dict(PRESETS["paper"], canonical_frame="pca", window=1, spp=4, period=150, order=6, k_mi=10.0)
LIT |= dict(k_silhouette=1.0, rgb_norm="l2", silhouette_norm="l2", mask_blur=0.0)

SCENES = {
    "demo": _demo(last=11),
    "demo_shirt": _demo(),
    "demo_lit": _lit(**LIT),
    "demo_dressed": _dressed(body="$data/body.npz", fps=15.0),
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
    "demo": "A poster that bends, frames 0 to 11 of 45 (-D last=-1: all): polysft demo -o OUT",
    "demo_shirt": "A T-shirt, whose texture has seams, 12 frames: polysft run"
    " scenes/demo_shirt.xml -o OUT",
    "demo_lit": "A sheet between a lamp and a bright floor, rendered with the light that falls on"
    " it, 6 frames: polysft run scenes/demo_lit.xml -o OUT",
    "demo_dressed": "A pullover on a body that lifts its arms, 12 frames: polysft run"
    " scenes/demo_dressed.xml -o OUT",
}

#: what stands in place of light from everywhere, and of the integrator, in the scenes named here
LIGHTS = {
    "demo_lit": """\
    <!-- A lamp above and a bright floor below, both beyond the picture -->
    <shape type="rectangle">
        <transform name="to_world">
            <scale x="0.3" y="0.25"/>
            <rotate x="1" angle="-65"/>
            <translate x="-0.35" y="-0.6" z="0.1"/>
        </transform>
        <emitter type="area"><rgb name="radiance" value="12.5, 12.0, 11.0"/></emitter>
    </shape>
    <shape type="rectangle">
        <transform name="to_world">
            <scale x="0.5" y="0.25"/>
            <rotate x="1" angle="90"/>
            <translate y="0.22" z="0.4"/>
        </transform>
        <bsdf type="twosided">
            <bsdf type="diffuse"><rgb name="reflectance" value="0.9, 0.75, 0.5"/></bsdf>
        </bsdf>
    </shape>
"""
}
REPLAY = """\
        <integrator type="prb_projective">
            <integer name="max_depth" value="3"/>
        </integrator>
"""


def _lighted(text, light):
    """The scene's text with path replay under a ``light`` instead of one from everywhere."""
    text, found = re.subn(r"    <!-- Radiance 1 .*\n    <emitter .*\n", light, text)
    usual = '        <integrator type="$integrator"/>\n'
    assert found == 1 and text.count(usual) == 1
    text = text.replace(usual, REPLAY)
    return re.sub(r"    <!-- What renders .*\n    <default name=\"integrator\".*\n\n", "", text)


def text(name):
    """The text of the scene file ``name``.xml."""
    if name in DEMOS:
        made = scene_xml(SCENES[name], name, comment=DEMOS[name])
        return _lighted(made, LIGHTS[name]) if name in LIGHTS else made
    comment = (
        f"The sequence {name}, in the form {SCENES[name].form}: python -m polysft_mi.run"
        f" scenes/{name}.xml -D data=FOLDER -o OUT"
    )
    return scene_xml(SCENES[name], f"../data/{name}", comment=comment)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    for name in SCENES:
        with open(os.path.join(HERE, f"{name}.xml"), "w", encoding="utf-8") as file:
            file.write(text(name))
        print(os.path.join(HERE, f"{name}.xml"))
