"""Drapes a garment on a moving body by the network, in milliseconds a frame, and writes the arrays,
an animation and a rendering of it.

    python -m onefit.drape dress walk -o OUT                   # a template, a generated motion
    python -m onefit.drape shirt.obj motion.npz -o OUT         # a mesh, a motion (AMASS, NCS, BVH)
    python -m onefit.drape tshirt dance -o OUT --shape weight=0.7 height=0.6 --skip render

For folds like a simulation's, and a material: python -m onefit.simulate, which takes the same
arguments. OUT receives

    drape.npz               vertices (T, N, 3) [m, z up], faces, rest, the body's vertices and
                            faces, fps
    figures.json            what was measured
    garment.usd, body.usd   animations that Blender and usdview open; of a mesh file its own
                            vertices, faces and texture coordinates
    frames/NNN.png          rendered by Mitsuba; drape.mp4 is their video
    meshes/NNN.obj          one mesh a frame, with --meshes obj (or ply)
"""

from onefit.draping import command
from polyfit.errors import cli


def parser():
    p = command.parser("onefit.drape", __doc__)
    p.add_argument(
        "--no-post",
        dest="post",
        action="store_false",
        help="what the network alone makes, without post-processing",
    )
    for name in ("material", "steps"):
        command.refuse(p, f"--{name}", "python -m onefit.simulate takes it, a drape has none")
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    command.run("drape", args, post=args.post)


if __name__ == "__main__":
    cli(main)
