"""``python -m polysft_mi.prepare``: a sequence's folder from a video and a photo, or the scene file
of a folder that is there.
"""

import contextlib
import json
import os
import shlex
import sys

import numpy as np

from . import commands
from .errors import InputError, cli

_EXAMPLES = [
    ("FOLDER", "a folder in a known form: writes FOLDER/scene.xml"),
    (
        "clip.mp4 --texture photo.jpg --size 297mm 210mm --fov 65 -o OUT",
        "a video of a printed sheet, and a straight photo of the sheet alone; then look at"
        " OUT/prepare, and: polysft run OUT/scene.xml",
    ),
    (
        "clip.mp4 --texture photo.jpg --size A4 --calibrate chessboard.mp4 --board 9x6 -o OUT",
        "the camera from a video of a chessboard",
    ),
    (
        "clip.mp4 --texture first-frame --corners 212,80 431,95 420,260 200,241 --size A4 --fov"
        " 65 -o OUT",
        "no photo: the first frame is the texture, and the sheet's corners in it are given",
    ),
    (
        "left.mp4 --texture photo.jpg --size A4 --cameras rig/transforms.json --camera-name left"
        " --rig-scale 0.35 -o OUT",
        "several cameras at once, calibrated by COLMAP or nerfstudio",
    ),
    (
        "clip.mp4 --texture photo.jpg --size A4 --fov 65 --first 30 --last 229 --scale 0.5"
        " --no-masks -o OUT",
        "a part of a video, at half its size, and without masks",
    ),
]
_OF_VIDEO = (
    "size template corners texture_corners first last stride scale masks no_masks inset board fov"
    " camera calibrate"
)


def parser():
    """The command line's parser."""
    from .capture import FORMS

    p = commands.parser(
        "prepare",
        "Make a sequence's folder, with its scene file, from a video and a photo of the sheet; or"
        f" write the scene file of a folder in one of the forms {FORMS}.",
        _EXAMPLES,
    )
    p.add_argument(
        "folder",
        metavar="FOLDER|VIDEO",
        help="a sequence's folder; or a video, a folder of images, or a pattern of images",
    )
    p.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        help="the folder to write (default: FOLDER; for a video, its name without the extension)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace an existing folder or scene")
    p.add_argument(
        "--resolution",
        type=int,
        metavar="N",
        help="vertices along the longer side of a flat template; of Kinect-Paper's, along both"
        " (default: 33)",
    )
    p.add_argument(
        "--pose-fit",
        choices=("auto", "none"),
        default="auto",
        help="auto: move a given pose (--corners, or Kinect-Paper's cam.ext) to the edges near the"
        " template's outline in the first frame, if they are clear; none: take it as it is"
        " (default: auto)",
    )
    p.add_argument("-q", "--quiet", action="store_true", help="no progress, only errors")
    p.add_argument("--json", action="store_true", help="the result as one JSON object on stdout")
    _add_evidence(
        p.add_argument_group("what is known beside the images (docs/evidence.md), of every frame")
    )
    _add_cameras(p.add_argument_group("further cameras, exposed with the one of the frames"))
    _add_video(p.add_argument_group("from a video"))
    _add_camera(
        p.add_argument_group(
            "the camera of a video (default: from the metadata of the video or the photo)"
        )
    )
    return p


def _add_evidence(group):
    group.add_argument(
        "--tracks",
        metavar="FILE",
        help="point tracks, .npz as CoTracker, TAPIR, AllTracker have them: tracks (T, P, 2) in"
        " pixels of the video, visible (T, P), queries (P, 3)",
    )
    group.add_argument(
        "--track-centre",
        type=float,
        metavar="C",
        help="coordinate that they give the centre of the first pixel: 0.5 (default) or 0",
    )
    group.add_argument(
        "--depth",
        metavar="FOLDER",
        help="depth images as the frames' camera sees them: 16 bit PNG, or EXR in metres; 0 is"
        " unknown. Or an export of Record3D, ScanNet or rs-convert (RealSense)",
    )
    group.add_argument(
        "--depth-unit",
        type=float,
        metavar="M",
        help="metres that a whole number of them stands for (default: 0.001)",
    )
    group.add_argument(
        "--depth-known-to",
        choices=("metric", "affine", "disparity"),
        help="affine, disparity: depth, or its inverse, as a network guesses it, up to a scale and"
        " a shift (default: metric)",
    )

    group.add_argument(
        "--body",
        metavar="FILE",
        help="a body's motion (.npz: poses (T, 24, 3), translation (T, 3); or vertices (T, V, 3),"
        " faces (F, 3), rest (V, 3); or a folder of its meshes) that carries the template, which is"
        " given on the body at rest; of a FOLDER whose camera.json has world_to_camera (needs the"
        " extra learn for the run)",
    )
    group.add_argument(
        "--body-model",
        metavar="FILE",
        help="SMPL's, SMPL-H's or SMPL-X's file (.pkl, .npz), whose motion --body then is: poses or"
        " global_orient and body_pose, trans, betas",
    )
    group.add_argument(
        "--body-up",
        choices=("z", "y", "-y"),
        help="axis of its world that points up; -y where that is a level camera's (default: z)",
    )


