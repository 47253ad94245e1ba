"""What a video prepared by ``python -m polysft_mi.prepare`` is worth, and what it costs.

    python benchmarks/prepare.py [--data FOLDER] [--only pose masks corners time] [-o
    out/benchmarks/prepare]

``pose``: Kinect-Paper's frames 1 to 60, encoded as a video, prepared by the rectified print of
frame 1 and K, without masks, and run; beside it the run from the given pose. Figures are those of
``python -m polysft_mi.evaluate`` on the ground-truth frames among them. ``masks``: intersection
over union of found and given masks. ``corners``: a sheet that bends before dark grey, its print
dark at the corners: how far the masks and the run's surface miss the corners. ``time``: seconds to
prepare 200 frames of 640x480, start-up included. Prints one line a figure, and writes
``prepare.json``.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time

import cv2
import numpy as np
from sequences import DATA, ROOT

from polyfit.pictures import write_video
from polysft_mi.camera import Intrinsics
from polysft_mi.capture import iou
from polysft_mi.capture.pictures import photo_on_frame
from polysft_mi.capture.sheet import grid
from polysft_mi.errors import InputError, cli
from polysft_mi.results.evaluation import evaluate
from polysft_mi.scene import kinect_paper
from polysft_mi.scene.images import list_images, read_rgb
from polysft_mi.scene.sequence import drop_stray_components
from polysft_mi.surface import meshio

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


def prepare_kinect(data, out, frames, target, *options):
    """Prepare the first ``frames`` of Kinect-Paper in the folder ``target``; seconds it took."""
    video, photo, camera = kinect_inputs(data, out, frames)
    words = [video, "--texture", photo, "--size", *PRINT, "--camera", camera, "-o", target]
    return python("-m", "polysft_mi.prepare", *words, "--overwrite", *options)


def measure_pose(data, out):
    prepare_kinect(data, out, FRAMES, f"{out}/kinect", "--no-masks")
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


def dark_print(size=(1188, 840)):
    """Coloured noise (H, W, 3) uint8 RGB, dark grey with little detail at its corners."""
    random, (w, h) = np.random.default_rng(5), size
    image = np.zeros((h, w, 3), np.float32)
    for cell, share in ((110, 0.5), (40, 0.3), (12, 0.2)):
        grains = random.random((h // cell + 2, w // cell + 2, 3)).astype(np.float32)
        image += share * cv2.resize(grains, (w, h), interpolation=cv2.INTER_CUBIC)
    image = (image - image.min()) / np.ptp(image)
    image = np.clip(1.6 * image - 0.3, 0, 1) * 235 + 10
    y, x = np.mgrid[:h, :w]
    for corner in ((0, 0), (0, w - 1), (h - 1, 0), (h - 1, w - 1)):
        dark = np.clip(1.6 - np.hypot(y - corner[0], x - corner[1]) / 110, 0, 1)[..., None]
        image = (1 - dark) * image + dark * (38 + 0.12 * image)
    return image.astype(np.uint8)


def bending(uv, t):
    """Points (N, 3) [m, camera frame] of an A4 sheet, that bends about a slanted axis, at places
    uv (N, 2), at the time t from 0 to 1."""
    c, s = np.cos(0.35), np.sin(0.35)
    flat = np.column_stack([(uv[:, 0] - 0.5) * 0.297, (0.5 - uv[:, 1]) * 0.21])
    u, v = (flat @ np.array([[c, -s], [s, c]])).T
    k = 0.2 + 5 * t  # 1/m
    bent = np.stack([np.sin(k * u) / k, v, (1 - np.cos(k * u)) / k], axis=-1)
    points = bent @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    turn = cv2.Rodrigues(np.array([0.35 - 0.1 * t, -0.3 + 0.25 * t, 0.1]))[0]
    return points @ turn.T + (0.01 + 0.02 * t, 0.005, 0.55)


def bending_frames(photo, camera, count, finer=3):
    """Frames of the sheet before dark grey, with a camera's noise."""
    mesh, random = grid(0.297, 0.21, 65), np.random.default_rng(0)
    fine = Intrinsics(*(finer * x for x in dataclasses.astuple(camera)))
    for k in range(count):
        dark = np.full((fine.height, fine.width, 3), 45, np.uint8)
        frame = photo_on_frame(dark, photo, mesh, bending(mesh.uv, k / (count - 1)), fine)
        frame = cv2.resize(frame, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        noisy = frame + random.normal(0, 2, frame.shape)
        yield np.clip(noisy, 0, 255).astype(np.uint8)


def measure_corners(data, out):
    count, camera, photo = 30, Intrinsics(600.0, 600.0, 320.0, 240.0, 640, 480), dark_print()
    clip, print_, target = (f"{out}/{name}" for name in ("corners.mp4", "dark.jpg", "corners"))
    write_video(clip, bending_frames(photo, camera, count))
    cv2.imwrite(print_, photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    with open(f"{out}/corners.json", "w", encoding="utf-8") as file:
        json.dump(dataclasses.asdict(camera), file)
    words = ["--texture", print_, "--size", "A4", "--camera", f"{out}/corners.json"]
    python("-m", "polysft_mi.prepare", clip, *words, "-o", target, "--overwrite")
    python("-m", "polysft_mi.run", f"{target}/scene.xml", "-o", f"{out}/corners_run", "--overwrite")
    corners = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
    misses = []
    for k, path in enumerate(list_images(f"{target}/masks")):
        seen = np.argwhere(read_rgb(path)[..., 0] > 127)[:, ::-1] + 0.5
        at = camera.project(bending(corners, k / (count - 1)))
        misses.append(np.linalg.norm(at[:, None] - seen, axis=2).min(1).max())
    found = np.load(f"{out}/corners_run/surface.npz")
    uv = found["uv"]
    true = np.stack([bending(uv, k / (count - 1)) for k in range(count)])
    error = 1e3 * np.linalg.norm(found["vertices"] - true, axis=2)
    off = np.abs(uv - 0.5)
    rms = lambda vertices: float(np.sqrt((error[:, vertices] ** 2).mean()))
    result = {
        "mask_misses_corner_px": float(np.max(misses)),
        "inside_rms_mm": rms(off.max(1) < 0.4),
        "corners_rms_mm": rms(off.min(1) > 0.42),
    }
    print("corners", json.dumps(result))
    return result


def measure_time(data, out):
    seconds = prepare_kinect(data, out, TIMED, f"{out}/timed")
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
        choices=("pose", "masks", "corners", "time"),
        default=("pose", "masks", "corners", "time"),
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
    measures = {
        "pose": measure_pose,
        "masks": measure_masks,
        "corners": measure_corners,
        "time": measure_time,
    }
    result = {
        name: measures[name](os.path.abspath(args.data), os.path.abspath(args.output))
        for name in args.only
    }
    with open(os.path.join(args.output, "prepare.json"), "w", encoding="utf-8") as file:
        json.dump(result, file, indent=1)


if __name__ == "__main__":
    cli(main)
