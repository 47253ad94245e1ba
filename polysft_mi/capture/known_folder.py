"""A scene file for a sequence's folder that is there already, in one of the known forms."""

import contextlib
import os
from dataclasses import replace

import numpy as np

from polyfit.backend import set_variant
from polyfit.colours import srgb
from polyfit.files import aside
from polyfit.mesh import TexCoords, read_textured, size_note
from polysft_mi.body import check_model, read_motion
from polysft_mi.errors import InputError
from polysft_mi.scene import (
    Sequence,
    check_depth,
    check_seen,
    check_tracks,
    checked_size,
    open_cameras,
    read_camera,
    read_rgb,
)
from polysft_mi.scene.kinect_paper import RESOLUTION
from polysft_mi.scene.kinect_paper import template as kinect_paper_template
from polysft_mi.surface import meshio

from . import pictures
from .depth import DEPTH, check_range, recognise_depth, write_depth
from .layouts import recognise
from .output import REPORT, staged, write_png
from .rig import CAMERAS
from .scene_file import scene_xml
from .sheet import Sheet

_OF_BODY = "body", "body_model", "body_up"
_POSE = f"{REPORT}/pose.png"
_BODY, _FARTHEST = 1.2, 30.0  # [m] that a body reaches from its middle; that it may be away