def _add_cameras(group):
    group.add_argument(
        "--cameras",
        metavar="RIG",
        help="a calibrated rig: nerfstudio's or instant-ngp's transforms.json, the folder of a"
        " sparse model of COLMAP, or a folder of cameras with camera.json (docs/evidence.md)",
    )
    group.add_argument(
        "--camera-name", metavar="NAME", help="the one of them that took the frames (default: none)"
    )
    group.add_argument(
        "--rig-scale",
        type=float,
        metavar="M",
        help="metres of the rig's unit (default: 1)",
    )
    group.add_argument(
        "--rig-images",
        metavar="FOLDER",
        help="the folder that its images' names count from (default: near the rig)",
    )


def _add_video(group):
    group.add_argument(
        "--texture",
        metavar="PHOTO",
        help="a straight photo of the sheet, from edge to edge; or first-frame, with --corners",
    )
    group.add_argument(
        "--size",
        nargs="+",
        metavar="LENGTH",
        help="width and height as the photo shows them: 0.297 0.210 (metres), 297mm 210mm, or A4",
    )
    group.add_argument(
        "--template",
        metavar="OBJ",
        help="a template that is not flat, instead of --size: metres, with the photo's uv",
    )
    group.add_argument(
        "--corners",
        nargs="+",
        metavar="X,Y",
        help="the sheet's corners in the first frame [pixels]: top left, top right, bottom right,"
        " bottom left of the print; the photo is then not searched. Or: frame, if the sheet fills"
        " the picture",
    )
    group.add_argument(
        "--texture-corners",
        nargs=4,
        metavar="X,Y",
        help="the sheet's corners in the photo [pixels], if it shows more than the sheet",
    )
    for name, default, what in (
        ("first", 0, "first frame to use, counted from 0; the template is placed in it"),
        ("last", -1, "last frame to use, inclusive; -1 is the end"),
        ("stride", 1, "use every N-th frame"),
    ):
        group.add_argument(
            f"--{name}",
            type=int,
            default=default,
            metavar="N",
            help=f"{what} (default: {default})",
        )
    group.add_argument(
        "--scale", type=float, default=1.0, metavar="S", help="scale the frames by S (default: 1)"
    )
    masks = group.add_mutually_exclusive_group()
    masks.add_argument(
        "--masks",
        metavar="FOLDER",
        help="use these masks, one a frame",
    )
    masks.add_argument("--no-masks", action="store_true", help="use no masks")
    group.add_argument(
        "--inset",
        type=float,
        metavar="PIXELS",
        help="draw the masks' borders in by so many pixels, or out if negative (default: 0)",
    )


def _add_camera(group):
    group.add_argument(
        "--board",
        default="9x6",
        metavar="BOARD",
        help="the board of --calibrate: inner corners of a chessboard (default: 9x6), or"
        " charuco:7x5:4X4_50:0.75 (squares, dictionary, marker by square)",
    )
    camera = group.add_mutually_exclusive_group()
    camera.add_argument(
        "--fov", type=float, metavar="DEG", help="horizontal field of view [degrees]"
    )
    camera.add_argument(
        "--camera",
        metavar="FILE",
        help="fx, fy, cx, cy, width, height [pixels] as JSON, with distortion (OpenCV's"
        " coefficients) or none; or OpenCV's YAML or XML, COLMAP's cameras.txt, nerfstudio's"
        " transforms.json",
    )
    camera.add_argument(
        "--calibrate",
        metavar="VIDEO",
        help="a video, or images, of a chessboard or ChArUco board by the same camera",
    )


