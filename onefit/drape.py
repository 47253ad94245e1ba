"""Drapes a garment on a moving body by the network, in milliseconds a frame, and writes the arrays,
an animation and a rendering of it.

    python -m onefit.drape dress walk -o OUT                   # a template, a generated motion
    python -m onefit.drape shirt.obj motion.npz -o OUT         # a mesh, a motion (AMASS, NCS, BVH)
    python -m onefit.drape tshirt dance -o OUT --shape weight=0.7 height=0.6 --skip render
    python -m onefit.drape trousers tshirt walk -o OUT         # one over the other, in this order

For folds like a simulation's, and a material: python -m onefit.simulate, which takes the same
arguments. OUT receives

    drape.npz               vertices (T, N, 3) [m, z up], faces, rest, the body's vertices and
                            faces, fps; of a mesh file its own in motion, mesh_vertices and
                            mesh_faces, with uv and uv_faces where it has them
    figures.json            what was measured
    garment.usd, body.usd   animations that Blender and usdview open; of a mesh file its own
                            vertices, faces and texture coordinates
    frames/NNN.png          rendered by Mitsuba; drape.mp4 is their video
    meshes/NNN.obj          one mesh a frame, with --meshes obj (or ply); frames.json: what is up

Of several garments each has these in a folder of its own, 1_trousers, 2_tshirt, ...; figures.json,
frames and the video are of all.
"""

import argparse

from onefit.draping import command
from polyfit.errors import InputError, cli

# The paper: what its network alone makes; --post beside it pushes cloth out of the body
PRESETS = {"paper": dict(weights="paper", post=False, ease=False)}


def parser():
    p = command.parser("onefit.drape", __doc__)
    p.add_argument(
        "--post",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="post-processing of what the network makes (default: on)",
    )
    p.add_argument(
        "--ease",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="the garment is tried on first (default: on)",
    )
    for name in ("material", "steps"):
        command.refuse(p, f"--{name}", "python -m onefit.simulate takes it, a drape has none")
    p.add_presets(PRESETS)
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    if not args.post and len(args.garment) > 1:
        raise InputError(
            "--no-post, --preset paper: for one garment; of several, only post-processing keeps the"
            " order: --post"
        )
    command.run("drape", args, post=args.post, eased=args.ease)


if __name__ == "__main__":
    cli(main)
