"""The part of ``python -m polysft_mi.prepare``'s command line that is about videos."""

import contextlib
import sys

import numpy as np

from polysft_mi.errors import InputError


def add_arguments(parser):
    """Add the options."""
    video = parser.add_argument_group("from a video")
    video.add_argument(
        "--texture",
        metavar="PHOTO",
        help="a straight photo of the sheet, from edge to edge; or first-frame, with --corners",
    )
    video.add_argument(
        "--size",
        nargs="+",
        metavar="LENGTH",
        help="width and height as the photo shows them: 0.297 0.210 (metres), 297mm 210mm, or A4",
    )
    video.add_argument(
        "--template",
        metavar="OBJ",
        help="a template that is not flat, instead of --size: metres, with the photo's uv",
    )
    video.add_argument(
        "--corners",
        nargs="+",
        metavar="X,Y",
        help=(
            "the sheet's corners in the first frame [pixels]: top left, top right, bottom right,"
            " bottom left of the print; instead of looking for the photo. Or: frame, where the"
            " sheet fills the picture"
        ),
    )
    video.add_argument(
        "--texture-corners",
        nargs=4,
        metavar="X,Y",
        help="the sheet's corners in the photo [pixels], where it shows more than the sheet",
    )
    video.add_argument(
        "--first",
        type=int,
        default=0,
        metavar="N",
        help="first frame to use, counted from 0; the template is placed in it (default: 0)",
    )
    video.add_argument(
        "--last",
        type=int,
        default=-1,
        metavar="N",
        help="last frame to use, inclusive (default: the end)",
    )
    video.add_argument(
        "--stride", type=int, default=1, metavar="N", help="use every N-th frame (default: 1)"
    )
    video.add_argument(
        "--scale", type=float, default=1.0, metavar="S", help="scale the frames by S (default: 1)"
    )
    masks = video.add_mutually_exclusive_group()
    masks.add_argument(
        "--masks",
        metavar="FOLDER",
        help="masks that are there, one a frame, instead of finding them",
    )
    masks.add_argument("--no-masks", action="store_true", help="go without")
    camera = parser.add_argument_group(
        "the camera of a video (default: what the video or the photo says of itself)"
    ).add_mutually_exclusive_group()
    camera.add_argument(
        "--fov", type=float, metavar="DEG", help="horizontal field of view [degrees]"
    )
    camera.add_argument(
        "--camera",
        metavar="JSON",
        help=(
            "fx, fy, cx, cy, width, height [pixels], and distortion (OpenCV's coefficients) or none"
        ),
    )
    camera.add_argument(
        "--calibrate",
        metavar="VIDEO",
        help="a video, or images, of a chessboard or ChArUco board by the same camera",
    )
    parser.add_argument(
        "--board",
        default="9x6",
        metavar="BOARD",
        help=(
            "its inner corners (default: 9x6), or charuco:7x5:4X4_50:0.75 (squares, dictionary,"
            " marker by square)"
        ),
    )


def _points(words, option):
    """Pixels (N, 2) of words such as ``212,80``."""
    try:
        points = [[float(x) for x in word.split(",")] for word in words]
    except ValueError:
        points = []
    if len(points) != 4 or any(len(p) != 2 for p in points) or not np.isfinite(points).all():
        raise InputError(
            f"{option} {' '.join(words)}: four points x,y in pixels are needed: top left, top"
            " right, bottom right, bottom left"
        )
    return points


def from_video(args, command):
    """Run :func:`polysft_mi.capture.folder.capture` by the parsed arguments; ``command``: how it
    was called. Returns what that returns.
    """
    from .folder import capture

    if args.texture is None:
        raise InputError(
            f"{args.folder}: a video needs --texture photo.jpg, a straight photo of the sheet (or"
            " --texture first-frame, with --corners), and --size"
        )
    corners = (
        args.corners if args.corners in (None, ["frame"]) else _points(args.corners, "--corners")
    )
    quiet = args.quiet or args.json
    with _progress(quiet) as progress:
        return capture(
            args.folder, args.output, texture=args.texture, size=args.size, template=args.template,
            resolution=args.resolution, camera=args.camera, fov=args.fov, calibrate=args.calibrate,
            board=args.board, corners="frame" if corners == ["frame"] else corners,
            texture_corners=args.texture_corners and _points(
                args.texture_corners, "--texture-corners"
            ), pose_fit=args.pose_fit, masks=args.masks or not args.no_masks, first=args.first,
            last=args.last, stride=args.stride, scale=args.scale, overwrite=args.overwrite,
            say=(lambda line: None) if quiet else print, progress=progress, command=command,
        )  # fmt: skip


@contextlib.contextmanager
def _progress(quiet):
    """A function that shows how many frames are done, on a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda count: None
        return
    from rich.console import Console

    with Console(stderr=True).status("reading") as status:
        yield lambda count: status.update(f"{count} frames")
