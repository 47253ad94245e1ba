"""Drapes a garment on a moving body, and writes the arrays, an animation and a rendering of it.

    python -m onefit.drape dress walk -o OUT                   # a template, a generated motion
    python -m onefit.drape shirt.obj motion.npz -o OUT --post  # a mesh, a motion (AMASS, NCS, BVH)
    python -m onefit.drape tshirt dance -o OUT --shape weight=0.7 height=0.6 --skip render

OUT receives

    drape.npz               vertices (T, N, 3) [m, z up], faces, rest, the body's vertices and
                            faces, fps
    figures.json            what was measured
    garment.usd, body.usd   animations that Blender and usdview open
    frames/NNN.png          path-traced by Mitsuba; drape.mp4 is their video
    meshes/NNN.obj          one mesh a frame, with --meshes obj (or ply)
"""

import argparse
import json
import time
import zipfile
from pathlib import Path

import numpy as np

from polyfit.errors import InputError, cli, require
from polyfit.files import aside, folder_aside

GARMENT, BODY = (0.08, 0.19, 0.42), (0.5, 0.48, 0.46)  # colours, linear RGB


def _shape(model, pairs):
    shape = model.standard_shape.clone()
    for pair in pairs:
        name, _, value = pair.partition("=")
        if name not in model.shape_names:
            raise InputError(
                f"--shape {pair}: choose among {', '.join(model.shape_names)}, as in weight=0.6"
            )
        try:
            shape[model.shape_names.index(name)] = float(value)
        except ValueError:
            raise InputError(f"--shape {pair}: a number is needed, as in {name}=0.6") from None
    return shape


def _motion(name, seconds, seed, fps, up):
    from onefit.motion import Motion
    from onefit.motion.generate import KINDS

    if name in KINDS:
        return Motion.generate(name, seconds=seconds, seed=seed)
    if not Path(name).exists():
        raise InputError(
            f"motion {name}: no such file, and no kind of motion; there are {', '.join(KINDS)}"
        )
    return Motion.read(name, fps, up)


def _model(name):
    from onefit.body import AnnyBody, PlainBody, SmplBody

    if name == "anny":
        return AnnyBody()
    if not Path(name).exists():
        raise InputError(f"--body {name}: no such file; anny needs none")
    plain = zipfile.is_zipfile(name) and "blend_weights.npy" in zipfile.ZipFile(name).namelist()
    return PlainBody(name) if plain else SmplBody(name)


def _garment(args):
    from onefit.garment import TEMPLATES, Garment

    if args.garment in TEMPLATES:
        return Garment.template(args.garment)
    return Garment.read(
        args.garment,
        made_for=args.made_for,
        loose=args.loose,
        scale=args.scale,
        up=args.up,
        turn=args.turn,
        offset=tuple(args.offset),
    )


def _render(drape, folder, size, spp, advance):
    """PNG frames and a video; Mitsuba is loaded here alone."""
    from polysft_mi.backend import set_variant

    set_variant()
    import cv2

    from polysft_mi.pictures.video import write_video
    from polysft_mi.render import stage

    parts = [
        (drape.body.numpy(), drape.body_faces.numpy(), BODY),
        (drape.vertices.numpy(), drape.faces.numpy(), GARMENT),
    ]
    frames = folder / "frames"
    frames.mkdir()

    def pictures():
        for k, image in enumerate(stage.render(parts, size=size, spp=spp)):
            cv2.imwrite(str(frames / f"{k:03d}.png"), image[..., ::-1])
            advance()
            yield image

    write_video(folder / "drape.mp4", pictures(), drape.fps)


def write(drape, folder, *, skip=(), meshes=None, size=(480, 360), spp=32, advance=lambda: None):
    """The files of a :class:`onefit.Drape` in the empty ``folder``; ``skip``: any of "usd",
    "render".
    """
    from polyfit.animation import write_frames, write_usd

    folder = Path(folder)
    arrays = {
        name: getattr(drape, name).numpy()
        for name in ("vertices", "faces", "rest", "body", "body_faces", "root")
    }
    with aside(folder / "drape.npz") as temporary:
        np.savez_compressed(temporary, fps=drape.fps, **arrays)
    if "usd" not in skip:
        write_usd(
            folder / "garment.usd",
            arrays["vertices"],
            arrays["faces"],
            fps=drape.fps,
            up="z",
            name="garment",
        )
        write_usd(
            folder / "body.usd",
            arrays["body"],
            arrays["body_faces"],
            fps=drape.fps,
            up="z",
            name="body",
        )
    if meshes:
        write_frames(folder / "meshes", meshes, arrays["vertices"], arrays["faces"], up="z")
    if "render" not in skip:
        _render(drape, folder, size, spp, advance)


