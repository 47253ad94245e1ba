"""All steps, from a video and a photo to a folder that ``polysft_mi.run`` takes: written aside,
then renamed.
"""

import contextlib
import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from polysft_mi.errors import InputError
from polysft_mi.prepare import Layout, scene_xml, write_obj
from polysft_mi.scene.images import focal_35mm, read_rgb
from polysft_mi.scene.outline import fitted
from polysft_mi.scene.sequence import list_images
from polysft_mi.surface import meshio

from . import pictures, sheet
from .calibration import calibrate as calibrate_camera
from .frames import focal_length, is_video, read_frames
from .lens import Lens, Undistortion
from .masks import Masks, iou, silhouette
from .pose import LEAST, Pose, from_corners, from_matches, match
from .size import parse_size

FIRST_FRAME = "first-frame"
REPORT = "prepare"  # the folder with the pictures and prepare.json
_FRAME, _MASK = "frames/{:05d}.png", "masks/{:05d}.png"
_IN_VIEW = 0.3  # share of the vertices that must be seen in the first frame
_ASPECT = 1.06  # ratio of the aspects of photo and size that is said
_ALIKE = (
    0.85  # IoU of the first mask and the template's silhouette, below which masks are not believed
)
_BENT = (
    0.005  # of the frame's diagonal, by which a rigid pose misses matches, from which it is said
)
_STRANGE = 0.75  # of their colours, likewise
_JUMP = 1.5  # ratio of the areas of two masks in a row, likewise
_SHARPEST = 2048  # pixels of a texture's longer side; what is finer no frame shows


