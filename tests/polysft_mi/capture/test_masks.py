"""Masks of a sheet whose corners have the colour of the background: the photo tells where they
end; and what is in front of the sheet is not taken for it.
"""

import cv2
import numpy as np
import pytest
from clips import CAMERA, HEIGHT, WIDTH, photo, placed, rendered

from polysft_mi.capture.masks import Masks, Registration, beyond, drawn_in, iou, silhouette
from polysft_mi.capture.sheet import grid

GREY = np.full((240, 320, 3), 40, np.uint8)


def dark_corners():
    """A print whose corners have the background's colour, but for a little detail."""
    print_ = photo().astype(float)
    h, w = print_.shape[:2]
    y, x = np.mgrid[:h, :w]
    near = np.min([np.hypot(y - cy, x - cx) for cy in (0, h) for cx in (0, w)], axis=0)
    share = np.clip(near / 60 - 0.5, 0, 1)[..., None]
    return np.round(share * print_ + (1 - share) * (36 + 0.06 * print_)).astype(np.uint8)


def followed(print_, with_photo, hide=None, count=8):
    """(masks, coverages) of a moving sheet before a grey background."""
    sheet = grid(WIDTH, HEIGHT, 33)
    R, t = placed()
    pixels = CAMERA.project(sheet.vertices @ R.T + t)
    register = lambda scale: Registration(print_, sheet.uv, sheet.faces, pixels * scale)
    masks = Masks((320, 240), register if with_photo else None)
    found, covers = [], []
    for k in range(count):
        frame, cover = rendered(print_, k / 11, over=GREY)
        if hide is not None and k > 2:
            frame[hide], cover[hide] = (90, 160, 70), 0
        mask = (
            masks.next(frame)
            if k
            else masks.first(frame, silhouette(pixels, sheet.faces, (320, 240)))
        )
        found.append(mask)
        covers.append(cover)
    return found, covers


def corner_misses(masks):
    """How far the masks end from the sheet's corners [pixels], the farthest of each frame."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * (
        WIDTH / 2,
        HEIGHT / 2,
        0,
    )
    missed = []
    for k, mask in enumerate(masks):
        R, t = placed(k / 11)
        inside = np.argwhere(mask > 0)[:, ::-1] + 0.5
        corner = CAMERA.project(corners @ R.T + t)
        missed.append(np.linalg.norm(corner[:, None] - inside, axis=2).min(1).max())
    return np.array(missed)


@pytest.mark.parametrize("radius", [37, 39, 40, 41.5, 44])
def test_masks_are_drawn_in_by_what_they_pass_a_silhouette(radius):
    y, x = np.mgrid[:120, :160] + 0.5
    disc = lambda r: np.where(np.hypot(x - 80, y - 60) < r, 255, 0).astype(np.uint8)
    passes = beyond(disc(radius), disc(40))
    assert passes == pytest.approx(radius - 40, abs=0.5)
    area = drawn_in(disc(radius), passes).sum() / 255
    assert np.sqrt(area / np.pi) == pytest.approx(40, abs=0.3)
    assert (drawn_in(disc(radius), 0.0) == disc(radius)).all()
    empty = np.zeros_like(disc(1))
    assert beyond(empty, disc(40)) == 0 and not drawn_in(empty, -3.0).any()


def test_dark_corners_are_kept():
    print_ = dark_corners()
    alone, covers = followed(print_, with_photo=False)
    assert corner_misses(alone)[-1] > 6  # colours alone round them off
    masks, _ = followed(print_, with_photo=True)
    assert corner_misses(masks).max() < 2
    assert min(iou(m, c) for m, c in zip(masks, covers)) > 0.985


@pytest.mark.parametrize("place", [np.s_[100:140, 150:200], np.s_[60:130, 20:110]])
def test_what_hides_the_sheet_is_not_taken_for_it(place):
    """In the middle, where GrabCut sees it as sheet in any case, the photo adds nothing."""
    alone, _ = followed(photo(), with_photo=False, hide=place)
    masks, _ = followed(photo(), with_photo=True, hide=place)
    for a, b in zip(alone, masks):
        added = (b > 0) & (a == 0)
        assert added[place].mean() < 0.03


def test_another_print_tells_nothing():
    """A photo that is not of this sheet changes no mask."""
    sheet = grid(WIDTH, HEIGHT, 33)
    R, t = placed()
    pixels = CAMERA.project(sheet.vertices @ R.T + t)
    registration = Registration(photo(seed=9), sheet.uv, sheet.faces, pixels)
    assert registration.first(rendered(photo(), over=GREY)[0]) is None


def test_the_map_follows_a_bent_sheet():
    """The polynomial takes up a warp that a flat sheet's projection does not have."""
    print_ = photo()
    sheet = grid(WIDTH, HEIGHT, 33)
    R, t = placed()
    pixels = CAMERA.project(sheet.vertices @ R.T + t)
    frame, cover = rendered(print_, over=GREY)
    y, x = np.mgrid[:240, :320].astype(np.float32)
    warp = lambda image, k: cv2.remap(
        image, x + k * 5 * np.sin(x / 60), y + k * 4 * np.sin(x / 50), cv2.INTER_LINEAR
    )
    registration = Registration(print_, sheet.uv, sheet.faces, pixels)
    registration.first(frame)
    for k in (0.25, 0.5, 0.75, 1.0):
        shown = registration.next(warp(frame, k))
    assert iou(shown, warp(cover.astype(np.float32), 1.0)) > 0.97


@pytest.mark.parametrize("border", [0, 2])
def test_a_sheet_that_fills_the_picture_is_its_own_mask(border):
    shown = np.pad(np.full((240 - 2 * border, 320 - 2 * border), 255, np.uint8), border)
    masks, frame = Masks((320, 240)), cv2.resize(photo(), (320, 240))
    assert (masks.first(frame, shown) > 0).mean() > 0.95
    assert (masks.next(frame) > 0).mean() > 0.95
