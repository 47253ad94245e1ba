"""What a video prepared by ``python -m polysft_mi.prepare`` is worth, and what it costs.

    python benchmarks/prepare.py [--data FOLDER] [--only pose masks time] [-o
    out/benchmarks/prepare]

``pose``: Kinect-Paper's frames 1 to 60, encoded as a video, prepared by the rectified print of
frame 1 and K, without masks, and run; beside it the run from the given pose. Figures are those of
``python -m polysft_mi.evaluate`` on the ground-truth frames among them. ``masks``: intersection
over union of found and given masks. ``time``: seconds to prepare 200 frames of 640x480, start-up
included. Prints one line a figure, and writes ``prepare.json``.
"""

import argparse
import json
import os
import subprocess
import sys
import time

import cv2
import numpy as np

from polysft_mi.capture import iou
from polysft_mi.errors import InputError, cli
from polysft_mi.pictures.video import write_video
from polysft_mi.results.evaluation import evaluate
from polysft_mi.scene import kinect_paper
from polysft_mi.scene.images import list_images, read_rgb
from polysft_mi.scene.sequence import drop_stray_components
from polysft_mi.surface import meshio

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))

DATA = os.environ.get("POLYSFT_DATA") or os.path.join(os.path.dirname(ROOT), "shared", "data")
FRAMES = 60
PRINT = 0.2975, 0.252  # m, the printed area that Kinect-Paper's template covers
DENSITY = 2000  # pixels a metre of the rectified print, about twice the frame's
TIMED = 200


def python(*arguments):
    """Run ``python ARGUMENTS`` in the repository; seconds it took. Raises InputError with what it
    said where it fails.
    """
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode:
        raise InputError(
            f"{' '.join(map(str, arguments))}:"
            f" {(done.stderr.strip() or done.stdout).splitlines()[-1]}"
        )
    return time.perf_counter() - began


def rectified_print(folder):
    """The print of frame 1 as a photo straight from the front would show it, (H, W, 3) uint8 RGB,
    by the pose that the folder gives.
    """
    vertices, _, _ = kinect_paper.template(folder, 2)
    corners = kinect_paper.camera(folder).project(vertices)[
        [2, 3, 1, 0]
    ]  # the template's first row is the print's lowest
    width, height = (round(DENSITY * side) for side in PRINT)
    H = cv2.getPerspectiveTransform(
        np.float32(corners - 0.5),
        np.float32([(0, 0), (width, 0), (width, height), (0, height)]) - np.float32(0.5),
    )
    return cv2.warpPerspective(
        read_rgb(kinect_paper.images(folder)[0]), H, (width, height), flags=cv2.INTER_CUBIC
    )


def write_camera(folder, path):
    """K of Kinect-Paper as a camera file."""
    c = kinect_paper.camera(folder)
    with open(path, "w", encoding="utf-8") as file:
        json.dump({k: getattr(c, k) for k in ("fx", "fy", "cx", "cy", "width", "height")}, file)


def kinect_inputs(data, out, count):
    """(video, photo, camera file) of ``count`` frames of Kinect-Paper, forwards and backwards again
    where it has fewer; the video as H.264."""
    folder = os.path.join(data, "kinect_paper")
    paths = kinect_paper.images(folder)
    paths = (paths + paths[::-1])[:count]
    video, photo, camera = (
        os.path.join(out, name) for name in (f"kinect_{count}.mp4", "print.png", "camera.json")
    )
    write_video(video, (read_rgb(p) for p in paths))
    cv2.imwrite(photo, rectified_print(folder)[..., ::-1])
    write_camera(folder, camera)
    return video, photo, camera


