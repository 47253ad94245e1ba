"""A video with its photo and camera file, made once for all tests of the preparation."""

import json

import pytest
from clips import CAMERA, photo, rendered, write_png

from polyfit.pictures import write_video


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """(video, photo, camera file, coverages) in a folder whose name has spaces and letters that are
    not ASCII.
    """
    folder = tmp_path_factory.mktemp("a") / "vidéo 紙 &1"
    folder.mkdir()
    print_ = photo()
    made = [rendered(print_, k / 11) for k in range(12)]
    video = write_video(folder / "my clip.mp4", [image for image, _ in made])
    (folder / "camera.json").write_text(
        json.dumps({k: getattr(CAMERA, k) for k in ("fx", "fy", "cx", "cy", "width", "height")})
    )
    return (
        video,
        write_png(folder / "my photo.png", print_),
        str(folder / "camera.json"),
        [cover for _, cover in made],
    )
