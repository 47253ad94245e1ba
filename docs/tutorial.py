"""Make the pictures of ``docs/tutorial.md``: ``python docs/tutorial.py`` (a minute or two).

The demo's frames become a video, which is prepared and run by the tutorial's own commands, into
``out/tutorial``; the pictures go into ``docs``. With ``--inputs``: the video and the photo alone.
"""

import argparse
import os
import re
import shlex
import subprocess
import sys

import cv2
import numpy as np

from polyfit.pictures import write_video
from polysft_mi.capture import Sheet
from polysft_mi.scene.images import list_images, read_rgb
from polysft_mi.surface import meshio

HERE = os.path.dirname(os.path.abspath(__file__))
ROOT = os.path.dirname(HERE)

OUT = "out/tutorial"
FRAMES = 12  # of the demo
PICTURES = {  # from: (to, pixels it is wide)
    f"{OUT}/clip/prepare/matches.png": ("tutorial_matches.jpg", 900),
    f"{OUT}/clip/prepare/pose.png": ("tutorial_pose.jpg", 644),
    f"{OUT}/clip/prepare/masks.png": ("tutorial_masks.jpg", 900),
    f"{OUT}/run/comparison.png": ("tutorial_comparison.jpg", 900),
}


def commands():
    """The tutorial's command lines, as lists, in its order: those that begin with ``python -m
    polysft_mi.`` and write into OUT.
    """
    with open(os.path.join(HERE, "tutorial.md"), encoding="utf-8") as file:
        lines = re.findall(rf"^    (python -m polysft_mi\..*{OUT}.*)$", file.read(), re.M)
    return [shlex.split(line) for line in lines]


def write_inputs(out):
    """The video and the photo that the tutorial starts from, in the folder ``out``: the first
    FRAMES of the demo's frames."""
    os.makedirs(out, exist_ok=True)
    demo = os.path.join(ROOT, "scenes", "demo")
    write_video(
        os.path.join(out, "clip.mp4"),
        (read_rgb(p) for p in list_images(os.path.join(demo, "frames"))[:FRAMES]),
        fps=8,
    )
    photo = cv2.imread(
        os.path.join(demo, "texture.jpg")
    )  # a square: the sheet is 0.3 m wide and 0.225 m high
    cv2.imwrite(
        os.path.join(out, "photo.jpg"),
        cv2.resize(photo, (800, 600), interpolation=cv2.INTER_AREA),
        [cv2.IMWRITE_JPEG_QUALITY, 95],
    )


def errors():
    """Distances [mm] (T, N) of the run's vertices from the demo's true surface, at the same places
    of the photo.
    """
    truth = np.load(os.path.join(ROOT, "scenes", "demo", "gt.npz"))["vertices"]
    _, faces, uv = meshio.read_template(os.path.join(ROOT, "scenes", "demo", "template.obj"))
    found = np.load(os.path.join(ROOT, OUT, "run", "surface.npz"))
    true = [
        Sheet(v, faces, uv, "demo").at(found["uv"].clip(1e-6, 1 - 1e-6))
        for v in truth[found["frames"]]
    ]
    return 1e3 * np.linalg.norm(found["vertices"] - np.stack(true), axis=2)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", action="store_true", help="the video and the photo alone")
    options = parser.parse_args()
    os.chdir(ROOT)
    write_inputs(OUT)
    if options.inputs:
        return
    for words in commands():
        print(shlex.join(words), flush=True)
        subprocess.run(
            [sys.executable, *words[1:], *(["--overwrite"] if "-o" in words else [])], check=True
        )
    for source, (name, width) in PICTURES.items():
        image = cv2.imread(source)
        scale = min(1.0, width / image.shape[1])
        cv2.imwrite(
            os.path.join(HERE, name),
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA),
            [cv2.IMWRITE_JPEG_QUALITY, 85],
        )
    e = errors()
    print(
        f"half of its vertices lie within {np.median(e):.1f} mm of it, nine tenths within"
        f" {np.quantile(e, 0.9):.1f} mm"
    )


if __name__ == "__main__":
    main()