def parser():
    p = argparse.ArgumentParser(
        prog="python -m onefit.drape",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "garment",
        metavar="GARMENT",
        help="a template's name, or a mesh (.obj, .ply) around the standard body",
    )
    p.add_argument(
        "motion",
        metavar="MOTION",
        help="a file (AMASS or NCS .npz, .bvh), or a generated kind: walk, run, dance, ...",
    )
    p.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT",
        help="folder of the results; must be empty or new, or --overwrite",
    )
    p.add_argument(
        "--weights",
        default="six-garments",
        help="a network of the package, or a file (default: six-garments)",
    )
    p.add_argument(
        "--body",
        default="anny",
        help="anny, or a file: SMPL (.npz, .pkl) or plain (body.npz) (default: anny)",
    )
    p.add_argument(
        "--shape",
        nargs="*",
        default=[],
        metavar="NAME=VALUE",
        help="the body's shape, e.g. weight=0.7; what is not named is standard",
    )
    group = p.add_argument_group("a garment's mesh that is not in metres around the standard body")
    group.add_argument(
        "--scale", type=float, default=1.0, help="to metres: 0.01 for centimetres (default: 1)"
    )
    group.add_argument(
        "--up", default="z", choices=("z", "y"), help="the axis that points up (default: z)"
    )
    group.add_argument(
        "--turn", type=float, default=0.0, help="about the vertical [degrees] (default: 0)"
    )
    group.add_argument(
        "--offset",
        nargs=3,
        type=float,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"),
        help="to move it by [m]",
    )
    group.add_argument(
        "--made-for",
        choices=("T-pose",),
        help="T-pose: the standard body with its arms stretched out",
    )
    group.add_argument(
        "--loose", action="store_true", help="a skirt or dress: the legs' pose is not followed"
    )
    p.add_argument(
        "--fps", type=float, help="frames a second of a motion file, in place of what it says"
    )
    p.add_argument(
        "--motion-up",
        choices=("y", "z"),
        help="the axis that points up in a motion file, in place of what its kind has",
    )
    p.add_argument("--seconds", type=float, default=3.0, help="of a generated motion (default: 3)")
    p.add_argument("--seed", type=int, default=0, help="of a generated motion (default: 0)")
    p.add_argument("--post", action="store_true", help="push vertices out of the body afterwards")
    p.add_argument(
        "--skip", nargs="*", default=[], choices=("usd", "render"), help="what not to write"
    )
    p.add_argument("--meshes", choices=("obj", "ply"), help="also one mesh a frame")
    p.add_argument(
        "--size",
        nargs=2,
        type=int,
        default=(480, 360),
        metavar=("HEIGHT", "WIDTH"),
        help="of the rendering (default: 480 360)",
    )
    p.add_argument("--spp", type=int, default=32, help="samples a pixel (default: 32)")
    p.add_argument("--device", default="cpu", help="cpu or cuda, for the network (default: cpu)")
    p.add_argument(
        "--overwrite", action="store_true", help="replace what a previous drape left in OUT"
    )
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    require("torch", "anny", *(["pxr"] if "usd" not in args.skip else []))
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from onefit.draping import load
    from polyfit.training import device_of

    folder = Path(args.output)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not args.overwrite:
            raise InputError(f"{folder}: not empty; give another -o, or --overwrite")
        if not (folder / "drape.npz").exists():
            raise InputError(f"{folder}: holds no drape; --overwrite replaces nothing else")
    draper = load(args.weights, model=_model(args.body), device=device_of(args.device))
    garment = _garment(args)
    motion = _motion(args.motion, args.seconds, args.seed, args.fps, args.motion_up)
    shape = _shape(draper.model, args.shape)
    console = Console(stderr=True)
    for repair in garment.repairs:
        console.print(f"{args.garment}: {repair}")
    draper.ease(garment)  # cut and tried on once for all motions, so it does not count
    start = time.perf_counter()
    drape = draper.drape(garment, motion, shape, post=args.post)
    seconds = time.perf_counter() - start
    figures = drape.measures().as_dict()
    T, N = drape.vertices.shape[:2]
    console.print(
        f"{N} vertices in {T} frames: {1e3 * seconds / T:.1f} ms a frame,"
        f" {figures['collision']:.2f} % of the vertices inside the body"
    )
    about = dict(
        garment=args.garment,
        motion=motion.name,
        weights=args.weights,
        shape=shape.tolist(),
        post=args.post,
        vertices=N,
        frames=T,
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with (
        Progress(*columns, console=console) as progress,
        folder_aside(folder, lambda name: True) as temporary,
    ):
        task = progress.add_task("rendering", total=T, visible="render" not in args.skip)
        write(
            drape,
            temporary,
            skip=args.skip,
            meshes=args.meshes,
            size=args.size,
            spp=args.spp,
            advance=lambda: progress.advance(task),
        )
        (Path(temporary) / "figures.json").write_text(
            json.dumps(about | figures, indent=2) + "\n", encoding="utf-8"
        )
    print(folder)


if __name__ == "__main__":
    cli(main)
