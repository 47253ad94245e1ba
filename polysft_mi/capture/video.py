"""All steps from a video and a photo to a folder that ``polysft run`` takes: written aside, then
renamed.
"""

import contextlib
import os
from dataclasses import replace

import cv2
import numpy as np

from polyfit.backend import set_variant
from polysft_mi.errors import InputError
from polysft_mi.scene import focal_35mm, read_rgb
from polysft_mi.surface import meshio

from . import pictures, sheet
from .camera import Lens, Undistortion, read_lens
from .camera.calibration import calibrate as calibrate_camera
from .footage import Film
from .frames import focal_length, read_frames
from .layouts import Layout
from .masked_frames import GivenMasks, write_frames
from .masks import Registration, silhouette
from .output import REPORT, staged, target_folder, write_json, write_png
from .scene_file import scene_xml

_FIRST_FRAME = "first-frame"  # the word for a texture that is taken from the video


def prepare_video(
    video,
    out=None,
    *,
    texture,
    size=None,
    template=None,
    resolution=None,
    camera=None,
    fov=None,
    calibrate=None,
    board="9x6",
    corners=None,
    texture_corners=None,
    pose_fit="auto",
    masks=True,
    inset=0.0,
    evidence=None,
    first=0,
    last=-1,
    stride=1,
    scale=1.0,
    overwrite=False,
    say=lambda line: None,
    progress=lambda count: None,
    command="",
):
    """Make the folder ``out`` of a sequence from ``video`` (a file, a folder of images, a pattern):
    frames, masks, template, texture, camera, ``scene.xml``.

    - ``texture``: the photo, or "first-frame"; ``texture_corners`` (4, 2): pixels of the sheet's
      corners in the photo, whose rest is cut off.
    - ``size``: words as :func:`polysft_mi.capture.sheet.parse_size` takes them, for a flat template
      with ``resolution`` vertices along its longer side (33); or ``template``, an OBJ.
    - The camera, by one of ``camera`` (a file), ``fov`` [degrees] and ``calibrate`` (a video of a
      ``board``); else by what ``evidence`` says, or the video or the photo says.
    - ``corners`` (4, 2): pixels of the sheet's corners in the frame ``first`` as it was taken, or
      "frame" for the picture's own; ``pose_fit``: "auto" to move the sheet from there to the edges
      in that frame, where they are clear, or "none".
    - ``masks``: True to find them, a folder of them, or False for none; their borders are drawn in
      by ``inset`` [pixels], or out; ``evidence``: a
      :class:`polysft_mi.capture.evidence.GivenEvidence` where there is more than images.
    - ``first`` to ``last`` in steps of ``stride``: the frames; ``scale``: what they are scaled by.
    - ``say`` is given one line for each step, ``progress`` the number of frames done.

    Returns (path of the scene, a dict of what was found, as in ``prepare/prepare.json``). Raises
    InputError; then nothing is written. One exception: where the sheet is not found in the first
    frame, a picture of the matches is written, and the message names it.
    """
    if sum(x is not None for x in (camera, fov, calibrate)) > 1:
        raise InputError("--camera, --fov and --calibrate: give only one of them")
    if (size is None) == (template is None):
        raise InputError("give either --size WIDTH HEIGHT, of a flat sheet, or --template mesh.obj")
    if template is not None and resolution is not None:
        raise InputError(
            f"--resolution {resolution}: of a flat sheet; {template} has its own vertices"
        )
    inputs = [
        x
        for x in (video, texture, template, camera, calibrate, masks)
        if isinstance(x, str) and x != _FIRST_FRAME
    ]
    inputs += evidence.inputs if evidence else []
    out = target_folder(video, out, inputs, overwrite)
    masks = GivenMasks(masks) if isinstance(masks, str) else masks
    found = {"video": video, "command": command}

    film = Film()
    stream = read_frames(video, first, last, stride, film)
    index, frame = next(stream)
    taken = frame.shape[1::-1]
    if evidence:
        evidence.open(video, taken, first, last, stride)
    lens, board_picture = _lens(video, texture, camera, fov, calibrate, board, taken, evidence)
    straight = Undistortion(lens, scale)
    view, frame = straight.camera, straight.image(frame)
    found["camera"] = {**lens.as_json(), "from": lens.source}
    for line in film.notes:
        say(f"note: {video}: {line}")
    told = len(film.notes)
    say(
        f"camera: {view.fx:.1f} pixels focal length, {view.width}x{view.height},"
        f" {'undistorted, ' if any(lens.distortion) else ''}from {lens.source}"
    )

    set_variant()  # what hides a part of itself, and the pictures, need rays
    photo = _photo(texture, texture_corners, size)
    mesh = _sheet(size, template, resolution, photo, texture, say)
    if corners is not None:
        whole = [(0, 0), (taken[0], 0), taken, (0, taken[1])]
        corners = straight.points(whole if isinstance(corners, str) else corners)
    at = sheet.place(mesh, photo, frame, view, corners, pose_fit)
    if at.pose is None:
        picture = f"{out}.matches.png"
        with contextlib.suppress(OSError):
            os.makedirs(os.path.dirname(out) or ".", exist_ok=True)
            write_png(picture, pictures.matches(photo, frame, at.matches))
        raise InputError(f"{texture}: not found in frame {first}: {at.why}; {picture} shows them")
    for line in at.lines:
        say(line)
    found["pose"] = at.figures

    placed = at.pose(mesh.vertices)
    found["in_view"] = _seen(placed, view, f"{video}, frame {index}")
    if photo is None:
        photo, uv = frame, view.project(placed) / (view.width, view.height)
        uv[:, 1] = 1 - uv[:, 1]
        mesh = replace(mesh, uv=uv)
    found |= {"template": mesh.name, "size_m": np.ptp(mesh.vertices, axis=0).tolist()}
    meshio.check_template(*mesh.mesh(placed), "template")
    in_view = mesh.in_view(placed, view)

    shown = {"pose.png": pictures.pose(frame, photo, mesh, placed, view)}
    if board_picture is not None:
        shown["calibration.png"] = board_picture
    if at.matches is not None:
        shown["matches.png"] = pictures.matches(photo, frame, at.matches)

    def frames():
        yield index, frame
        for k, image in stream:
            yield k, straight.image(image)

    def registration(scale):
        used = np.unique(in_view)
        pixels = view.project(placed[used]) * scale
        return Registration(photo, mesh.uv[used], np.searchsorted(used, in_view), pixels)

    with staged(out) as partial:
        for name in (REPORT, "frames"):
            os.makedirs(os.path.join(partial, name))
        for name, image in shown.items():
            write_png(os.path.join(partial, REPORT, name), image)
        expected = silhouette(view.project(placed), mesh.faces, frame.shape[1::-1])
        written = write_frames(
            partial, frames(), masks, expected, straight, progress, registration, inset
        )
        found |= {"frames": len(written.indices), "indices": written.indices}
        found["fps"], uneven = film.rate(stride)
        for line in [*film.notes[told:], *filter(None, [uneven])]:
            say(f"note: {video}: {line}")
        settings = {"fps": round(found["fps"], 6)} if found["fps"] else {}
        if evidence:
            known, lines = evidence.write(partial, written.indices, straight)
            settings |= known
            written.lines += lines
        if written.figures:
            found["masks"] = written.figures
        speed = f", {found['fps']:.4g} a second" if found["fps"] else ""
        for line in (
            f"frames: {len(written.indices)} of {view.width}x{view.height}{speed}",
            *written.lines,
        ):
            say(line)
        _write_scene(partial, view, written.masked, photo, placed, mesh, settings)
        write_json(os.path.join(partial, REPORT, "prepare.json"), found)
    return os.path.join(out, "scene.xml"), found


