"""Simulates a garment on a moving body: implicit steps of cloth that begin with the network's
drape, in tens of milliseconds a frame; writes the arrays, an animation and a rendering of it.

    python -m onefit.simulate dress walk -o OUT
    python -m onefit.simulate shirt.obj motion.npz -o OUT --material denim
    python -m onefit.simulate trousers tshirt walk -o OUT      # one over the other, in this order
    python -m onefit.simulate trousers tshirt walk -o OUT --material denim,cotton

Where milliseconds count: python -m onefit.drape, which takes the same arguments and writes the
same files into OUT (its --help lists them).
"""

from onefit.draping import command
from onefit.physics import MATERIALS, Material
from polyfit.errors import InputError, cli


def parser():
    p = command.parser("onefit.simulate", __doc__)
    p.add_argument(
        "--material",
        default="cotton",
        help=f"{', '.join(MATERIALS)}; of several garments also one for each, as denim,cotton"
        " (default: cotton)",
    )
    p.add_argument(
        "--steps",
        type=int,
        default=2,
        metavar="N",
        help="implicit steps of cloth a frame (default: 2)",
    )
    for flag in ("--post", "--no-post", "--ease", "--no-ease"):
        command.refuse(p, flag, "python -m onefit.drape takes it, a simulation has no such step")
    command.refuse(p, "--preset", "python -m onefit.drape takes it, a simulation has none")
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    names = args.material.split(",")
    material = names if names[1:] else args.material
    Material.of_each(material, len(args.garment))
    if args.steps < 1:
        raise InputError(f"--steps {args.steps}: steps a frame, 1 or more")
    command.run("simulate", args, material=material, steps=args.steps)


if __name__ == "__main__":
    cli(main)
