"""Where the sheet lies in the first frame, by its photo or by its corners; what a person is told of
it.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from polysft_mi.errors import InputError
from polysft_mi.poses import fitted

from .pose import Matches, MatchRules, Pose, from_corners, from_matches, match

# share of the frame's diagonal: matches that miss a rigid pose by more mean that the sheet is bent
MAX_FLAT_RESIDUAL = 0.005


@dataclass
class Placed:
    """A sheet's ``pose``, or None where it was not found, and then ``why`` in words; ``matches``,
    where features were matched; ``figures`` of it, and ``lines`` for a person.
    """

    pose: Pose | None = None
    matches: Matches | None = None
    why: str | None = None
    figures: dict = field(default_factory=dict)
    lines: list = field(default_factory=list)


def place(sheet, photo, frame, camera, corners=None, pose_fit="auto"):
    """The :class:`Placed` of a :class:`polysft_mi.capture.sheet.Sheet` in a frame (H, W, 3) uint8.

    By ``corners`` (4, 2) [pixels of the frame], which ``pose_fit`` = "auto" moves to the edges that
    are near; else by the features of ``photo`` (H, W, 3) uint8. ``camera``:
    :class:`polysft_mi.camera.Intrinsics`. Raises InputError for corners that cannot be.
    """
    if corners is not None:
        return _by_corners(corners, sheet, frame, camera, pose_fit)
    if photo is None:
        raise InputError(
            "--texture first-frame: --corners x,y x,y x,y x,y must say where the sheet lies in it"
            " (top left, top right, bottom right, bottom left), or --corners frame"
        )
    pose, matches = from_matches(match(photo, frame), sheet, camera)
    if pose is None:
        return Placed(matches=matches, why=_why_not(photo, frame, matches, sheet, camera))
    residual = float(np.sqrt((pose.residual**2).mean()))
    agree, count = int(matches.agree.sum()), len(matches.agree)
    figures = {"by": "features", "matches": count, "agree": agree, "residual_px": residual}
    lines = [f"pose: {agree} of {count} matches agree, {residual:.2f} pixels RMS"]
    if residual > MAX_FLAT_RESIDUAL * np.hypot(camera.width, camera.height):
        lines.append(
            "note: the sheet is bent in the first frame, but the template is flat; a run may start"
            " wrongly: see pose.png, or choose another --first"
        )
    return Placed(pose, matches, None, figures, lines)


def _by_corners(corners, sheet, frame, camera, pose_fit):
    pose = from_corners(corners, sheet, camera)
    residual = float(np.sqrt((pose.residual**2).mean()))
    figures = {"by": "corners", "residual_px": residual}
    line = f"pose: from the corners, {residual:.2f} pixels RMS"
    fit = None  # of the edges of what hides a part of itself, only some are its border
    if pose_fit == "auto" and sheet.one_sided:
        fit = fitted(pose(sheet.vertices), sheet.faces, camera, frame)
    if fit is not None and fit.sure:
        pose = Pose(fit.rotation @ pose.rotation, fit(pose.translation[None])[0], pose.residual)
        figures["moved_px"] = fit.moved
        line += f", moved by {fit.moved:.2f} pixels to the edges of the frame"
    return Placed(pose, None, None, figures, [line])


def _why_not(photo, frame, matches, sheet, camera):
    """In words, why no pose was found."""
    agree, count, least = int(matches.agree.sum()), len(matches.agree), MatchRules().min_matches
    mirrored = replace(sheet, uv=sheet.uv * (-1, 1) + (1, 0))
    flipped = match(np.ascontiguousarray(photo[:, ::-1]), frame)
    if from_matches(flipped, mirrored, camera)[1].agree.sum() >= max(2 * agree, 2 * least):
        return "its mirror image is; flip the photo, or the video (cameras for selfies mirror)"
    advice = (
        "start where the sheet is seen whole and sharp (--first N), or say where it is (--corners"
        " x,y x,y x,y x,y)"
    )
    if agree < least:
        return f"{agree} of {count} matches agree on a pose, {least} are needed; {advice}"
    return (
        f"the {agree} matches that agree, of {count}, put the sheet behind the camera or on its"
        f" back; {advice}"
    )