def _write_scene(folder, view, masked, photo, placed, mesh, settings):
    """The files that the scene names beside frames and masks, and the scene itself, with
    ``settings``.
    """
    finest = 2048  # pixels of the texture's longer side; what is finer no frame shows
    write_png(os.path.join(folder, "texture.png"), pictures.shrunk(photo, finest)[0])
    meshio.write_obj(os.path.join(folder, "template.obj"), *mesh.mesh(placed))
    write_json(os.path.join(folder, "camera.json"), Lens(view).as_json())
    layout = Layout(
        "cloth", view, "frames", "masks" if masked else "", "texture.png", "template.obj"
    )
    layout = replace(layout, settings=settings)
    comment = "A video prepared by python -m polysft_mi.prepare; prepare/ shows what it found."
    with open(os.path.join(folder, "scene.xml"), "w", encoding="utf-8") as file:
        file.write(scene_xml(layout, ".", comment=comment))


def _lens(video, texture, camera, fov, calibrate, board, size, evidence):
    """(Lens, picture of the calibration or None) of frames of ``size`` (width, height)."""
    if camera is not None:
        return read_lens(camera, *size), None
    if fov is not None:
        return Lens.from_fov(fov, *size), None
    if calibrate is not None:
        lens, picture = calibrate_camera(calibrate, board)
        return lens.resized(*size), picture
    if evidence and (lens := evidence.lens(*size)) is not None:
        return lens, None
    focal, where = focal_length(video)
    if focal is None and texture != _FIRST_FRAME:
        focal, where = focal_35mm(texture), f"{texture}, if it has the same camera and zoom"
    if focal is None:
        raise InputError(
            f"{video}: does not say its camera; give --fov DEGREES (across the picture), --camera"
            " camera.json, or --calibrate VIDEO of a chessboard"
        )
    return Lens.from_focal_35mm(focal, *size, where), None