def capture(
    video, out=None, *, texture, size=None, template=None, resolution=33, camera=None, fov=None,
    calibrate=None, board="9x6", corners=None, texture_corners=None, pose_fit="auto", masks=True,
    first=0, last=-1, stride=1, scale=1.0, overwrite=False, say=lambda line: None,
    progress=lambda count: None, command="",
):  # fmt: skip
    """Make the folder ``out`` of a sequence from ``video`` (a file, a folder of images, a pattern):
    frames, masks, template, texture, camera, ``scene.xml``.

    ``texture``: the photo, or "first-frame"; ``size``: words as
    :func:`polysft_mi.capture.size.parse_size` takes them, or ``template``, an OBJ; the camera by
    one of ``camera`` (a file), ``fov`` [degrees] and ``calibrate`` (a video of a ``board``), else
    by what the video says; ``corners`` (4, 2): pixels of the sheet's corners in the frame ``first``
    as it was taken, or "frame" for the picture's own, and ``pose_fit``: "auto" to move the sheet
    from there to the edges in that frame, where they are clear, or "none"; ``texture_corners`` (4,
    2): likewise in the photo, whose rest is cut off; ``masks``: True to find them, a folder of
    them, or False for none; ``say`` is given one line for each step, ``progress`` the number of
    frames done.

    Returns (path of the scene, a dict of what was found: what ``prepare/prepare.json`` holds).
    Raises InputError; then nothing is written, but where the sheet is not found in the first frame,
    a picture of the matches, which the message names.
    """
    if sum(x is not None for x in (camera, fov, calibrate)) > 1:
        raise InputError("--camera, --fov and --calibrate: one of them is needed, not several")
    if (size is None) == (template is None):
        raise InputError("give either --size WIDTH HEIGHT, of a flat sheet, or --template mesh.obj")
    inputs = [
        x
        for x in (video, texture, template, camera, calibrate, masks)
        if isinstance(x, str) and x != FIRST_FRAME
    ]
    out = _target(video, out, inputs, overwrite)
    if isinstance(masks, str):
        list_images(masks, "masks")  # that they are there is known before the work
    found = {"video": video, "command": command}

    stream = read_frames(video, first, last, stride)
    index, frame = next(stream)
    taken = frame.shape[1::-1]
    lens, board_picture = _lens(video, texture, camera, fov, calibrate, board, taken)
    straight = Undistortion(lens, scale)
    view = straight.camera
    frame = straight.image(frame)
    found["camera"] = {**lens.as_json(), "from": lens.source}
    say(
        f"camera: {view.fx:.1f} pixels focal length, {view.width}x{view.height},"
        f" {'undistorted, ' if any(lens.distortion) else ''}from {lens.source}"
    )

    photo = None if texture == FIRST_FRAME else read_rgb(texture)
    if texture_corners is not None:
        if photo is None:
            raise InputError(
                "--texture-corners: for a photo; --corners says where the sheet lies in the first"
                " frame"
            )
        photo = _cut_out(photo, texture_corners, size)
    mesh = _sheet(size, template, resolution, photo, texture, say)

    pose, matches = _pose(
        mesh,
        photo,
        texture,
        frame,
        view,
        straight,
        corners,
        taken,
        pose_fit,
        out,
        first,
        found,
        say,
    )
    placed = pose(mesh.vertices)
    seen = _seen(placed, view)
    if seen < _IN_VIEW:
        raise InputError(
            f"{video}, frame {index}: {100 * seen:.0f} % of the sheet is in view; at least"
            f" {100 * _IN_VIEW:.0f} % must be: start later, by --first"
        )
    if photo is None:
        photo, uv = frame, view.project(placed) / (view.width, view.height)
        uv[:, 1] = 1 - uv[:, 1]
        mesh = sheet.Sheet(mesh.vertices, mesh.faces, uv, mesh.name)
    found |= {
        "template": mesh.name,
        "in_view": seen,
        "size_m": np.ptp(mesh.vertices, axis=0).tolist(),
    }
    meshio.check_template(placed, mesh.faces, mesh.uv, "template")

    os.makedirs(os.path.dirname(out) or ".", exist_ok=True)
    partial = os.path.join(os.path.dirname(out), f".{os.getpid()}.partial.{os.path.basename(out)}")
    try:
        os.makedirs(os.path.join(partial, REPORT))
        os.makedirs(os.path.join(partial, "frames"))
        save = lambda name, image: _write_png(os.path.join(partial, REPORT, name), image)
        if board_picture is not None:
            save("calibration.png", board_picture)
        if matches is not None:
            save("matches.png", pictures.matches(photo, frame, matches))
        save("pose.png", pictures.pose(frame, photo, mesh, placed, view))
        used = _write_frames(
            partial,
            index,
            frame,
            stream,
            straight,
            masks,
            silhouette(view.project(placed), mesh.faces, frame.shape[1::-1]),
            found,
            say,
            progress,
        )
        _write_png(os.path.join(partial, "texture.png"), pictures.shrunk(photo, _SHARPEST)[0])
        write_obj(os.path.join(partial, "template.obj"), placed, mesh.faces, mesh.uv)
        _write_json(os.path.join(partial, "camera.json"), Lens(view).as_json())
        _write_json(os.path.join(partial, REPORT, "prepare.json"), found)
        layout = Layout(
            "cloth", view, "frames", "masks" if used else "", "texture.png", "template.obj"
        )
        with open(os.path.join(partial, "scene.xml"), "w", encoding="utf-8") as file:
            file.write(
                scene_xml(
                    layout,
                    ".",
                    comment=(
                        "A video prepared by python -m polysft_mi.prepare; prepare/ shows what it"
                        " found."
                    ),
                )
            )
        _replace(partial, out)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError) and error.errno is not None:
            raise InputError(f"{out}: {error.strerror or error}") from None
        raise
    return os.path.join(out, "scene.xml"), found


# ---- steps ---------------------------------------------------------------------------------------