def prepare_folder(
    folder,
    out=None,
    resolution=None,
    overwrite=False,
    pose_fit="auto",
    warn=lambda line: None,
    rig=None,
    **evidence,
):
    """Write ``scene.xml`` for a sequence into ``out`` (default: the folder itself); for
    Kinect-Paper also ``template.obj``, of that ``resolution`` (33), in its pose of
    :func:`polysft_mi.scene.kinect_paper.template`. ``prepare/pose.png`` shows how all of it lies in
    the first frame; not of a garment on a body, which is draped first.

    ``evidence``: settings of tracks, depth and the body, by their names, with paths as the caller
    has them; with a body, the template and the camera (``world_to_camera`` in its file) are in the
    body's world;
    ``rig``: a :class:`polysft_mi.capture.rig.GivenRig`, whose cameras are written beside the scene
    (a folder of cameras of ours stays where it is).
    Everything that the scene names is read and checked first; ``warn`` is given a line about a
    template whose size is unlikely. Returns (path of the scene, what was
    found, in lines). Raises InputError; then nothing is written.
    """
    folder = os.path.normpath(folder)
    layout = recognise(folder)
    if layout.obj is not None and resolution is not None:
        raise InputError(
            f"--resolution {resolution}: is for Kinect-Paper; {os.path.join(folder, layout.obj)}"
            " has its own vertices"
        )
    resolution = RESOLUTION if resolution is None else resolution
    camera = layout.camera
    masks = os.path.join(folder, layout.masks) if layout.masks else ""
    said = []
    known_to = evidence.get("depth_known_to", "metric")
    of_body = {name: evidence.pop(name) for name in _OF_BODY if name in evidence}
    body, model = (of_body.get(name, "") for name in ("body", "body_model"))
    if body:
        _, pose = read_camera(os.path.join(folder, "camera.json"))
        layout = replace(layout, world_to_camera=tuple(map(tuple, pose.tolist())))
    depth = recognise_depth(evidence["depth"]) if evidence.get("depth") else None
    if depth:
        evidence["depth"] = depth.images
        said += [depth.note] if depth.note else []
    sequence = Sequence.open(
        os.path.join(folder, layout.frames), masks, size=(camera.width, camera.height), **evidence
    )
    if depth and depth.is_seen_by(camera):
        sequence.depth.like_frames(0, sequence.size)
    if body:
        up = of_body.get("body_up", "z")
        motion = read_motion(body, len(sequence), sequence.indices, model, up)
        _check_body(motion, pose, camera)
        if model:
            check_model(model)
        said += [motion.note] if motion.note else []
        evidence |= of_body
    texture = os.path.join(folder, layout.texture)
    checked_size(texture)
    template, where = None, "template.obj"
    if layout.obj is None:
        vertices, faces, uv = template = kinect_paper_template(
            folder, resolution, pose_fit, said.append
        )
    else:
        where = os.path.join(folder, layout.obj)
        read = read_textured(where, what="template")
        vertices, faces, uv, _, left_out = meshio.cleaned(*read)
        if left_out:
            warn(f"note: {where}: {left_out}")
    meshio.check_template(vertices, faces, uv, where)
    placed = vertices * ((-1, -1, 1) if layout.flip else 1)
    if not body:
        tracks = f"{folder}: tracks = {evidence.get('tracks')}"
        _check_start(placed, faces, camera, sequence, f"{where or folder}: ", tracks, depth)

    here = out is None or os.path.realpath(out) == os.path.realpath(folder)
    target = folder if here else out
    names = ["scene.xml"] + (["template.obj"] if template else []) + ([] if body else [_POSE])
    for name in names:
        if os.path.exists(os.path.join(target, name)) and not overwrite:
            raise InputError(
                f"{os.path.join(target, name)}: is there already; give --overwrite to replace it,"
                " or another folder by -o"
            )
    folders = {}
    if rig and rig.ours:
        open_cameras(rig.path, sequence.count)
        evidence["cameras"] = rig.path
    elif rig:
        known = lambda path: os.path.isfile(os.path.join(path, "camera.json"))
        _check_folder(os.path.join(target, CAMERAS), rig.path, overwrite, known)
        folders[CAMERAS] = lambda to: said.extend(
            rig.write(to, sequence.indices, camera, whole=True)
        )
    if depth and not depth.is_seen_by(camera):
        check_range(sequence.depth)
        known = lambda path: path.endswith(".png")
        _check_folder(os.path.join(target, DEPTH), depth.images, overwrite, known)
        seen = lambda k: depth.seen_by(sequence.depth.read(k), camera)
        folders[DEPTH] = lambda to: evidence.update(write_depth(to, sequence.depth, seen))
    note = size_note(vertices, where, "template")
    if note:
        warn(note)
    for name in ("tracks", "depth", "cameras", "body", "body_model"):
        if evidence.get(name):
            evidence[name] = _from_data(evidence[name], folder)
    evidence |= {name: name for name in folders}
    text = lambda: scene_xml(
        replace(layout, settings=layout.settings | evidence),
        "." if here else os.path.abspath(folder),
        "template.obj" if template else None,
    )
    hint = "; give a folder that can be written by -o DIR" if here else ""
    picture = None
    if not body:
        told = depth if known_to == "metric" else None
        picture = _pose(sequence, texture, (placed, faces, uv), camera, told)
    _write(target, text, template, picture, hint, folders)
    recognised = (
        f"{folder}: a sequence in the form {layout.form}, {len(sequence)} frames of"
        f" {camera.width}x{camera.height}, {'with' if masks else 'without'} masks,"
        f"{' with tracks,' if sequence.tracks else ''}{' with depth,' if sequence.depth else ''}"
        f"{' with further cameras,' if rig else ''}{' on a body,' if body else ''}"
        " template of"
        f" {len(vertices)} vertices ({layout.obj or f'subdivided to {resolution}x{resolution}'})"
    )
    if not body:
        said.append(f"{os.path.join(target, _POSE)} shows the template in the first frame")
    return os.path.join(target, "scene.xml"), "\n".join([recognised, *said])


def _pose(sequence, texture, template, camera, depth):
    """The picture of how the template, its vertices in the camera frame, the mask, the tracks and
    ``depth``, a :class:`DepthFolder` in metres or None, lie in the first frame.
    """
    set_variant()  # the picture needs rays
    vertices, faces, texcoords = template
    if isinstance(texcoords, np.ndarray):  # of each vertex
        texcoords = TexCoords(texcoords, faces)
    source, uv, split = texcoords.split(faces)
    sheet = Sheet(vertices[source], split, uv, "template", source)
    frame = np.round(255 * srgb(sequence.frame(0))).astype(np.uint8)
    tracks = sequence.tracks and sequence.tracks.positions[0, sequence.tracks.visible[0]]
    metres = None
    if depth and depth.is_seen_by(camera):
        metres = sequence.depth.like_frames(0, sequence.size)
    elif depth:
        metres = depth.seen_by(sequence.depth.read(0), camera)
    known = pictures.Known(sequence.mask(0), tracks, metres)
    return pictures.pose(frame, read_rgb(texture), sheet, sheet.vertices, camera, known)