def measure_pose(data, out):
    video, photo, camera = kinect_inputs(data, out, FRAMES)
    size = [f"{side:g}" for side in PRINT]
    python(
        "-m",
        "polysft_mi.prepare",
        video,
        "--texture",
        photo,
        "--size",
        *size,
        "--camera",
        camera,
        "--no-masks",
        "-o",
        f"{out}/kinect",
        "--overwrite",
    )
    python(
        "-m",
        "polysft_mi.run",
        f"{out}/kinect/scene.xml",
        "-o",
        f"{out}/kinect_run",
        "--overwrite",
        "-q",
    )
    given = os.path.join(ROOT, "scenes", "kinect_paper.xml")
    folder = os.path.join(data, "kinect_paper")
    python(
        "-m",
        "polysft_mi.run",
        given,
        "-D",
        f"data={os.path.abspath(folder)}",
        "-D",
        f"last={FRAMES - 1}",
        "-o",
        f"{out}/kinect_given",
        "--overwrite",
        "-q",
    )
    result = {}
    for name in ("kinect_run", "kinect_given"):
        figures = evaluate(f"{out}/{name}", folder)
        result[name] = {
            k: figures[k]
            for k in ("depth_rmse_mm", "depth_rmse_mm_worst", "depth_rmse_allpix_mm")
            if k in figures
        }
        print(name, json.dumps(result[name]))
    return result


def upright(folder, out):
    """Texture and template of phi_sft_R1 with the texture upright: the sequence has it, and v,
    upside down, which is a mirror image of what the camera saw."""
    photo, template = os.path.join(out, "phi_texture.png"), os.path.join(out, "phi_template.obj")
    cv2.imwrite(photo, cv2.imread(os.path.join(folder, "texture.png"))[::-1])
    vertices, faces, uv = meshio.read_template(os.path.join(folder, "0_R1_quad.obj"))
    meshio.write_obj(template, vertices, faces, np.column_stack([uv[:, 0], 1 - uv[:, 1]]))
    return photo, template


def measure_masks(data, out):
    result = {}
    for name in ("cloth/flag", "phi_sft_R1"):
        folder = os.path.join(data, name)
        frames = os.path.join(folder, "frames" if name == "cloth/flag" else "rgbs")
        photo, template = (
            (os.path.join(folder, n) for n in ("texture.png", "template.obj"))
            if name == "cloth/flag"
            else upright(folder, out)
        )
        target = os.path.join(out, "masks_" + os.path.basename(name))
        camera = os.path.join(folder, "camera.json")
        seconds = python(
            "-m",
            "polysft_mi.prepare",
            frames,
            "--texture",
            photo,
            "--template",
            template,
            "--camera",
            camera,
            "-o",
            target,
            "--overwrite",
        )
        if not os.path.isdir(f"{target}/masks"):
            raise InputError(f"{name}: no masks were found that could be believed")
        pairs = zip(
            list_images(f"{target}/masks"), list_images(os.path.join(folder, "masks")), strict=True
        )
        values = [
            iou(read_rgb(a)[..., 0], drop_stray_components(read_rgb(b).max(axis=2)))
            for a, b in pairs
        ]
        result[name] = {
            "iou_mean": float(np.mean(values)),
            "iou_worst": float(np.min(values)),
            "frames": len(values),
            "seconds": seconds,
        }
        print(name, json.dumps(result[name]))
    return result


def measure_time(data, out):
    video, photo, camera = kinect_inputs(data, out, TIMED)
    seconds = python(
        "-m",
        "polysft_mi.prepare",
        video,
        "--texture",
        photo,
        "--size",
        *map(str, PRINT),
        "--camera",
        camera,
        "-o",
        f"{out}/timed",
        "--overwrite",
    )
    print(f"time: {TIMED} frames of 640x480, with masks: {seconds:.1f} s")
    return {"frames": TIMED, "seconds": seconds}


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", default=DATA, help="folder with kinect_paper, phi_sft_R1 and cloth"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=("pose", "masks", "time"),
        default=("pose", "masks", "time"),
        help="what to measure (default: all)",
    )
    parser.add_argument(
        "-o",
        "--output",
        default=os.path.join(ROOT, "out", "benchmarks", "prepare"),
        help="where videos, folders and runs go",
    )
    args = parser.parse_args(argv)
    os.makedirs(args.output, exist_ok=True)
    measures = {"pose": measure_pose, "masks": measure_masks, "time": measure_time}
    result = {
        name: measures[name](os.path.abspath(args.data), os.path.abspath(args.output))
        for name in args.only
    }
    with open(os.path.join(args.output, "prepare.json"), "w", encoding="utf-8") as file:
        json.dump(result, file, indent=1)


if __name__ == "__main__":
    cli(main)