def _lens(video, texture, camera, fov, calibrate, board, size):
    """(Lens, picture of the calibration or None)."""
    if camera is not None:
        return Lens.from_json(camera, *size), None
    if fov is not None:
        return Lens.from_fov(fov, *size), None
    if calibrate is not None:
        lens, picture = calibrate_camera(calibrate, board)
        return lens.resized(*size), picture
    focal, where = focal_length(video)
    if focal is None and texture != FIRST_FRAME:
        focal, where = focal_35mm(texture), f"{texture}, taken for the same camera and zoom"
    if focal is None:
        raise InputError(
            f"{video}: does not say its camera; give --fov DEGREES (across the picture), --camera"
            " camera.json, or --calibrate VIDEO of a chessboard"
        )
    return Lens.from_focal_35mm(focal, *size, where), None


def _sheet(size, template, resolution, photo, texture, say):
    if template is not None:
        return sheet.from_obj(template)
    aspect = photo.shape[1] / photo.shape[0] if photo is not None else None
    width, height = parse_size(size, aspect)
    if aspect is not None:
        ratio, turned = aspect / (width / height), aspect / (height / width)
        if (
            max(ratio, 1 / ratio) > _ASPECT
            and max(turned, 1 / turned) < max(ratio, 1 / ratio) / 1.2
        ):
            raise InputError(
                f"{texture}: {photo.shape[1]}x{photo.shape[0]} pixels, for a sheet {width:g} m wide"
                f" and {height:g} m high; give --size {height:g} {width:g}?"
            )
        if max(ratio, 1 / ratio) > _ASPECT:
            say(
                f"note: the photo is {aspect:.3g} times as wide as high, the sheet"
                f" {width / height:.3g} times; does it show the sheet from edge to edge"
                " (--texture-corners)?"
            )
    return sheet.grid(width, height, resolution)


def _pose(
    mesh, photo, texture, frame, view, straight, corners, taken, pose_fit, out, first, found, say
):
    """(Pose, Matches or None), or InputError with a picture of the matches."""
    if corners is not None:
        corners = (
            [(0, 0), (taken[0], 0), taken, (0, taken[1])] if isinstance(corners, str) else corners
        )
        pose = from_corners(straight.points(corners), mesh, view)
        found["pose"] = {"by": "corners", "residual_px": float(np.sqrt((pose.residual**2).mean()))}
        said = f"pose: by its corners, missed by {found['pose']['residual_px']:.2f} pixels"
        fit = fitted(pose(mesh.vertices), mesh.faces, view, frame) if pose_fit == "auto" else None
        if fit is not None and fit.sure:
            pose = Pose(fit.rotation @ pose.rotation, fit(pose.translation[None])[0], pose.residual)
            found["pose"]["moved_px"] = fit.moved
            said += f", moved by {fit.moved:.2f} pixels to the edges of the frame"
        say(said)
        return pose, None
    if photo is None:
        raise InputError(
            "--texture first-frame: --corners x,y x,y x,y x,y must say where the sheet lies in it"
            " (top left, top right, bottom right, bottom left), or --corners frame"
        )
    matches = match(photo, frame)
    pose, matches = from_matches(matches, mesh, view)
    if pose is None:
        picture = f"{out}.matches.png"
        with contextlib.suppress(OSError):
            os.makedirs(os.path.dirname(out) or ".", exist_ok=True)
            _write_png(picture, pictures.matches(photo, frame, matches))
        raise InputError(
            f"{texture}: not found in frame {first}: {_why_not(photo, frame, matches, mesh, view)};"
            f" {picture} shows them"
        )
    residual = float(np.sqrt((pose.residual**2).mean()))
    found["pose"] = {
        "by": "features",
        "matches": len(matches.agree),
        "agree": int(matches.agree.sum()),
        "residual_px": residual,
    }
    say(
        f"pose: {int(matches.agree.sum())} of {len(matches.agree)} matches agree, missed by"
        f" {residual:.2f} pixels RMS"
    )
    if residual > _BENT * np.hypot(view.width, view.height):
        say(
            f"note: the sheet is bent in frame {first}, and the template is not; a run may start"
            " wrongly there: see pose.png, or choose another --first"
        )
    return pose, matches