def _from_data(path, folder):
    """A path as a scene names it: from its data's folder where it lies there."""
    inside = os.path.relpath(os.path.realpath(path), os.path.realpath(folder))
    return os.path.abspath(path) if inside.startswith("..") else f"$data/{inside}"


def _check_folder(folder, source, overwrite, known):
    """Raise InputError where what is made of ``source`` may not be written to the folder, for it
    holds that, or what is not ``known(path)``.
    """
    if not os.path.isdir(folder):
        return
    a, b = (os.path.join(os.path.realpath(path), "") for path in (source, folder))
    if a.startswith(b):
        raise InputError(
            f"{folder}: holds {source}, which would be replaced; -o DIR is another folder"
        )
    ours = all(known(os.path.join(folder, name)) for name in os.listdir(folder))
    if not overwrite or not ours:
        hint = "give --overwrite to replace it, or" if ours else "not written by this command; give"
        raise InputError(f"{folder}: is there already; {hint} another folder by -o")


def _write(target, text, template, picture, hint, folders):
    """Write what ``folders`` maps names of folders to (functions of a path), the template and the
    picture of its pose where there is one, and the scene, ``text()``, into a folder: all or none.
    """
    made = not os.path.isdir(target)
    try:
        os.makedirs(target, exist_ok=True)
        with contextlib.ExitStack() as stack:
            for name, write in folders.items():
                write(stack.enter_context(staged(os.path.join(target, name))))
            if template:
                obj = stack.enter_context(aside(os.path.join(target, "template.obj")))
                meshio.write_obj(obj, *template)
            if picture is not None:
                os.makedirs(os.path.join(target, REPORT), exist_ok=True)
                write_png(stack.enter_context(aside(os.path.join(target, _POSE))), picture)
            scene = stack.enter_context(aside(os.path.join(target, "scene.xml")))
            with open(scene, "w", encoding="utf-8") as file:
                file.write(text())
    except (OSError, InputError) as error:
        with contextlib.suppress(OSError):
            os.rmdir(os.path.join(target, REPORT))
        if made:
            with contextlib.suppress(OSError):
                os.rmdir(target)
        if isinstance(error, InputError):
            raise
        raise InputError(f"{target}: {error.strerror or error}{hint}") from None


def _check_start(vertices, faces, camera, sequence, where, of_tracks, depth):
    """Raise InputError where the first frame cannot show the template, its ``vertices`` (N, 3) [m,
    camera frame], as a run would; ``where`` and ``of_tracks`` begin the line. Depth that another
    camera sees is not compared.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        position = camera.project(vertices)
    nearest = check_seen(where, position, vertices[:, 2], np.asarray(faces), sequence)
    check_tracks(of_tracks, sequence.tracks, nearest > 0)
    if depth and depth.is_seen_by(camera):
        check_depth(sequence, nearest)


def _check_body(motion, pose, camera):
    """Raise InputError where a body stands out of the view of a camera with ``pose`` (4, 4) in the
    first frame, or so far away that its motion is in another unit.
    """
    x, y, z = place = pose[:3, :3] @ motion.place + pose[:3, 3]
    beyond = z + _BODY  # where the farthest of it is
    sides = (x, camera.fx, camera.cx, camera.width), (y, camera.fy, camera.cy, camera.height)
    if beyond <= 0 or any(
        (at - _BODY) / beyond * f + c > side or (at + _BODY) / beyond * f + c < 0
        for at, f, c, side in sides
    ):
        why = "out of the camera's view"
    elif z > _FARTHEST:
        why = "too far away"
    else:
        return
    raise InputError(
        f"{motion.path}: in the first frame the body is {why}, at {np.round(place, 2).tolist()} m"
        " from it (right, down, forward); its translation, in metres, and world_to_camera in"
        " camera.json must be of one world"
    )
