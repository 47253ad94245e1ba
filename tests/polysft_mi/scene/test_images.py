"""Image files that are broken: refused in one line, and no library adds one of its own."""

import cv2
import numpy as np
import pytest
import synthetic

from polysft_mi.capture import prepare_folder
from polysft_mi.errors import InputError
from polysft_mi.scene.images import checked_size, read_rgb


def broken(kind, how):
    """Bytes of an image file of 64x64 pixels that is cut off, or damaged."""
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    data = cv2.imencode(kind, image.astype(np.float32) if kind == ".hdr" else image)[1].tobytes()
    junk = np.random.default_rng(1).bytes(len(data))
    return {
        "cut": data[: len(data) // 2],
        "header only": data[:12],
        "header and noise": data[:8] + junk[8:],
        "damaged": data[:60] + b"\xff" * 200 + data[260:],
    }[how]


@pytest.mark.parametrize("kind", [".png", ".jpg", ".tiff", ".bmp", ".ppm", ".hdr", ".webp"])
@pytest.mark.parametrize("how", ["cut", "header only", "header and noise", "damaged"])
def test_broken_images_are_told_in_one_line(kind, how, tmp_path, capfd):
    path = tmp_path / f"a{kind}"
    path.write_bytes(broken(kind, how))
    raw = kind in (".bmp", ".ppm")  # any pixels are a picture
    for read in (checked_size, read_rgb):
        if how == "damaged" and raw:
            read(str(path))
            continue
        with pytest.raises(InputError, match="not a readable image") as caught:
            read(str(path))
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_stderr_is_whole_again(tmp_path, capfd):
    (tmp_path / "a.png").write_bytes(broken(".png", "cut"))
    with pytest.raises(InputError):
        read_rgb(str(tmp_path / "a.png"))
    import os

    os.write(2, b"still heard\n")
    assert capfd.readouterr().err == "still heard\n"


@pytest.mark.parametrize("how", ["cut", "header only"])
def test_broken_texture(how, tmp_path, capfd):
    """By the preparation, and by the loader of a scene that was prepared before it broke."""
    from polysft_mi.scene import load

    folder = synthetic.cloth(tmp_path / "data", frames=1).folder
    scene, _ = prepare_folder(str(folder))
    (folder / "texture.png").write_bytes(broken(".png", how))
    for act in (lambda: prepare_folder(str(folder), overwrite=True), lambda: load(scene)):
        with pytest.raises(InputError, match="texture.png: not a readable image") as caught:
            act()
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")