def _why_not(photo, frame, matches, mesh, view):
    """In words, why no pose was found."""
    agree = int(matches.agree.sum())
    mirrored = replace(mesh, uv=mesh.uv * (-1, 1) + (1, 0))
    if from_matches(match(np.ascontiguousarray(photo[:, ::-1]), frame), mirrored, view)[
        1
    ].agree.sum() >= max(2 * agree, 2 * LEAST):
        return "its mirror image is; flip the photo, or the video (cameras for selfies mirror)"
    advice = (
        "start where the sheet is seen whole and sharp (--first N), or say where it is (--corners"
        " x,y x,y x,y x,y)"
    )
    if agree < LEAST:
        return (
            f"{agree} of {len(matches.agree)} matches agree on a pose, {LEAST} are needed; {advice}"
        )
    return (
        f"the {agree} matches that agree, of {len(matches.agree)}, put the sheet behind the camera"
        f" or on its back; {advice}"
    )


def _write_frames(folder, index, frame, stream, straight, masks, expected, found, say, progress):
    """Write frames, and masks where they are wanted; whether the masks are to be used."""
    tracked = Masks(expected.shape[::-1]) if masks is True else None
    if masks:
        os.makedirs(os.path.join(folder, "masks"))
    indices, areas, strange, first_iou = [], [], [], None
    with ThreadPoolExecutor(2) as pool:
        pending = []

        def write(name, image):
            pending.append(pool.submit(_write_png, os.path.join(folder, name), image))
            if len(pending) > 8:
                pending.pop(0).result()

        while frame is not None:
            k = len(indices)
            write(_FRAME.format(k), frame)
            if tracked:
                mask = tracked.next(frame) if k else tracked.first(frame, expected)
                first_iou = iou(mask, expected) if k == 0 else first_iou
                areas.append(int((mask > 0).sum()))
                strange.append(tracked.strangeness)
                write(_MASK.format(k), mask)
            indices.append(index)
            progress(len(indices))
            index, taken = next(stream, (None, None))
            frame = None if taken is None else straight.image(taken)
        for job in pending:
            job.result()
    found |= {"frames": len(indices), "indices": indices}
    say(f"frames: {len(indices)} of {straight.camera.width}x{straight.camera.height}")
    used, why = bool(masks), None
    if isinstance(masks, str):
        _given_masks(folder, masks, indices, straight)
        say(f"masks: those of {masks}")
    elif tracked:
        used, why = _believable(first_iou, areas, strange, indices)
        found["masks"] = {
            "first_iou": first_iou,
            "strangeness": max(strange),
            "used": used,
            **({"why": why} if why else {}),
        }
        say(
            f"masks: by GrabCut, the first overlaps with the template by {100 * first_iou:.0f} %"
            if used
            else f"masks: not used, for {why}; prepare/masks.png shows them"
        )
    _show(folder, indices, bool(masks))
    if masks and not used:
        shutil.rmtree(os.path.join(folder, "masks"))
    return used


def _show(folder, indices, masked):
    """Contact sheets of the frames and masks that were written."""
    read = lambda name: read_rgb(os.path.join(folder, name))
    few = [
        (k, f"frame {indices[k]}", read(_FRAME.format(k))) for k in pictures.chosen(len(indices))
    ]
    _write_png(
        os.path.join(folder, REPORT, "frames.png"),
        pictures.contact_sheet([(caption, image) for _, caption, image in few]),
    )
    if masked:
        cells = [
            (caption, pictures.masked(image, read(_MASK.format(k))[..., 0]))
            for k, caption, image in few
        ]
        _write_png(os.path.join(folder, REPORT, "masks.png"), pictures.contact_sheet(cells))


