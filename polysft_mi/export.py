"""``python -m polysft_mi.export OUT --format usd|glb|obj|ply|npz``: the moving surface of a run for
other programs.
"""

import os

from . import commands
from .errors import cli
from .results import FORMATS, Run, export

_EXAMPLES = [
    ("out/demo --format glb", "out/demo/export/surface.glb, for browsers, Blender, Windows"),
    ("out/demo --format usd", "out/demo/export/surface.usdz, one file with its texture"),
    (
        "out/demo --format usd -o flag.usdc --up z --fps 30",
        "USD with z up; the texture lies beside it",
    ),
    ("out/demo --format obj -o meshes", "one OBJ a frame, with material and texture"),
    ("out/demo --format npz --up camera", "arrays, in the camera frame"),
]

_NEXT = {
    "usd": "open {} in Blender (File, Import, Universal Scene Description), or in usdview",
    "glb": "open {} in Blender (File, Import, glTF 2.0), or in a viewer of glTF",
    "obj": "open the files of {}, one a frame, in any mesh editor",
    "ply": "open the files of {}, one a frame, in any mesh editor",
    "npz": "read {} by numpy.load",
}


def parser():
    p = commands.parser(
        "export",
        "Write the moving, textured surface of a run for other programs, in metres.",
        _EXAMPLES,
    )
    p.add_argument("out", metavar="OUT", help="folder of a run")
    p.add_argument("--format", choices=FORMATS, required=True, help="what to write")
    p.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        help="file to write, for obj and ply a folder (default: in OUT/export)",
    )
    p.add_argument(
        "--up",
        choices=("y", "z", "camera"),
        default="y",
        help="which way is up; camera: x right, y down, z forward, as in surface.npz (default: y)",
    )
    p.add_argument("--fps", type=float, help="frames a second (default: that of the run)")
    p.add_argument("--texture", metavar="IMAGE", help="an image instead of the scene's texture")
    p.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    return p


def main(arguments=None):
    options = parser().parse_args(arguments)
    run = Run.open(options.out)
    path = export(
        run, options.format, options.output, up=options.up, fps=options.fps, texture=options.texture
    )
    if not options.quiet:
        print(
            f"written: {path}, {len(run.frames)} frames of {run.vertices.shape[1]} vertices,"
            f" {_size(path)}",
            f"next: {_NEXT[options.format].format(path)}",
            sep="\n",
        )
    return 0


def _size(path):
    files = (
        [os.path.join(path, name) for name in os.listdir(path)] if os.path.isdir(path) else [path]
    )
    return f"{sum(map(os.path.getsize, files)) / 1e6:.1f} MB"


if __name__ == "__main__":
    cli(main)
