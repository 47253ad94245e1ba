"""Videos of a flat print whose pose is known, and what the tests of the preparation share."""

import cv2
import numpy as np
import pytest
from places import ROOT

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError

DEMO = ROOT / "scenes" / "demo"
CAMERA = Intrinsics(330.0, 330.0, 162.0, 117.0, 320, 240)
WIDTH, HEIGHT = 0.297, 0.21


def refused(function, *arguments, **options):
    with pytest.raises(InputError) as caught:
        function(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def photo(seed=1, size=(594, 420)):
    """A print with detail everywhere (H, W, 3) uint8, bright against the background of
    :func:`clip`.
    """
    rng = np.random.default_rng(seed)
    image = np.full((size[1], size[0], 3), 235, np.uint8)
    for _ in range(220):
        centre, radius = rng.integers(0, size), int(rng.integers(6, 26))
        colour = tuple(int(c) for c in rng.integers(90, 250, 3))
        corner = tuple(int(c) for c in centre + rng.integers(5, 40, 2))
        (
            cv2.circle(image, tuple(int(c) for c in centre), radius, colour, -1)
            if rng.random() < 0.5
            else cv2.rectangle(image, tuple(int(c) for c in centre), corner, colour, -1)
        )
    return image


def background(size=(320, 240)):
    noise = (
        np.random.default_rng(7).integers(0, 90, (size[1] // 8, size[0] // 8, 3)).astype(np.uint8)
    )
    return cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)


def placed(t=0.0):
    """(R, t) of the flat sheet at the time t in [0, 1]."""
    R = cv2.Rodrigues(np.array([0.35 - 0.1 * t, -0.3 + 0.2 * t, 0.1]))[0]
    return R, np.array([0.01 + 0.03 * t, 0.005, 0.55])


def rendered(print_, t=0.0, camera=CAMERA, over=None):
    """(image (H, W, 3) uint8, coverage (H, W) in [0, 1]) of the flat print."""
    R, shift = placed(t)
    h, w = print_.shape[:2]
    to_sheet = np.array([[WIDTH / w, 0, -WIDTH / 2], [0, HEIGHT / h, -HEIGHT / 2], [0, 0, 1]])
    H = camera.matrix() @ np.column_stack([R[:, :2], shift]) @ to_sheet
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    over = background((camera.width, camera.height)) if over is None else over
    fine = np.diag([4.0, 4.0, 1.0])  # supersampled
    H, size = np.linalg.inv(half) @ fine @ H @ half, (4 * camera.width, 4 * camera.height)
    small = lambda x: cv2.resize(x, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    colour = small(cv2.warpPerspective(print_, H, size, flags=cv2.INTER_LINEAR).astype(np.float32))
    cover = small(cv2.warpPerspective(np.ones((h, w), np.float32), H, size))
    return np.round(np.clip(colour + over * (1 - cover[..., None]), 0, 255)).astype(np.uint8), cover


def write_png(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(
        ".png", rgb[..., ::-1] if rgb.ndim == 3 and rgb.shape[2] == 3 else rgb
    )
    assert done
    path.write_bytes(data.tobytes())
    return str(path)


def given(clip, **options):
    return {"texture": clip[1], "size": ["297mm", "210mm"], "camera": clip[2], **options}
