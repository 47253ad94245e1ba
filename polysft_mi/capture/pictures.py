"""Pictures of what each step of the preparation found, for a person to look at: (H, W, 3) uint8 RGB
images.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from polyfit.mesh import loops

GREEN, _RED, _YELLOW, _BLUE = (60, 220, 90), (235, 70, 60), (255, 210, 40), (60, 120, 250)


def shrunk(image, side):
    """(image whose longer side is at most ``side`` pixels, what it was scaled by)."""
    scale = min(1.0, side / max(image.shape[:2]))
    return (
        cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else image.copy()
    ), scale


def _canvas(image):
    """(image of 480 rows, enlarged where it has fewer, what it was scaled by)."""
    scale = 480 / image.shape[0]
    return (
        cv2.resize(
            image,
            None,
            fx=scale,
            fy=scale,
            interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC,
        ),
        scale,
    )


def contact_sheet(cells, columns=4, side=320):
    """Pictures in rows of ``columns``, each with its caption: ``cells`` are (caption, image);
    ``side`` [pixels]: the longer side of each picture.
    """
    drawn = []
    for caption, image in cells:
        cell, _ = shrunk(image, side)
        label(cell, caption)
        drawn.append(cell)
    height, width = (max(cell.shape[k] for cell in drawn) for k in (0, 1))
    columns = min(columns, len(drawn))
    rows = -(-len(drawn) // columns)
    sheet = np.full((rows * (height + 4) - 4, columns * (width + 4) - 4, 3), 255, np.uint8)
    for k, cell in enumerate(drawn):
        y, x = k // columns * (height + 4), k % columns * (width + 4)
        sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


def evenly_spaced(count, most=12):
    """Indices of at most ``most`` of ``count`` things, evenly spread, the first and the last among
    them.
    """
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, most))})


def masked(image, mask):
    """An image whose part outside of the mask is dark, the border drawn."""
    shown = np.where(mask[..., None] > 127, image, image // 3)
    outline, _ = cv2.findContours(
        (mask > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
    )
    return cv2.drawContours(
        np.ascontiguousarray(shown), outline, -1, _YELLOW, max(1, round(max(image.shape[:2]) / 320))
    )


def matches(photo, frame, found, most=60):
    """Photo and frame side by side, :class:`polysft_mi.capture.sheet.Matches` as lines: green where
    they agree, red where not, at most ``most`` of each.
    """
    (left, _), (right, b) = _canvas(photo), _canvas(frame)
    canvas = np.hstack(
        [left // 2 + 64, np.full((left.shape[0], 8, 3), 255, np.uint8), right // 2 + 64]
    )
    at = np.column_stack([found.photo[:, 0], 1 - found.photo[:, 1]]) * left.shape[1::-1]
    to = found.frame * b + (left.shape[1] + 8, 0)
    for agree, colour in ((False, _RED), (True, GREEN)):
        lines = np.flatnonzero(found.agree == agree)
        for k in lines[:: max(1, len(lines) // most)]:
            p, q = (tuple(round(v) for v in x) for x in (at[k], to[k]))
            cv2.line(canvas, p, q, colour, 1, cv2.LINE_AA)
            for x in (p, q):
                cv2.circle(canvas, x, 3, colour, 1, cv2.LINE_AA)
    label(
        canvas,
        f"{len(found.agree)} features of the photo found in the frame, {int(found.agree.sum())}"
        " agree on one pose (green)",
    )
    return canvas


def pose(frame, photo, sheet, placed, camera, known=None):
    """Pictures of the first frame, side by side: the template's mesh and border drawn on it; the
    photo laid on it where the template is; and what is :class:`Known` beside the image, on the
    first one, with a third one for depth.
    """
    wired, scale = _canvas(frame)
    vertices, faces, _ = sheet.mesh(placed)  # a seam is no border
    plain, x = wired.copy(), camera.project(vertices)

    def draw(edges, colour, width):
        for edge in edges:
            a, b = (tuple(round(v) for v in np.clip(x[k] * scale, -1e4, 1e4)) for k in edge)
            cv2.line(wired, a, b, colour, width, cv2.LINE_AA)

    edges = np.sort(
        np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]),
        axis=1,
    )
    draw(np.unique(edges, axis=0), GREEN, 1)
    wired = cv2.addWeighted(plain, 0.7, wired, 0.3, 0)  # what is printed shows through
    for loop in loops(faces):
        draw(np.stack([loop, np.roll(loop, -1)], axis=1), _YELLOW, 2)
    said = "the template in the first frame"
    if known is not None:
        said += known.draw(wired, scale)
    label(wired, said)
    beside, _ = _canvas(photo_on_frame(frame, photo, sheet, placed, camera))
    label(beside, "the photo, placed on the template")
    shown = [wired, beside]
    if known is not None and known.depth is not None:
        shown.append(_canvas(known.depth_beside(sheet, placed, camera))[0])
        label(shown[-1], f"the depth image less the template: 0 grey, {known.PEAK} mm behind red")
    gap = np.full((wired.shape[0], 4, 3), 255, np.uint8)
    return np.hstack([shown[0], *(part for image in shown[1:] for part in (gap, image))])


@dataclass(frozen=True)
class Known:
    """What is known of the first frame beside its image: the ``mask`` (H, W) in [0, 1], places of
    ``tracks`` (P, 2) [pixels] and ``depth`` (H, W) [m], 0 for unknown; or None.
    """

    mask: np.ndarray | None = None
    tracks: np.ndarray | None = None
    depth: np.ndarray | None = None

    PEAK = 30  # [mm] that is the strongest colour of a difference in depth

    def draw(self, image, scale):
        """Draw the mask's border and the tracks into a picture that is ``scale`` times as large;
        returns what is to be said of them.
        """
        said = ""
        if self.mask is not None:
            inside = cv2.resize(self.mask, image.shape[1::-1], interpolation=cv2.INTER_LINEAR) > 0.5
            how = cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
            border, _ = cv2.findContours(inside.astype(np.uint8), *how)
            cv2.drawContours(image, border, -1, _RED, 1, cv2.LINE_AA)
            said += ", the mask's border (red)"
        if self.tracks is not None:
            for place in self.tracks * scale:
                cv2.circle(image, tuple(round(v) for v in place), 3, _BLUE, -1, cv2.LINE_AA)
            said += ", tracks (blue)"
        return said

    def depth_beside(self, sheet, placed, camera):
        """How far the depth image lies behind the template (red) or before it (blue), which the
        ``camera`` sees of the ``sheet`` with vertices ``placed`` (N, 3) [m, camera frame]; black
        where one of them is unknown.
        """
        from polyfit.pictures import Triangles

        (own,) = Triangles(placed, sheet.faces).seen(camera)
        known = (self.depth > 0) & np.isfinite(own)
        share = np.clip((self.depth - np.where(known, own, 0)) / (1e-3 * self.PEAK), -1, 1)
        grey, end = np.array((190.0,) * 3), np.where(share[..., None] > 0, _RED, _BLUE)
        shown = grey + np.abs(share[..., None]) * (end - grey)
        return np.where(known[..., None], np.round(shown), 0).astype(np.uint8)


def photo_on_frame(frame, photo, sheet, placed, camera):
    """The frame (H, W, 3), and on it the photo where the camera sees it on the sheet, whose
    vertices are ``placed`` (N, 3) [m, camera frame].
    """
    from polyfit.pictures import Triangles

    _, u, v = Triangles(placed, sheet.faces).seen(camera, sheet.uv.T)
    if sheet.uv.min() < -1e-3 or sheet.uv.max() > 1.001:  # tiles of a photo that repeats
        u, v = u % 1, v % 1
    rows, columns = np.nonzero(np.isfinite(u))
    extent = max(np.ptp(rows), np.ptp(columns)) if len(rows) else 1
    side = max(1.0, max(photo.shape[:2]) / max(extent, 1))
    photo = (
        cv2.resize(photo, None, fx=1 / side, fy=1 / side, interpolation=cv2.INTER_AREA)
        if side > 1
        else photo
    )
    maps = np.stack([u * photo.shape[1] - 0.5, (1 - v) * photo.shape[0] - 0.5], axis=-1)
    maps = np.nan_to_num(maps, nan=-1).astype(np.float32)
    colours = cv2.remap(
        photo, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.where(np.isfinite(u)[..., None], colours, frame)


def label(image, text):
    """Write a line at the top left, in place."""
    scale = 0.45 if image.shape[1] < 500 else 0.6
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    cv2.rectangle(image, (0, 0), (width + 8, height + 10), (0, 0, 0), -1)
    cv2.putText(
        image,
        text,
        (4, height + 5),
        cv2.FONT_HERSHEY_SIMPLEX,
        scale,
        (255, 255, 255),
        1,
        cv2.LINE_AA,
    )