def main(argv=None):
    p = parser()
    args = p.parse_args(argv)
    words = sys.argv[1:] if argv is None else argv
    lines = []
    if args.texture is not None or os.path.isfile(args.folder):
        scene, found = _from_video(args, shlex.join(["python", "-m", "polysft_mi.prepare", *words]))
    else:
        for name in _OF_VIDEO.split():
            if getattr(args, name) != p.get_default(name):
                raise InputError(
                    f"{args.folder}: --{name.replace('_', '-')} is for a video or a folder of"
                    " images; these also need --texture"
                )
        from .capture import prepare_folder

        scene, line = prepare_folder(
            args.folder,
            args.output,
            args.resolution,
            args.overwrite,
            args.pose_fit,
            warn=lambda line: print(line, file=sys.stderr),
            rig=_rig(args),
            **_evidence(args),
        )
        found, lines = {"folder": args.folder}, [line]
    if args.json:
        print(json.dumps({"scene": scene, **found}, ensure_ascii=False))
    elif not args.quiet:
        print(*lines, f"next: python -m polysft_mi.run {shlex.quote(scene)} -o OUT", sep="\n")


def _evidence(args):
    """Settings of what is given beside the images, by their names."""
    known = _told(args, "tracks", "track_centre", of="tracks")
    known |= _told(args, "depth", "depth_unit", "depth_known_to", of="depth images")
    known |= _told(args, "body", "body_model", "body_up", of="a body")
    centre = known.get("track_centre", 0.5)
    if not 0 <= centre <= 1:
        raise InputError(f"--track-centre {centre:g}: 0.5 or 0, at most 1, is needed")
    unit = known.get("depth_unit", 1)
    if not (np.isfinite(unit) and unit > 0):
        raise InputError(f"--depth-unit {unit:g}: metres a number; above 0 is needed")
    return known


def _rig(args):
    from .capture import GivenRig

    known = _told(args, "cameras", "camera_name", "rig_scale", "rig_images", of="a rig")
    names = {"camera_name": "own", "rig_scale": "scale", "rig_images": "images"}
    path = known.pop("cameras", None)
    return GivenRig(path, **{names[name]: x for name, x in known.items()}) if path else None


def _told(args, name, *about, of):
    """The options ``name`` and ``about`` it that are given. Raises InputError where it is not, but
    something about it is.
    """
    given = {n: getattr(args, n) for n in (name, *about) if getattr(args, n) is not None}
    if given and not given.get(name):
        option = next(iter(given)).replace("_", "-")
        raise InputError(f"--{option}: is of {of}; --{name} names its file or folder")
    return given


def _from_video(args, command):
    from .capture import GivenEvidence, prepare_video

    if args.body is not None:
        raise InputError(
            f"{args.folder}: --body is for a folder in a known form, whose template lies on a body"
        )
    if args.texture is None:
        raise InputError(
            f"{args.folder}: a video needs --texture photo.jpg, a straight photo of the sheet (or"
            " --texture first-frame, with --corners), and --size"
        )
    if args.inset is not None and args.no_masks:
        raise InputError("--inset draws masks in; with --no-masks there are none")
    if args.inset is not None and not np.isfinite(args.inset):
        raise InputError(f"--inset {args.inset:g}: a number of pixels is needed")
    corners, texture_corners = args.corners, args.texture_corners
    if corners == ["frame"]:
        corners = "frame"
    elif corners is not None:
        corners = _points(corners, "--corners")
    if texture_corners is not None:
        texture_corners = _points(texture_corners, "--texture-corners")
    quiet = args.quiet or args.json
    same = (
        "texture size template resolution camera fov calibrate board pose_fit first last stride"
        " scale overwrite"
    )
    with _progress(quiet) as progress:
        return prepare_video(
            args.folder,
            args.output,
            corners=corners,
            texture_corners=texture_corners,
            masks=args.masks or not args.no_masks,
            inset=args.inset or 0.0,
            evidence=GivenEvidence(rig=_rig(args), **_evidence(args)),
            say=(lambda line: None) if quiet else print,
            progress=progress,
            command=command,
            **{name: getattr(args, name) for name in same.split()},
        )


def _points(words, option):
    """Pixels (4, 2) of words such as ``212,80``."""
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


@contextlib.contextmanager
def _progress(quiet):
    """A function that shows how many frames are done, on a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda count: None
        return
    from rich.console import Console

    with Console(stderr=True).status("reading") as status:
        yield lambda count: status.update(f"{count} frames")


if __name__ == "__main__":
    cli(main)
