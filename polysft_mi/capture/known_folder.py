"""A scene file for a sequence's folder that is there already, in one of the known forms."""

import contextlib
import os
from dataclasses import replace

from polyfit.files import aside
from polysft_mi.errors import InputError
from polysft_mi.scene import Sequence, checked_size, open_cameras
from polysft_mi.scene.kinect_paper import template as kinect_paper_template
from polysft_mi.surface import meshio

from .layouts import recognise
from .output import staged
from .rig import CAMERAS
from .scene_file import scene_xml


def prepare_folder(
    folder,
    out=None,
    resolution=33,
    overwrite=False,
    pose_fit="auto",
    warn=lambda line: None,
    rig=None,
    **evidence,
):
    """Write ``scene.xml`` for a sequence into ``out`` (default: the folder itself); for
    Kinect-Paper also ``template.obj``, of that ``resolution``, in its pose of
    :func:`polysft_mi.scene.kinect_paper.template`.

    ``evidence``: settings of tracks and depth, by their names, with paths as the caller has them;
    ``rig``: a :class:`polysft_mi.capture.rig.GivenRig`, whose cameras are written beside the scene
    (a folder of cameras of ours stays where it is).
    Everything that the scene names is read and checked first; ``warn`` is given a line about a
    template whose size is unlikely. Returns (path of the scene, what was
    found, in lines). Raises InputError; then nothing is written.
    """
    folder = os.path.normpath(folder)
    layout = recognise(folder)
    camera = layout.camera
    masks = os.path.join(folder, layout.masks) if layout.masks else ""
    known_to = evidence.pop("depth_known_to", "metric")
    sequence = Sequence.open(
        os.path.join(folder, layout.frames), masks, size=(camera.width, camera.height), **evidence
    )
    checked_size(os.path.join(folder, layout.texture))
    template, where, said = None, "template.obj", []
    if layout.obj is None:
        vertices, faces, uv = template = kinect_paper_template(
            folder, resolution, pose_fit, said.append
        )
    else:
        where = os.path.join(folder, layout.obj)
        vertices, faces, uv = meshio.read_textured_template(where)
    meshio.check_template(vertices, faces, uv, where)
    _check_view(vertices * ((-1, -1, 1) if layout.flip else 1), camera, where)

    here = out is None or os.path.realpath(out) == os.path.realpath(folder)
    target = folder if here else out
    for name in ["scene.xml"] + (["template.obj"] if template else []):
        if os.path.exists(os.path.join(target, name)) and not overwrite:
            raise InputError(
                f"{os.path.join(target, name)}: is there already; give --overwrite to replace it,"
                " or another folder by -o"
            )
    if rig and rig.ours:
        open_cameras(rig.path, len(sequence))
        evidence["cameras"] = rig.path
    elif rig:
        _check_cameras(os.path.join(target, CAMERAS), rig.path, overwrite)
    note = meshio.size_note(vertices, where)
    if note:
        warn(note)
    for name in ("tracks", "depth", "cameras"):
        if evidence.get(name):
            evidence[name] = _from_data(evidence[name], folder)
    if evidence.get("depth"):
        evidence["depth_known_to"] = known_to
    if rig and not rig.ours:
        evidence["cameras"] = CAMERAS
    layout = replace(layout, settings=layout.settings | evidence)
    text = scene_xml(
        layout, "." if here else os.path.abspath(folder), "template.obj" if template else None
    )
    cameras = None
    if rig and not rig.ours:
        cameras = lambda partial: said.extend(
            rig.write(partial, sequence.indices, camera, whole=True)
        )
    hint = "; give a folder that can be written by -o DIR" if here else ""
    _write(target, text, template, hint, cameras)
    recognised = (
        f"{folder}: a sequence in the form {layout.form}, {len(sequence)} frames of"
        f" {camera.width}x{camera.height}, {'with' if masks else 'without'} masks,"
        f"{' with tracks,' if sequence.tracks else ''}{' with depth,' if sequence.depth else ''}"
        f"{' with further cameras,' if rig else ''}"
        " template of"
        f" {len(vertices)} vertices ({layout.obj or f'subdivided to {resolution}x{resolution}'})"
    )
    return os.path.join(target, "scene.xml"), "\n".join([recognised, *said])


def _from_data(path, folder):
    """A path as a scene names it: from its data's folder where it lies there."""
    inside = os.path.relpath(os.path.realpath(path), os.path.realpath(folder))
    return os.path.abspath(path) if inside.startswith("..") else f"$data/{inside}"


def _check_cameras(folder, rig, overwrite):
    """Raise InputError where the cameras of ``rig`` may not be written to the folder."""
    if not os.path.isdir(folder):
        return
    a, b = (os.path.join(os.path.realpath(path), "") for path in (rig, folder))
    if a.startswith(b):
        raise InputError(
            f"{folder}: holds {rig}, which would be replaced; -o DIR is another folder"
        )
    ours = all(os.path.isfile(os.path.join(folder, n, "camera.json")) for n in os.listdir(folder))
    if not overwrite or not ours:
        hint = "give --overwrite to replace it, or" if ours else "not written by this command; give"
        raise InputError(f"{folder}: is there already; {hint} another folder by -o")


def _write(target, text, template, hint, cameras=None):
    """Write the scene, the template where there is one, and, by ``cameras(folder)``, further
    cameras into a folder: all or none.
    """
    made = not os.path.isdir(target)
    try:
        os.makedirs(target, exist_ok=True)
        with contextlib.ExitStack() as stack:
            if cameras:
                cameras(stack.enter_context(staged(os.path.join(target, CAMERAS))))
            if template:
                obj = stack.enter_context(aside(os.path.join(target, "template.obj")))
                meshio.write_obj(obj, *template)
            scene = stack.enter_context(aside(os.path.join(target, "scene.xml")))
            with open(scene, "w", encoding="utf-8") as file:
                file.write(text)
    except (OSError, InputError) as error:
        if made:
            with contextlib.suppress(OSError):
                os.rmdir(target)
        if isinstance(error, InputError):
            raise
        raise InputError(f"{target}: {error.strerror or error}{hint}") from None


def _check_view(vertices, camera, where):
    if vertices[:, 2].min() <= 0:
        raise InputError(
            f"{where}: the template lies behind the camera (z down to {vertices[:, 2].min():.3g}"
            " m); z must be positive in the camera frame"
        )
    x = camera.project(vertices)
    if not ((x > 0) & (x < (camera.width, camera.height))).all(axis=1).any():
        raise InputError(
            f"{where}: the template is out of view: no vertex lies in the"
            f" {camera.width}x{camera.height} image"
        )
