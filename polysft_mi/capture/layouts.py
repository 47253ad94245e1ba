"""Which form a sequence's folder has: recognised by the files in it.

Three forms are known (:data:`FORMS`). The names of OBJ files and images, their number and their
size are the folder's own.
"""

import os
from dataclasses import dataclass, field

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.scene import EXTENSIONS, kinect_paper

FORMS = (
    "cloth (camera.json, an OBJ file, a texture image, frames/, masks/ or none), "
    "phi-SfT (camera.json, an OBJ file, a texture image, rgbs/, masks/ or none), "
    "Kinect-Paper (cam.intr, cam.ext, mesh.pts, mesh.tri, frame_* images)"
)


@dataclass(frozen=True)
class Layout:
    """What a scene file needs to know of a folder. Paths are relative to the folder.

    ``form``: its name; ``camera``: the :class:`polysft_mi.camera.Intrinsics` of the frames;
    ``frames``, ``masks``: as :meth:`polysft_mi.scene.sequence.Sequence.open` takes them;
    ``texture``: an image; ``obj``: the template's file, None where the form has none; ``flip``:
    whether x and y of the template are negated to reach the camera frame; ``settings``: values of
    :class:`polysft_mi.scene.settings.Settings` that are not the defaults; ``world_to_camera``
    [m], four rows: where the camera stands, None at the world's origin.
    """

    form: str
    camera: Intrinsics
    frames: str
    masks: str
    texture: str
    obj: str | None = None
    flip: bool = False
    settings: dict = field(default_factory=dict)
    world_to_camera: tuple | None = None


def recognise(folder):
    """The :class:`Layout` of a folder. Raises InputError where the form is unknown, and where a
    file of a known form is missing.
    """
    if not os.path.isdir(folder):
        raise InputError(
            f"{folder}: no such file or folder; a video, or the folder of a sequence is needed"
        )
    has = lambda name: os.path.exists(os.path.join(folder, name))
    if any(map(has, kinect_paper.FILES)):
        return _kinect_paper(folder)
    if has("rgbs"):
        return _camera_and_obj(folder, "phi-SfT", "rgbs", flip=True)
    if has("frames"):
        return _camera_and_obj(folder, "cloth", "frames", flip=False)
    raise InputError(f"{folder}: not a sequence in a known form; the known forms are: {FORMS}")


def _camera_and_obj(folder, form, frames, flip):
    _require(folder, form, "camera.json")
    camera = Intrinsics.from_json(os.path.join(folder, "camera.json"))
    obj = _the_file(folder, form, "template", (".obj",), "an OBJ file with the template")
    texture = _the_file(folder, form, "texture", EXTENSIONS, "an image with the texture")
    masks = "masks" if os.path.isdir(os.path.join(folder, "masks")) else ""
    return Layout(form, camera, frames, masks, texture, obj, flip)


def _kinect_paper(folder):
    _require(folder, "Kinect-Paper", *kinect_paper.FILES)
    first = kinect_paper.images(folder)[0]
    frames = f"frame_*{os.path.splitext(first)[1]}"
    return Layout("Kinect-Paper", kinect_paper.camera(folder), frames, "", os.path.basename(first))


def _require(folder, form, *names):
    for name in names:
        path = os.path.join(folder, name)
        if not os.path.isfile(path):
            raise InputError(f"{path}: no such file; a sequence in the form {form} needs it")


def _the_file(folder, form, stem, extensions, what):
    """The one file of these types in the folder; of several, the one called ``stem``."""
    found = sorted(
        n for n in os.listdir(folder) if n.lower().endswith(extensions) and not n.startswith(".")
    )
    chosen = found
    if len(found) > 1:
        chosen = [n for n in found if os.path.splitext(n)[0].lower() == stem]
    if len(chosen) == 1:
        return chosen[0]
    there = f"it holds {', '.join(found)}; call one of them {stem}" if found else "there is none"
    raise InputError(f"{folder}: a sequence in the form {form} needs {what}; {there}")
