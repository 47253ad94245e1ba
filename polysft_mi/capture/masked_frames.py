"""Writes the frames of a sequence's folder, and masks beside them: found, given, or none."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from polyfit.files import silent_decoders
from polysft_mi.errors import InputError
from polysft_mi.scene import checked_size, inverted, list_images, read_mask, read_rgb

from . import pictures
from .masks import Masks, beyond, drawn_in, iou
from .output import FRAME, MASK, REPORT, write_png


@dataclass(frozen=True)
class MaskChecks:
    """Which masks that were found are not believed.

    ``overlap``: least intersection over union of the first mask with the template's silhouette;
    ``area_ratio``: largest ratio of the areas of two masks in a row; ``strangeness``: largest
    distance of a mask's colours from those of the first (Bhattacharyya, 0 to 1).
    """

    overlap: float = 0.85
    area_ratio: float = 1.5
    strangeness: float = 0.75


@dataclass
class Written:
    """The result: ``indices`` of the frames in the video; ``masked``: whether the masks can be
    used; ``figures`` of the masks that were found, or None; ``lines`` for a person."""

    indices: list
    masked: bool
    figures: dict
    lines: list


def write_frames(folder, frames, masks, expected, straight, progress, registration=None, inset=0.0):
    """Write ``frames``, an iterable of (index in the video, image (H, W, 3) uint8 RGB), and masks.

    ``masks``: True to find them, from ``expected`` (H, W), the template's silhouette in the first
    frame; False for none; or :class:`GivenMasks`, which ``straight``, the
    :class:`polysft_mi.capture.camera.Undistortion` of the frames, makes fit to them. ``progress``
    is given the number of frames done; ``registration`` as for
    :class:`polysft_mi.capture.masks.Masks`; ``inset`` [pixels]: masks are drawn in by it, or out.
    Returns :class:`Written`. Raises InputError.
    """
    tracked = Masks(expected.shape[::-1], registration) if masks is True else None
    if masks:
        os.makedirs(os.path.join(folder, "masks"))
    indices, areas, strange, overlap, passes = [], [], [], None, 0.0
    # small matrices: several threads of BLAS would only wait for each other
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(2) as pool:
        pending = []

        def write(name, image):
            pending.append(pool.submit(write_png, os.path.join(folder, name), image))
            if len(pending) > 8:
                pending.pop(0).result()

        for k, (index, frame) in enumerate(frames):
            write(FRAME.format(k), frame)
            if tracked:
                mask = tracked.next(frame) if k else tracked.first(frame, expected)
                mask = _drawn_in(mask, inset, k == 0)
                if k == 0:
                    overlap, passes = iou(mask, expected), beyond(mask, expected)
                areas.append(int((mask > 127).sum()))
                strange.append(tracked.strangeness)
                write(MASK.format(k), mask)
            indices.append(index)
            progress(len(indices))
        for job in pending:
            job.result()
    result = Written(indices, bool(masks), None, [])
    if isinstance(masks, GivenMasks):
        first = masks.write(folder, indices, straight, inset)
        if inverted(first > 127, expected > 127):
            raise InputError(
                f"{masks.pattern}: the first frame's mask is of all but the template; is it"
                " inverted? White is the sheet"
            )
        overlap = iou(first, expected)
        met = _how_met(overlap, beyond(first, expected))
        if overlap < MaskChecks().overlap:
            met += ": they should be of the template, and of all of it that is seen"
        result.lines.append(f"masks: those of {masks.pattern}; {met}")
    elif tracked:
        why = _why_not_used(overlap, areas, strange, indices, inset)
        result.masked = why is None
        result.figures = {
            "first_iou": overlap,
            "beyond_px": passes,
            "strangeness": max(strange),
            "used": why is None,
        }
        if why is None:
            result.lines.append(f"masks: by GrabCut; {_how_met(overlap, passes)}")
        else:
            result.figures["why"] = why
            result.lines.append(f"masks: not used: {why}; prepare/masks.png shows them")
    _write_contact_sheets(folder, indices, bool(masks))
    if masks and not result.masked:
        shutil.rmtree(os.path.join(folder, "masks"))
    return result


def _drawn_in(mask, inset, first):
    """A mask drawn in by ``inset`` [pixels]. Raises InputError where that leaves nothing of the
    ``first`` one.
    """
    drawn = drawn_in(mask, inset)
    if first and (mask > 127).any() and not (drawn > 127).any():
        raise InputError(
            f"--inset {inset:g}: nothing is left of the first frame's mask; a few pixels, by which"
            " the masks pass the sheet, can be drawn in"
        )
    return drawn


def _how_met(overlap, passes):
    """How the first mask meets the template, in words."""
    how = "passes" if passes > -0.05 else "ends within"
    return (
        f"the first and the template overlap by {100 * overlap:.0f} %, and it {how} the template"
        f" by {abs(passes):.1f} pixels"
    )


def _write_contact_sheets(folder, indices, masked):
    """Pictures of some of the frames and masks that were written."""
    read = lambda name: read_rgb(os.path.join(folder, name))
    few = [
        (k, f"frame {indices[k]}", read(FRAME.format(k)))
        for k in pictures.evenly_spaced(len(indices))
    ]
    write_png(
        os.path.join(folder, REPORT, "frames.png"),
        pictures.contact_sheet([(caption, image) for _, caption, image in few]),
    )
    if masked:
        cells = [
            (caption, pictures.masked(image, read(MASK.format(k))[..., 0]))
            for k, caption, image in few
        ]
        write_png(os.path.join(folder, REPORT, "masks.png"), pictures.contact_sheet(cells))


def _why_not_used(overlap, areas, strange, indices, inset=0.0):
    """Why masks that were found cannot be used, in words; None where they can. They were drawn in
    by ``inset`` [pixels].
    """
    checks = MaskChecks()
    if overlap < checks.overlap:
        cause = f"they are drawn in by --inset {inset:g}, or " if inset else ""
        return (
            f"in the first frame mask and template overlap by only {100 * overlap:.0f} %,"
            f" {cause}the sheet does not stand out from its background"
        )
    for before, after, index in zip(areas, areas[1:], indices[1:]):
        if after == 0 or max(before / after, after / before) > checks.area_ratio:
            return f"in frame {index} their area jumps from {before} to {after} pixels"
    for index, value in zip(indices, strange):
        if value > checks.strangeness:
            return (
                f"in frame {index} the colours inside are not those of the sheet in the first frame"
            )
    return None


class GivenMasks:
    """Masks that a person has: ``pattern``, a folder of images or a glob pattern, one for every
    frame of the video or one for every frame that is used. Raises InputError where there are none.
    """

    def __init__(self, pattern):
        self.pattern = pattern
        self._paths = list_images(pattern, "masks")

    def write(self, folder, indices, straight, inset=0.0):
        """Write those of the frames ``indices`` into the folder, undistorted, scaled, and drawn in
        by ``inset`` [pixels]; returns the first of them.
        """
        paths, size = self._paths, straight.size
        if len(paths) != len(indices):
            if len(paths) <= indices[-1]:
                raise InputError(
                    f"{self.pattern}: {len(paths)} masks for {len(indices)} frames, the last of"
                    f" them frame {indices[-1]}; one a frame is needed"
                )
            paths = [paths[k] for k in indices]
        for k, path in enumerate(paths):
            checked_size(path)
            with silent_decoders():
                mask = np.round(255 * read_mask(path)).astype(np.uint8)
            if mask.shape[::-1] != size:
                raise InputError(
                    f"{path}: {mask.shape[1]}x{mask.shape[0]} pixels; the frames have"
                    f" {size[0]}x{size[1]}"
                )
            mask = straight.image(mask)
            if k == 0 and not (mask > 127).any():
                raise InputError(
                    f"{path}: the mask of the first frame is empty; the sheet must be seen in it"
                )
            mask = _drawn_in(mask, inset, k == 0)
            if k == 0:
                first = mask
            write_png(os.path.join(folder, MASK.format(k)), mask)
        return first