def _photo(texture, corners, size):
    """The photo (H, W, 3) uint8, cut to its corners; None where the first frame is the texture."""
    photo = None if texture == _FIRST_FRAME else read_rgb(texture)
    if corners is None:
        return photo
    if photo is None:
        raise InputError(
            "--texture-corners needs a photo; --corners says where the sheet is in the first frame"
        )
    return _cut_out(photo, corners, size)


def _sheet(size, template, resolution, photo, texture, say):
    """The template before it is placed."""
    if template is not None:
        return sheet.from_obj(template)
    aspect = photo.shape[1] / photo.shape[0] if photo is not None else None
    width, height = sheet.parse_size(size, aspect)
    if aspect is not None:
        alike = 1.06  # ratio of two aspects up to which photo and size agree
        ratio, turned = (max(r, 1 / r) for r in (aspect * height / width, aspect * width / height))
        if ratio > alike and turned < ratio / 1.2:
            raise InputError(
                f"{texture}: {photo.shape[1]}x{photo.shape[0]} pixels, for a sheet {width:g} m wide"
                f" and {height:g} m high; give --size {height:g} {width:g}?"
            )
        if ratio > alike:
            say(
                f"note: the photo is {aspect:.3g} times as wide as high, the sheet"
                f" {width / height:.3g} times; does it show the sheet from edge to edge"
                " (--texture-corners)?"
            )
    return sheet.grid(width, height, resolution)


def _seen(placed, view, where):
    """The share of the vertices (N, 3) [m] that lie in the picture. Raises InputError where it is
    too small.
    """
    least = 0.3
    x = view.project(placed)
    seen = float(((x > 0) & (x < (view.width, view.height))).all(axis=1).mean())
    if seen < least:
        raise InputError(
            f"{where}: {100 * seen:.0f} % of the sheet is in view; at least {100 * least:.0f} %"
            " must be: start later, by --first"
        )
    return seen


def _cut_out(photo, corners, size):
    """The part of a photo between four corners (4, 2) [pixels], as seen straight on."""
    corners = np.asarray(corners, dtype=np.float32)
    length = lambda a, b: float(np.linalg.norm(corners[a] - corners[b]))
    w, h = max(length(0, 1), length(3, 2)), max(length(0, 3), length(1, 2))
    if size is not None:
        width, height = sheet.parse_size(size, w / h)
        w, h = (w, w * height / width) if w / width > h / height else (h * width / height, h)
    w, h = max(2, round(w)), max(2, round(h))
    if max(w, h) > 16384:
        raise InputError("--texture-corners: they span more than the photo")
    H = cv2.getPerspectiveTransform(
        corners - 0.5,
        np.float32([(-0.5, -0.5), (w - 0.5, -0.5), (w - 0.5, h - 0.5), (-0.5, h - 0.5)]),
    )
    return cv2.warpPerspective(
        photo, H, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