def _believable(first_iou, areas, strange, indices):
    """(whether masks can be used, why not)."""
    if first_iou < _ALIKE:
        return (
            False,
            (
                f"in the first frame they overlap with the template by {100 * first_iou:.0f} %"
                " only: the sheet does not stand out from what is behind it"
            ),
        )
    for before, after, index in zip(areas, areas[1:], indices[1:]):
        if after == 0 or max(before / after, after / before) > _JUMP:
            return False, f"in frame {index} their area jumps from {before} to {after} pixels"
    for index, value in zip(indices, strange):
        if value > _STRANGE:
            return (
                False,
                f"what is inside in frame {index} has other colours than the sheet in the first",
            )
    return True, None


def _given_masks(folder, masks, indices, straight):
    paths = list_images(masks, "masks")
    if len(paths) != len(indices) and len(paths) <= indices[-1]:
        raise InputError(
            f"{masks}: {len(paths)} masks for {len(indices)} frames, the last of them frame"
            f" {indices[-1]}; one a frame is needed"
        )
    paths = paths if len(paths) == len(indices) else [paths[k] for k in indices]
    for k, path in enumerate(paths):
        mask = read_rgb(path).max(axis=2)
        if mask.shape[::-1] != straight.size:
            raise InputError(
                f"{path}: {mask.shape[1]}x{mask.shape[0]} pixels; the frames have"
                f" {straight.size[0]}x{straight.size[1]}"
            )
        mask = straight.image(255 * mask if 0 < mask.max() <= 1 else mask)
        if k == 0 and not (mask > 127).any():
            raise InputError(
                f"{path}: the mask of the first frame is empty; the sheet must be seen in it"
            )
        _write_png(os.path.join(folder, _MASK.format(k)), mask)


# ---- files ---------------------------------------------------------------------------------------


def _target(video, out, inputs, overwrite):
    """The folder to write, checked before any work."""
    if out is None:
        if not is_video(video):
            raise InputError(
                f"{video}: -o DIR, the folder to write, is needed beside a folder of images"
            )
        out = os.path.splitext(video)[0]
    out = os.path.normpath(out)
    for path in inputs:
        a, b = os.path.realpath(path), os.path.realpath(out)
        if a == b or a.startswith(b + os.sep):
            raise InputError(
                f"{out}: {path} lies in it, and would be replaced; give another folder by -o"
            )
    if os.path.isdir(out) and os.listdir(out):
        if not overwrite:
            raise InputError(
                f"{out}: is there already; give --overwrite to replace it, or another folder by -o"
            )
        if not os.path.isfile(os.path.join(out, REPORT, "prepare.json")):
            raise InputError(
                f"{out}: holds what this command did not write, and is not replaced; give another"
                " folder by -o"
            )
    elif os.path.exists(out) and not os.path.isdir(out):
        raise InputError(f"{out}: is a file; -o needs a folder")
    return out


def _replace(partial, out):
    """Rename a finished folder to ``out``; what stood there goes only when the new one stands."""
    old = f"{partial}.old"
    if os.path.isdir(out):
        os.rename(out, old)
    try:
        os.rename(partial, out)
    except OSError:
        if os.path.isdir(old):
            os.rename(old, out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _write_png(path, image):
    image = image[..., ::-1] if image.ndim == 3 else image
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    with open(path, "wb") as file:
        file.write(data.tobytes())


def _write_json(path, value):
    with open(path, "w", encoding="utf-8") as file:
        json.dump(value, file, indent=1, ensure_ascii=False)
        file.write("\n")


def _seen(placed, view):
    x = view.project(placed)
    return float(((x > 0) & (x < (view.width, view.height))).all(axis=1).mean())


def _cut_out(photo, corners, size):
    """The part of a photo between four corners (4, 2) [pixels], as seen straight on."""
    corners = np.asarray(corners, dtype=np.float32)
    length = lambda a, b: float(np.linalg.norm(corners[a] - corners[b]))
    w, h = max(length(0, 1), length(3, 2)), max(length(0, 3), length(1, 2))
    if size is not None:
        width, height = parse_size(size, w / h)
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
