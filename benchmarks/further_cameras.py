"""Further cameras of a sequence with truth: frames, masks, camera.json, by Mitsuba's path tracer.

    python benchmarks/further_cameras.py FOLDER [-o OUT] [--angles 150] [--seed 0]
    polysft run scene.xml -D cameras=OUT ...

FOLDER has template.obj, texture.png and gt.npz (vertices (T, N, 3) [m, camera frame]). A camera
looks at the middle of the surface from an angle [degrees] about the upright axis, 0 for the first
camera's own place; it has a light of its own. OUT is FOLDER/cameras by default.
"""

import argparse
import os

import numpy as np
from simulate_pictures import add_cameras

from polyfit.backend import set_variant
from polysft_mi.errors import InputError, cli


def main(argv=None):
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python benchmarks/further_cameras.py", description=__doc__, formatter_class=raw
    )
    parser.add_argument("folder", metavar="FOLDER", help="a sequence's folder")
    parser.add_argument("-o", "--output", metavar="OUT", help="folder of the cameras' folders")
    parser.add_argument("--angles", nargs="+", type=float, default=[150.0], metavar="DEGREES")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    truth = os.path.join(args.folder, "gt.npz")
    if not os.path.isfile(truth):
        raise InputError(f"{args.folder}: no gt.npz in it; a sequence with its truth is needed")
    set_variant("llvm_ad_rgb")
    vertices = np.load(truth)["vertices"].astype(np.float64)
    out = args.output or os.path.join(args.folder, "cameras")
    for name in add_cameras(args.folder, out, vertices, args.angles, args.seed):
        print(os.path.join(out, name))


if __name__ == "__main__":
    cli(main)
